/** The latest denials and actions of monitors, live. */

import { DeniedHosts } from "../audit/denied_hosts.js";
import { byHostAndKind, Count, grouped, inOrder, othersOf, Range, shownOf } from "../audit/rows.js";
import { html, useState } from "../html.js";
import { isSelftest } from "../graph/model.js";
import { isNow, Moment } from "../moments.js";
import { notable } from "../notable.js";
import { useApplianceTime } from "../parts/ago.js";
import { Badge, requested } from "../parts/badge.js";
import { Given } from "../parts/given.js";
import { Host, Sentence } from "../parts/host.js";
import { Empty, Loading } from "../parts/notice.js";
import { Link } from "../router.js";
import { useStore } from "../store.js";

const SHOWN = 8;

export function Refusals() {
  const { denials, missing } = useStore(notable);
  return html`<section class="panel" aria-labelledby="refusals"><div class="panel-head"><h2 id="refusals">Recently denied</h2>
      <span class="end"><${Link} to="/console/audit?decision=deny&since=1d" class="small">All in the audit log</${Link}></span></div>
    ${missing && !denials?.length ? html`<${Empty} icon="warn" title="Not known at present" />` : denials === null ? html`<${Loading} />` : !denials.length ? html`<${Empty} icon="check" title="Nothing was denied in the last day">Requests that the policy denies appear here at once.</${Empty}>`
      : html`<${DeniedHosts} since="1h" title=" in the last hour" mark=${denials[0].sequence} /><${List} records=${denials} what=${denied} />`}</section>`;
}

export function Doings() {
  const { doings, missing } = useStore(notable);
  return html`<section class="panel" aria-labelledby="doings"><div class="panel-head"><h2 id="doings">Recent actions of monitors</h2>
      <span class="end"><${Link} to="/console/audit?category=monitor&since=1d" class="small">All in the audit log</${Link}></span></div>
    ${missing && !doings?.length ? html`<${Empty} icon="warn" title="Not known at present" />` : doings === null ? html`<${Loading} />` : !doings.length ? html`<${Empty} icon="monitors" title="No monitor acted in the last day">Stops, verdicts, dropped and changed messages appear here.</${Empty}>`
      : html`<${List} records=${doings} what=${done} />`}</section>`;
}

function List(/** @type {{records: any[], what: (row: import("../audit/rows.js").Row, count: any, fresh: boolean) => any}} */ { records, what }) {
  return html`<ul class="event-list">${inOrder(byHostAndKind(grouped(records))).slice(0, SHOWN).map((row) => html`<${Entry} key=${row.first.id} row=${row} what=${what} />`)}</ul>`;
}

function Entry(/** @type {{row: import("../audit/rows.js").Row, what: (row: import("../audit/rows.js").Row, count: any, fresh: boolean) => any}} */ { row, what }) {
  const [open, setOpen] = useState(false);
  const fresh = isNow(row.last.time, useApplianceTime());
  const count = html` <${Count} row=${row} open=${open} toggle=${() => setOpen(!open)} />`;
  return html`<li class="event"><span class="event-time"><${Range} row=${row} /></span>${what(row, count, fresh)}
    ${open && row.records.length > 1 && html`<ul class="each">${row.records.map((one) => html`<li key=${one.id}><${Link} to=${`/console/audit/${one.id}`}><${Moment} at=${one.time} /></${Link}> <${Given} value=${one.reason || one.event} most=${200} /></li>`)}</ul>`}</li>`;
}

function denied(/** @type {import("../audit/rows.js").Row} */ row, /** @type {any} */ count, /** @type {boolean} */ fresh) {
  const { value } = row;
  const one = shownOf(row);
  return html`<span class="event-badge"><${Badge} word=${one.decision} tone=${fresh ? undefined : ""} /></span><div class="event-body">
    <div><${Given} value=${one.caller_id} most=${60} mono none="no name" /> <span class="muted">of</span> <${Host} value=${one.host} none="no address" /> <span class="muted"><${Given} value=${isSelftest(one) ? "rosrv selftest" : one.resource ? requested(one) : one.event} none="" /></span> <${Given} value=${one.resource} most=${80} mono none="" />${othersOf(row) > 0 && html` <span class="muted">and ${othersOf(row)} more</span>`}${count}</div>
    <div class="event-reason"><${Link} to=${`/console/audit/${one.id}`}><${Sentence} value=${value || one.reason || one.event} most=${220} /></${Link}></div></div>`;
}

function done(/** @type {import("../audit/rows.js").Row} */ row, /** @type {any} */ count, /** @type {boolean} */ fresh) {
  const { value } = row;
  const one = shownOf(row);
  return html`<span class="event-badge"><${Badge} word=${one.event.replace(/^(monitor|message) /, "")} tone=${!fresh ? "" : one.severity === "alarm" ? "deny" : one.severity === "warning" ? "warn" : "note"} /></span><div class="event-body">
    <div><strong><${Given} value=${one.detail.monitor} most=${60} /></strong> <span class="muted">on</span> <${Given} value=${one.resource} most=${80} mono />${one.caller_id && html` <span class="muted">by</span> <${Given} value=${one.caller_id} most=${60} mono /> <span class="muted">of</span> <${Host} value=${one.host} none="no address" />`}${count}</div>
    <div class="event-reason"><${Link} to=${`/console/audit/${one.id}`}><${Given} value=${value || one.reason || one.detail.category || one.event} most=${200} /></${Link}></div></div>`;
}
