/**
 * The reasons for a monitor's action: the necessary events, the compared values, the lines. For a denial: the rule that
 * would allow the request, or why none would.
 */

import { html } from "../html.js";
import { Given } from "../parts/given.js";
import { Failure, Loading } from "../parts/notice.js";
import { useResource } from "../parts/resource.js";
import { get } from "../rest.js";

/** @param {{id: string}} given */
export function Why({ id }) {
  const { value, error, again } = useResource((signal) => get(`/v1/audit/${encodeURIComponent(id)}/why`, {}, signal), [id]);
  if (error) return html`<${Failure} error=${error} retry=${again} />`;
  if (!value) return html`<${Loading} rows=${2} />`;
  return html`<div><h3>Why</h3><ul class="plain-list">${value.lines.slice(1).map((/** @type {string} */ line) => html`<li key=${line}><${Given} value=${line} most=${600} mono /></li>`)}${value.refusal && html`<li><${Given} value=${value.refusal} most=${600} /></li>`}</ul></div>`;
}
