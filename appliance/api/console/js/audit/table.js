/** Records as rows: time, outcome, host, resource, reason. Equal consecutive records are one row, which opens in place. */

import { html } from "../html.js";
import { Moment } from "../moments.js";
import { Outcome, requested } from "../parts/badge.js";
import { actor, Given } from "../parts/given.js";
import { Host, Sentence } from "../parts/host.js";
import { go } from "../router.js";
import { auditPath } from "./filters.js";
import { Count, othersOf, Range, shownOf } from "./rows.js";

/** @param {{rows: import("./rows.js").Row[], opened: (row: import("./rows.js").Row) => boolean, toggle: (row: import("./rows.js").Row) => void, chosen: string, filter: Record<string, string>}} given */
export function RecordTable({ rows, opened, toggle, chosen, filter }) {
  const is = (/** @type {any} */ one) => one.id === chosen || String(one.sequence) === chosen;
  return html`<div class="table-wrap"><table class="table records" aria-label="Records"><thead><tr><th>Time</th><th>Outcome</th><th>Event</th><th>Who</th><th>Host</th><th>Resource</th><th class="wide-only">Rule</th><th class="wide-only">Reason</th></tr></thead>
    <tbody>${rows.map((row) => {
      const open = opened(row);
      const time = html`<${Range} row=${row} />`;
      const count = html`<${Count} row=${row} open=${open} toggle=${() => toggle(row)} />`;
      return [
        html`<${Row} key=${row.first.id} record=${shownOf(row)} others=${othersOf(row)} callers=${othersOf(row, "caller_id")} time=${time} count=${count} reason=${row.value || row.last.reason} chosen=${!open && row.records.some(is)} filter=${filter} />`,
        open && row.records.map((one) => html`<${Row} key=${`each ${one.id}`} record=${one} time=${html`<${Moment} at=${one.time} />`} reason=${one.reason} part chosen=${is(one)} filter=${filter} />`),
      ];
    })}</tbody></table></div>`;
}

function Row(/** @type {{record: any, others?: number, callers?: number, time: any, count?: any, reason: string, part?: boolean, chosen: boolean, filter: Record<string, string>}} */ { record, others = 0, callers = 0, time, count, reason, part = false, chosen, filter }) {
  const open = () => go(auditPath(filter, record.id));
  const link = (/** @type {MouseEvent} */ event) => {
    event.preventDefault();
    event.stopPropagation();
    open();
  };
  const who = record.caller_id || actor(record.detail.who);
  return html`<tr class=${`pick${chosen ? " chosen" : ""}${part ? " part" : ""}`} aria-selected=${chosen ? "true" : undefined} onClick=${open} data-id=${record.id} data-sequence=${record.sequence}>
    <td class="time"><a href=${auditPath(filter, record.id)} onClick=${link}>${time}</a></td>
    <td><${Outcome} record=${record} /></td>
    <td><${Given} value=${isRequest(record, part) ? requested(record) : record.event} most=${30} /> ${record.detail.monitor && html`<span class="muted small"><${Given} value=${record.detail.monitor} most=${40} /></span> `}${count}</td>
    <td data-label="Who" class=${who ? "" : "bare"}><${Given} value=${who} most=${40} mono />${callers > 0 && html` <span class="muted small nowrap">and ${callers} more</span>`}</td>
    <td class=${`nowrap${record.host ? "" : " bare"}`} data-label="Host"><${Host} value=${record.host} /></td>
    <td data-label="Resource" class=${record.resource ? "" : "bare"}><${Given} value=${record.resource} most=${60} mono />${others > 0 && html` <span class="muted small nowrap">and ${others} more</span>`}</td>
    <td data-label="Rule" class=${`wide-only${record.rule ? "" : " bare"}`}>${record.rule ? html`<${Given} value=${`[${record.rule.section}]`} most=${22} mono /> <${Given} value=${record.rule.key} most=${40} mono />` : html`<span class="muted">–</span>`}</td>
    <td data-label="Reason" class=${`wide-only reason${reason ? "" : " bare"}`}><${Sentence} value=${reason} most=${240} /></td></tr>`;
}

/** Whether a row is about a request. Of the records behind a row, those that count repetitions have their own words. */
function isRequest(/** @type {any} */ { event, category, detail }, /** @type {boolean} */ part) {
  return event === "decision" || (!part && category && detail.of === "decision");
}
