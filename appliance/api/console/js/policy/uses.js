/** The uses of each rule of the policy in force, from the audit log. */

import { html } from "../html.js";
import { Moment } from "../moments.js";
import { counted } from "../numbers.js";
import { Badge } from "../parts/badge.js";
import { Given } from "../parts/given.js";
import { Empty, Failure, Loading } from "../parts/notice.js";
import { useResource } from "../parts/resource.js";
import { get } from "../rest.js";
import { useStore } from "../store.js";
import { draft } from "./draft.js";

const ORDER = ["unused", "unknown", "used"];
const TONES = /** @type {Record<string, string>} */ ({ used: "allow", unused: "warn", unknown: "" });

/** @param {{pick: ((place: {line: number, column: number}) => void) | null}} given; without `pick`, lines have moved */
export function Uses({ pick }) {
  const revision = useStore(draft, (one) => one.live?.revision);
  const { value, error, again } = useResource((signal) => get("/v1/policy/uses", {}, signal), [revision]);
  if (error) return html`<div class="panel-body"><${Failure} error=${error} retry=${again} /></div>`;
  if (!value) return html`<${Loading} />`;
  if (!value.rules.length) return html`<${Empty} icon="policy" title="No rule grants anything" />`;
  const rows = value.rules.toSorted((/** @type {any} */ one, /** @type {any} */ other) => ORDER.indexOf(one.state) - ORDER.indexOf(other.state));
  return html`<p class="panel-body muted small">Recorded requests since <${Moment} at=${value.since} />, and registrations of now. Before you remove a rule, think of what happens once a year.${!value.whole && " Older records are removed, or too many to read here: what was not seen is unknown."}</p>
    <div class="table-wrap tall"><table class="table"><thead><tr><th>Rule</th><th>Use</th><th>Hosts without a use</th></tr></thead><tbody>
    ${rows.map((/** @type {any} */ { rule, state, used, unused_hosts, unknown_hosts, ended_hosts = [] }) => html`<tr key=${`${rule.file}:${rule.line}`}>
      <td>${rule.section} ${pick ? html`<button class="button small plain" onClick=${() => pick({ line: rule.line, column: 1 })}><${Given} value=${rule.key} mono /></button>` : html`<${Given} value=${rule.key} mono />`}</td>
      <td><${Badge} word=${state} tone=${TONES[state]} />${used > 0 && html` <span class="muted small">${counted(used, "use")}</span>`}</td>
      <td>${unused_hosts.length > 0 && html`<${Given} value=${unused_hosts.join(" ")} most=${200} mono />`}${unknown_hosts.length > 0 && html`<div class="muted small">unknown: <${Given} value=${unknown_hosts.join(" ")} most=${200} mono /></div>`}${ended_hosts.length > 0 && html`<div class="muted small">ended: <${Given} value=${ended_hosts.join(", ")} most=${200} mono /></div>`}</td></tr>`)}</tbody></table></div>`;
}
