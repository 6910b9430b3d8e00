/** The denials by host, the most first, as `rosrv audit summary` prints them. */

import { html, useEffect, useMemo, useState } from "../html.js";
import { Moment } from "../moments.js";
import { count, counted } from "../numbers.js";
import { Given } from "../parts/given.js";
import { Host } from "../parts/host.js";
import { Failure } from "../parts/notice.js";
import { useResource } from "../parts/resource.js";
import { get } from "../rest.js";
import { Link } from "../router.js";
import { plain } from "../words.js";
import { auditPath } from "./filters.js";

const SHOWN = 5;
const MOST_COUNTED = 200;
const FOLDER = /\s\/\S*\/(?=[^/\s]+:\d+$)/; // of the policy's file, before its name and line
const EVERY = 30_000; // milliseconds between two summaries while denials arrive
const LATER = 300_000; // and while none do: what is older than the period leaves it

/** @param {{since: string, until?: string, mark: unknown, title?: string}} given `mark`: another one after a new denial; the block is empty without denials */
export function DeniedHosts({ since, until, mark, title = "" }) {
  const seen = useSlowly(mark);
  const { value, error, again } = useResource((signal) => get("/v1/audit/summary", { since, until, limit: SHOWN }, signal), [since, until, seen]);
  if (error) return html`<div class="panel-body"><${Failure} error=${error} retry=${again} /></div>`;
  if (!value?.hosts.length) return null;
  const filter = Object.fromEntries(Object.entries({ decision: "deny", since, until }).filter(([, one]) => one));
  return html`<div class="table-wrap"><table class="table stacked denied-hosts" aria-label="Denials by host"><thead><tr><th>Host</th><th class="number">Denials${title}</th><th>Most often</th><th>Last</th></tr></thead>
    <tbody>${value.hosts.map((/** @type {any} */ one) => html`<tr key=${one.host}><td class="first"><${Link} to=${auditPath({ ...filter, host: one.host })}><${Host} value=${one.host} /></${Link}>
        <div class="muted small">${one.callers.length ? html`<${Given} value=${one.callers.map((/** @type {any} */ caller) => caller.name).join(", ")} most=${80} mono />${one.more_callers ? ` and ${count(one.more_callers)} more` : ""}` : "no name"}</div></td>
      <td class="number" data-label="Denials">${count(one.count)}</td>
      <td data-label="Most often"><div>${one.reasons.map((/** @type {any} */ reason) => html`<div key=${reason.name} class="small"><span title=${plain(reason.name, 300)}><${Given} value=${reason.name.replace(FOLDER, " ")} most=${120} /></span> <span class="muted">${counted(reason.count, "time")}</span></div>`)}
        ${one.more_reasons > 0 && html`<div class="muted small">and ${counted(one.more_reasons, "other reason")}</div>`}</div></td>
      <td class="nowrap" data-label="Last"><div><${Moment} at=${one.last} /><div class="muted small">since <${Moment} at=${one.first} /></div></div></td></tr>`)}</tbody></table></div>
    ${value.more_hosts > 0 && html`<p class="panel-body muted small">${counted(value.more_hosts, "further host")} with ${counted(value.more_denials, "denial")}.</p>`}
    ${value.counted_since && html`<p class="panel-body muted small">Records before <${Moment} at=${value.counted_since} /> are not counted, as there are too many.</p>`}`;
}

/** The number of denials of each host in the last hour: the newest records alone would be too few. @param {unknown} mark as for `DeniedHosts` */
export function useDeniedCounts(mark) {
  const seen = useSlowly(mark);
  const { value } = useResource((signal) => get("/v1/audit/summary", { since: "1h", limit: MOST_COUNTED }, signal), [seen]);
  return useMemo(() => new Map(/** @type {[string, number][]} */ ((value?.hosts ?? []).map((/** @type {any} */ one) => [one.host, one.count]))), [value]);
}

/** Another value after a new mark, but at most one every `EVERY`, and without one after `LATER`. */
function useSlowly(/** @type {unknown} */ mark) {
  const [seen, setSeen] = useState({ mark, at: 0 });
  useEffect(() => {
    const timer = setTimeout(() => setSeen({ mark, at: Date.now() }), seen.mark === mark ? LATER : Math.max(0, seen.at + EVERY - Date.now()));
    return () => clearTimeout(timer);
  }, [mark, seen]);
  return seen;
}
