/**
 * Single keys. A control names its key in `aria-keyshortcuts`, and the key presses it; a view adds keys that belong to
 * no control with `useKeys`. They act outside of fields, editors and dialogs, and can be turned off (WCAG 2.1.4).
 */

import { html, useLayoutEffect, useRef } from "./html.js";
import { Dialog } from "./parts/dialog.js";
import { Check } from "./parts/field.js";
import { store, stored } from "./storage.js";
import { createStore, useStore } from "./store.js";

const KEPT = "rosrv.keys";
const FILTER = "f"; // focuses the field that filters the view
const LIST = /** @type {[string, string][]} */ ([
  ["1 … 8", "The views, in their order"],
  ["/", "Search for hosts, nodes, topics, rules, records, guards and doors"],
  ["f", "Filter the view"],
  ["j, k", "Next and previous entry (Now), record (Audit) or event (recordings)"],
  ["Enter, Esc", "Open; close the open record or dialog, leave the editor"],
  ["g", "In a record: show what would grant it, then open that in the editor"],
  ["p, r", "In a record: its rule in the policy; its time line in a recording"],
  ["m, e", "In a recording: read messages; evidence (also in Audit)"],
  ["← →, + −, 0", "Move and zoom on a recording's time line; Shift: ten times as far"],
  ["i, d, l", "In Policy: into the editor, dry run, load"],
  ["Ctrl Space", "In the policy's editor: complete; arrows and Enter choose"],
  ["Ctrl S", "Dry run of the text in the editor"],
  ["t", "Dark or light"],
  ["?", "This list"],
]);

export const keys = createStore({ on: stored(KEPT) !== "off", listed: false });

export function listKeys() {
  keys.update({ listed: true });
}

/** Listen to the keys of controls, and return the list of keys while it is open. */
export function useShortcuts() {
  const { on, listed } = useStore(keys);
  useKeys((key, event) => {
    if (key.length !== 1 || event.repeat) return false;
    const named = key === FILTER ? "[data-search]" : `[aria-keyshortcuts="${CSS.escape(key)}"]`;
    const control = /** @type {HTMLElement | undefined} */ ([...document.querySelectorAll(named)].find((one) => one.getClientRects().length));
    if (!control) return false;
    // A disabled control takes the focus, so that its reason is read.
    if (key === FILTER || control.shadowRoot || control.ariaDisabled === "true") /** @type {HTMLElement} */ (control.shadowRoot?.querySelector("[contenteditable]") ?? control).focus();
    else control.click();
    return true;
  });
  return listed && html`<${Dialog} title="Keys" close=${() => keys.update({ listed: false })}>
    <dl class="facts">${LIST.map(([key, does]) => html`<dt key=${key}><code>${key}</code></dt><dd>${does}</dd>`)}</dl>
    <${Check} label="Keys without Ctrl or Alt" on=${on} set=${turn} /></${Dialog}>`;
}

/** Call `does` for each key that is meant for the view; it returns whether it used the key. @param {(key: string, event: KeyboardEvent) => boolean} does */
export function useKeys(does) {
  const newest = useRef(does);
  newest.current = does;
  // Not an effect after the drawing: once a view is visible, its keys work.
  useLayoutEffect(() => {
    const heard = (/** @type {KeyboardEvent} */ event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented || typing(event) || document.querySelector("dialog[open]")) return;
      if (event.key.length === 1 && !keys.get().on) return;
      if (newest.current(event.key, event)) event.preventDefault();
    };
    addEventListener("keydown", heard);
    return () => removeEventListener("keydown", heard);
  }, []);
}

/** Whether a key press belongs to a field or an editor. */
function typing(/** @type {Event} */ event) {
  const target = /** @type {HTMLElement} */ (event.composedPath()[0]);
  return target instanceof HTMLElement && (target.isContentEditable || /^(INPUT|TEXTAREA|SELECT)$/.test(target.tagName));
}

function turn(/** @type {boolean} */ on) {
  store(KEPT, on ? "on" : "off");
  keys.update({ on });
}
