/** The latest denials and actions of monitors, live. */

import { html } from "../html.js";
import { isSelftest } from "../graph/model.js";
import { Moment } from "../moments.js";
import { notable } from "../notable.js";
import { counted } from "../numbers.js";
import { Badge } from "../parts/badge.js";
import { Given } from "../parts/given.js";
import { Empty, Loading } from "../parts/notice.js";
import { Link } from "../router.js";
import { useStore } from "../store.js";
import { plain } from "../words.js";

const SHOWN = 8;

export function Refusals() {
  const denials = useStore(notable, (one) => one.denials);
  return html`<section class="panel" aria-labelledby="refusals"><div class="panel-head"><h2 id="refusals">Recently denied</h2>
      <span class="end"><${Link} to="/console/audit?decision=deny&since=1d" class="small">All in the audit log</${Link}></span></div>
    ${denials === null ? html`<${Loading} />` : !denials.length ? html`<${Empty} icon="check" title="Nothing was denied in the last day">Requests that the policy denies appear here at once.</${Empty}>`
      : html`<${List} records=${denials} what=${denied} />`}</section>`;
}

export function Doings() {
  const doings = useStore(notable, (one) => one.doings);
  return html`<section class="panel" aria-labelledby="doings"><div class="panel-head"><h2 id="doings">Recent actions of monitors</h2>
      <span class="end"><${Link} to="/console/audit?category=monitor&since=1d" class="small">All in the audit log</${Link}></span></div>
    ${doings === null ? html`<${Loading} />` : !doings.length ? html`<${Empty} icon="monitors" title="No monitor acted in the last day">Verdicts, dropped and changed messages appear here.</${Empty}>`
      : html`<${List} records=${doings} what=${done} />`}</section>`;
}

function List(/** @type {{records: any[], what: (record: any, more: any[]) => any}} */ { records, what }) {
  return html`<ul class="event-list">${alike(records).slice(0, SHOWN).map(({ first, more }) => html`<li key=${(more.at(-1) ?? first).id} class="event">
    <span class="event-time"><${Moment} at=${first.time} /></span>${what(first, more)}</li>`)}</ul>`;
}

/** Merge neighbours that differ only in the resource. */
function alike(/** @type {any[]} */ records) {
  /** @type {{first: any, more: any[]}[]} */
  const found = [];
  for (const one of records) {
    const last = found.at(-1);
    if (last && ["host", "caller_id", "event", "category", "decision"].every((name) => last.first[name] === one[name]) && last.first.detail.monitor === one.detail.monitor && near(last.first, one)) last.more.push(one);
    else found.push({ first: one, more: [] });
  }
  return found;
}

function near(/** @type {any} */ a, /** @type {any} */ b) {
  return Math.abs(Date.parse(a.time) - Date.parse(b.time)) < 10_000;
}

function denied(/** @type {any} */ one, /** @type {any[]} */ more) {
  return html`<span class="event-badge"><${Badge} word=${one.decision} /></span><div class="event-body">
    <div><${Given} value=${one.caller_id} most=${60} mono none="no name" /> <span class="muted">of</span> <${Given} value=${one.host} mono none="no address" /> <span class="muted"><${Given} value=${isSelftest(one) ? "rosrv selftest" : one.resource ? one.category : one.event} none="" /></span> <${Given} value=${one.resource} most=${80} mono none="" /><${More} more=${more} /></div>
    <div class="event-reason"><${Link} to=${`/console/audit/${one.id}`}><${Given} value=${one.reason || one.event} most=${220} /></${Link}></div></div>`;
}

function More(/** @type {{more: any[]}} */ { more }) {
  if (!more.length) return null;
  const others = [...new Set(more.map((one) => one.resource))].slice(0, 4).join(", ");
  return html` <span class="muted small" title=${plain(others)}>and ${counted(more.length, "other")} within seconds</span>`;
}

function done(/** @type {any} */ one, /** @type {any[]} */ more) {
  return html`<span class="event-badge"><${Badge} word=${one.event.replace(/^(monitor|message) /, "")} tone=${one.severity === "alarm" ? "deny" : one.severity === "warning" ? "warn" : "note"} /></span><div class="event-body">
    <div><strong><${Given} value=${one.detail.monitor} most=${60} /></strong> <span class="muted">on</span> <${Given} value=${one.resource} most=${80} mono /><${More} more=${more} /></div>
    <div class="event-reason"><${Link} to=${`/console/audit/${one.id}`}><${Given} value=${one.reason || one.detail.category || one.event} most=${200} /></${Link}></div></div>`;
}
