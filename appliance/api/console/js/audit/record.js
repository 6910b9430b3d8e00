/** One record: the decision and its reason, the rule in the policy, a monitor's changes, records around it. */

import { isDecided } from "../categories.js";
import { Block } from "../hosts/block.js";
import { html, useEffect, useRef, useState } from "../html.js";
import { iso, Moment } from "../moments.js";
import { Badge, Outcome, requested } from "../parts/badge.js";
import { Copy } from "../parts/copy.js";
import { Given } from "../parts/given.js";
import { Host, Sentence } from "../parts/host.js";
import { Icon } from "../parts/icon.js";
import { Failure, Loading } from "../parts/notice.js";
import { useResource } from "../parts/resource.js";
import { Rule } from "../parts/rule.js";
import { FeatureParts } from "../parts/features.js";
import { get } from "../rest.js";
import { go, Link } from "../router.js";
import { plain } from "../words.js";
import { Change } from "./change.js";
import { Excerpt } from "./excerpt.js";
import { auditPath } from "./filters.js";
import { Grant } from "./grant.js";
import { Why } from "./why.js";

const [FIRST_TIME, LAST_TIME] = [1e17, 4.1e18]; // nanoseconds: the years 1973 to 2099
const ID = /^[0-9a-f]{20}$/;
const GIVEN = new Set(["revoked", "connection refused"]);
const SHOWN_APART = new Set(["before", "after", "before_fields", "after_fields", "at", "timer", "conditions", "values", "handler", "why"]);
const MONITORS = new Set(["monitor verdict", "message dropped", "message changed", "monitor fault", "monitor called", "monitor published", "shadow observed", "stop begun", "stop ended"]);

/** @param {{id: string, filter: Record<string, string>}} given */
export function RecordPanel({ id, filter }) {
  const { value, error, again } = useResource((signal) => get(`/v1/audit/${encodeURIComponent(id)}`, { neighbours: 6 }, signal), [id]);
  const box = useRef(/** @type {HTMLElement | null} */ (null));
  useEffect(() => {
    if (matchMedia("(max-width: 1240px)").matches) box.current?.scrollIntoView({ block: "start" });
  }, [id, value !== null]);
  useEffect(() => box.current?.focus({ preventScroll: true }), []);
  const close = () => go(auditPath(filter));
  return html`<section class="panel record" aria-labelledby="record" tabindex="-1" ref=${box}>
    <div class="panel-head"><h2 id="record">Record ${value ? value.record.sequence : ""}</h2><span class="end"><button class="button plain small" onClick=${close} aria-label="Close the record"><${Icon} name="close" size=${16} /></button></span></div>
    ${error ? html`<div class="panel-body"><${Failure} error=${error} retry=${again} /></div>` : !value ? html`<${Loading} rows=${6} />` : html`<${Shown} shown=${value} filter=${filter} />`}</section>`;
}

function Shown(/** @type {{shown: any, filter: Record<string, string>}} */ { shown, filter }) {
  const { record, before, after } = shown;
  const [raw, setRaw] = useState(false);
  const detail = Object.entries(record.detail).filter(([name]) => !SHOWN_APART.has(name));
  return html`<div class="panel-body stack">
    <div class="stack-tight"><div class="row"><${Outcome} record=${record} /><strong><${Given} value=${record.event} /></strong><span class="muted"><${Moment} at=${record.time} /></span></div>
      <p class="record-reason"><${Sentence} value=${record.reason} most=${1000} none="no reason given" /></p></div>
    <dl class="facts">
      <dt>Node</dt><dd><${Given} value=${record.caller_id} mono most=${300} /></dd><dt>Host</dt><dd><${Host} value=${record.host} /></dd>
      <dt>Category</dt><dd><${Given} value=${record.category} /></dd><dt>Resource</dt><dd><${Given} value=${record.resource} mono most=${300} /></dd>
      <dt>Severity</dt><dd><${Badge} word=${record.severity} /></dd>
      ${record.duration_us !== null && html`<dt>Decided in</dt><dd>${record.duration_us} µs</dd>`}
      ${record.revision !== null && html`<dt>Policy</dt><dd>revision ${record.revision}</dd>`}
      ${record.decision && html`<dt>Rule</dt><dd><${Rule} rule=${record.rule} revision=${record.revision} keys="p" /></dd>`}
    </dl>
    ${((MONITORS.has(record.event) && !record.detail.count) || isDenial(record)) && html`<${Why} key=${record.id} id=${record.id} />`}
    ${record.rule && record.revision !== null && html`<${Excerpt} rule=${record.rule} revision=${record.revision} />`}
    <div class="row">${record.decision && isDecided(record.category) && html`<${Link} class="button" to=${explain(record)}>Explain in the policy</${Link}>`}
      ${record.host && isDenial(record) && html`<${Block} host=${record.host}>Block this host…</${Block}>`}</div>
    ${isDenial(record) && (isDecided(record.category) || GIVEN.has(record.event)) && html`<${Grant} key=${record.id} id=${record.id} />`}
    <${FeatureParts} key=${`t${record.id}`} place="record" record=${record} />
    ${(record.detail.before || record.detail.after) && html`<div><h3>Message</h3><${Change} detail=${record.detail} /></div>`}
    ${detail.length > 0 && html`<div><h3>Details</h3><dl class="facts">${detail.map(([name, value]) => html`<dt key=${name}><${Given} value=${name} most=${40} /></dt><dd><${Detail} name=${name} value=${value} filter=${filter} /></dd>`)}</dl></div>`}
    <${Around} title="Before it, by the same host or node" records=${before} filter=${filter} /><${Around} title="After it, by the same host or node" records=${after} filter=${filter} />
    <div class="stack-tight"><div class="row"><button class="button small" aria-expanded=${String(raw)} onClick=${() => setRaw(!raw)}>${raw ? "Hide JSON" : "Show JSON"}</button><span class="muted small mono">${record.id}</span><${Copy} text=${record.id} what="id" /></div>
      ${raw && html`<pre class="bytes">${plain(JSON.stringify(record, null, 2), 20_000).replaceAll("⟨LF⟩", "\n")}</pre>`}</div>
  </div>`;
}

/** A field of the record's detail. Times are nanoseconds since the epoch. @param {{name: string, value: any, filter: Record<string, string>}} given */
function Detail({ name, value, filter }) {
  if (typeof value === "number" && value > FIRST_TIME && value < LAST_TIME) return html`<${Moment} at=${iso(value)} />`;
  const to = { recorded_id: auditPath(filter, String(value)), recording: `/console/recordings/${value}` }[name];
  if (to && ID.test(value)) return html`<${Link} to=${to} class="mono">${value}</${Link}>`;
  return html`<${Given} value=${typeof value === "string" ? value : JSON.stringify(value)} most=${800} mono />`;
}

function isDenial(/** @type {any} */ record) {
  return record.decision === "deny" || record.decision === "would deny" || record.event === "rate limited" || record.event === "denials folded";
}

function Around(/** @type {{title: string, records: any[], filter: Record<string, string>}} */ { title, records, filter }) {
  if (!records.length) return null;
  return html`<div><h3>${title}</h3><ul class="around">${records.map((one) => html`<li key=${one.id}><span class="muted nowrap"><${Link} to=${auditPath(filter, one.id)}><${Moment} at=${one.time} /></${Link}></span><${Outcome} record=${one} />
    <span><${Given} value=${one.event === "decision" ? requested(one) : one.event} /> <${Given} value=${one.resource} mono most=${80} none="" /></span></li>`)}</ul></div>`;
}

function explain(/** @type {any} */ record) {
  const words = new URLSearchParams({ tab: "explain", host: record.host ?? "", node: record.caller_id ?? "", category: record.category ?? "", resource: record.resource ?? "" });
  return `/console/policy?${words}`;
}
