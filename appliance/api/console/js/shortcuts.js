/** Keys: 1 to 7 select a view, / searches in the view, t switches the theme, ? shows this list. */

import { html, useEffect, useState } from "./html.js";
import { Dialog } from "./parts/dialog.js";
import { go, VIEWS } from "./router.js";
import { switchTheme } from "./theme.js";

const LIST = [
  ["1 … 7", "Now, Graph, Audit, Policy, Monitors, Hosts, Recordings"],
  ["/", "Search in the view"],
  ["j, k", "Next and previous record (Audit) or event (recordings)"],
  ["← →, + −, 0", "Move and zoom on a recording's time line; Shift: ten times as far"],
  ["Esc", "Close the open record or dialog"],
  ["Ctrl S", "Dry run of the text in the editor"],
  ["t", "Dark or light"],
  ["?", "This list"],
];

export function useShortcuts() {
  const [open, setOpen] = useState(false);
  useEffect(() => {
    const heard = (/** @type {KeyboardEvent} */ event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || typing(event) || document.querySelector("dialog[open]")) return;
      const view = VIEWS[Number(event.key) - 1];
      if (view) go(`/console/${view}`);
      else if (event.key === "t") switchTheme();
      else if (event.key === "?") setOpen(true);
      else if (event.key === "/") /** @type {HTMLElement | null} */ (document.querySelector("[data-search]"))?.focus();
      else return;
      event.preventDefault();
    };
    addEventListener("keydown", heard);
    return () => removeEventListener("keydown", heard);
  }, []);
  return open && html`<${Dialog} title="Keys" close=${() => setOpen(false)}>
    <dl class="facts">${LIST.map(([key, does]) => html`<dt key=${key}><code>${key}</code></dt><dd>${does}</dd>`)}</dl></${Dialog}>`;
}

/** Whether a key press belongs to a field or an editor. @param {Event} event */
export function typing(event) {
  const target = /** @type {HTMLElement} */ (event.composedPath()[0]);
  return target instanceof HTMLElement && (target.isContentEditable || /^(INPUT|TEXTAREA|SELECT)$/.test(target.tagName));
}
