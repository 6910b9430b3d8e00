/** Margins as bars. */

import { html } from "#console/html.js";

/** @param {{margins: import("./margins.js").Margin[]}} given */
export function Margins({ margins }) {
  return html`<ul class="margins">${margins.map((one) => html`<li key=${one.name}><span>${one.name} <b>${number(one.value)}</b> <span class="muted nowrap">${one.least ? "at least" : "at most"} ${number(one.bound)} ${one.unit}</span></span>
    <span class="margin-bar" aria-hidden="true"><span class=${tone(one.used)} style=${{ width: `${Math.min(100, Math.max(2, one.used * 100))}%` }}></span></span></li>`)}</ul>`;
}

function tone(/** @type {number} */ used) {
  return used >= 1 ? "deny" : used >= 0.8 ? "warn" : "allow";
}

function number(/** @type {number} */ value) {
  return String(Number(value.toPrecision(2)));
}
