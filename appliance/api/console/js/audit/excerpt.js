/** The deciding line of the policy and its neighbours, from the revision in force at that time. */

import { html } from "../html.js";
import { Loading, Notice } from "../parts/notice.js";
import { useResource } from "../parts/resource.js";
import { get } from "../rest.js";
import { plain } from "../words.js";

const AROUND = 3;

/** @param {{rule: {line: number, file: string}, revision: number}} given */
export function Excerpt({ rule, revision }) {
  const { value, error } = useResource((signal) => get(`/v1/policy/revisions/${revision}`, {}, signal), [revision]);
  if (error) return html`<${Notice} tone="note">Revision ${revision} is no longer kept; the rule was in line ${rule.line}.</${Notice}>`;
  if (!value) return html`<${Loading} rows=${2} />`;
  const lines = value.text.split("\n");
  const first = Math.max(1, rule.line - AROUND);
  const shown = lines.slice(first - 1, rule.line + AROUND);
  return html`<div class="excerpt" aria-label=${`Revision ${revision}, line ${rule.line}`}>${shown.map((/** @type {string} */ text, /** @type {number} */ index) => {
    const number = first + index;
    return html`<div key=${number} class=${`excerpt-line${number === rule.line ? " here" : ""}`}><span class="n">${number}</span><span>${plain(text, 300) || " "}</span></div>`;
  })}</div>`;
}
