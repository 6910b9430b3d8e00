/** Records as rows: time, outcome, host, resource, reason. */

import { html } from "../html.js";
import { Moment } from "../moments.js";
import { Outcome } from "../parts/badge.js";
import { Given } from "../parts/given.js";
import { go } from "../router.js";
import { auditPath } from "./filters.js";

/** @param {{records: any[], chosen: string, filter: Record<string, string>}} given */
export function RecordTable({ records, chosen, filter }) {
  return html`<div class="table-wrap"><table class="table records" aria-label="Records"><thead><tr><th>Time</th><th>Outcome</th><th>Event</th><th>Who</th><th>Host</th><th>Resource</th><th class="wide-only">Rule</th><th class="wide-only">Reason</th></tr></thead>
    <tbody>${records.map((one) => html`<${Row} key=${one.id} record=${one} chosen=${one.id === chosen || String(one.sequence) === chosen} filter=${filter} />`)}</tbody></table></div>`;
}

function Row(/** @type {{record: any, chosen: boolean, filter: Record<string, string>}} */ { record, chosen, filter }) {
  const open = () => go(auditPath(filter, record.id));
  const link = (/** @type {MouseEvent} */ event) => {
    event.preventDefault();
    event.stopPropagation();
    open();
  };
  const who = record.caller_id || record.detail.who;
  return html`<tr class=${`pick${chosen ? " chosen" : ""}`} aria-selected=${chosen ? "true" : undefined} onClick=${open} data-id=${record.id} data-sequence=${record.sequence}>
    <td class="nowrap"><a href=${auditPath(filter, record.id)} onClick=${link}><${Moment} at=${record.time} /></a></td>
    <td><${Outcome} record=${record} /></td>
    <td><${Given} value=${record.event === "decision" ? record.category : record.event} most=${30} /></td>
    <td data-label="Who" class=${who ? "" : "bare"}><${Given} value=${who} most=${40} mono /></td>
    <td class=${`nowrap${record.host ? "" : " bare"}`} data-label="Host"><${Given} value=${record.host} most=${40} mono /></td>
    <td data-label="Resource" class=${record.resource ? "" : "bare"}><${Given} value=${record.resource} most=${60} mono /></td>
    <td data-label="Rule" class=${`wide-only${record.rule ? "" : " bare"}`}>${record.rule ? html`<${Given} value=${`[${record.rule.section}]`} most=${22} mono /> <${Given} value=${record.rule.key} most=${40} mono />` : html`<span class="muted">–</span>`}</td>
    <td data-label="Reason" class=${`wide-only reason${record.reason ? "" : " bare"}`}><${Given} value=${record.reason} most=${110} /></td></tr>`;
}
