/** Tabs; the arrow keys also move between them. */

import { html, useId, useRef } from "../html.js";

/** @param {{label: string, tabs: [string, any][], chosen: string, choose: (name: string) => void, children?: any}} given */
export function Tabs({ label, tabs, chosen, choose, children }) {
  const id = useId();
  const bar = useRef(/** @type {HTMLElement | null} */ (null));
  const key = (/** @type {KeyboardEvent} */ event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!step) return;
    event.preventDefault();
    const at = tabs.findIndex(([name]) => name === chosen);
    const next = (at + step + tabs.length) % tabs.length;
    choose(tabs[next][0]);
    /** @type {HTMLElement} */ (bar.current?.children[next])?.focus();
  };
  return html`<div class="tabs" role="tablist" aria-label=${label} ref=${bar} onKeyDown=${key}>
      ${tabs.map(([name, shown]) => html`<button key=${name} type="button" class="tab" role="tab" id=${`${id}-${name}`} aria-selected=${String(name === chosen)}
        aria-controls=${`${id}-panel`} tabindex=${name === chosen ? 0 : -1} onClick=${() => choose(name)}>${shown}</button>`)}
    </div>
    <div role="tabpanel" id=${`${id}-panel`} aria-labelledby=${`${id}-${chosen}`}>${children}</div>`;
}
