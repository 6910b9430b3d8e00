/** Audit: search and follow the log, open a record, verify and export the log. */

import { html, useEffect, useMemo, useRef, useState } from "../html.js";
import { counted } from "../numbers.js";
import { Icon } from "../parts/icon.js";
import { Empty, Failure, Loading } from "../parts/notice.js";
import { go, place } from "../router.js";
import { useKeys } from "../shortcuts.js";
import { useStore } from "../store.js";
import { DeniedHosts } from "./denied_hosts.js";
import { auditPath, filterOf, Filters } from "./filters.js";
import { Presets } from "./presets.js";
import { Evidence, Export, Verify } from "./proof.js";
import { RecordPanel } from "./record.js";
import { asksForAll, rowsOf, useRecords } from "./records.js";
import { shownOf } from "./rows.js";
import { RecordTable } from "./table.js";
import { Timeline } from "./timeline.js";

export function Audit() {
  const { rest: chosen, query } = useStore(place);
  const filter = filterOf(query);
  const [following, setFollowing] = useState(false);
  const { records, cursor, notes, error, loading, standing, older, again } = useRecords(filter, following);
  const rows = useMemo(() => rowsOf(filter, records ?? []), [records]);
  const [open, setOpen] = useState(/** @type {Set<string>} */ (new Set())); // ids of records whose row is open
  const opened = (/** @type {import("./rows.js").Row} */ row) => row.records.length > 1 && row.records.some((one) => open.has(one.id));
  const toggle = (/** @type {import("./rows.js").Row} */ row) => {
    const ids = row.records.map((one) => one.id);
    setOpen(opened(row) ? new Set([...open].filter((id) => !ids.includes(id))) : new Set([...open, ...ids]));
  };
  useSteps(rows.flatMap((row) => (opened(row) ? row.records.map((one) => [one]) : [[shownOf(row), ...row.records]])), chosen, filter);
  useReturn(chosen);
  return html`<div class="head audit-head"><h1>Audit</h1><span class="head-sub" role="status">${records === null ? "" : `${counted(records.length, "record")} shown${rows.length < records.length ? ` in ${counted(rows.length, "row")}` : ""}${cursor ? ", more below" : ""}`}</span>
      <div class="head-actions">
        <button class="button" aria-pressed=${String(following)} onClick=${() => setFollowing(!following)}><${Icon} name=${following ? "pause" : "play"} size=${16} />${following ? "Following" : "Follow live"}</button>
        <${Verify} /><${Export} filter=${filter} /><${Evidence} filter=${filter} /></div></div>
    <${Presets} filter=${filter} />
    <${Filters} filter=${filter} record=${chosen} />
    ${following && standing && standing.state !== "live" && standing.reason && html`<div class="banner" role="status"><${Icon} name="warn" />Following is interrupted: ${standing.reason} Retrying automatically.</div>`}
    ${filter.decision === "deny" && asksForAll(filter) && html`<section class="panel spaced" aria-labelledby="denied-hosts"><div class="panel-head"><h2 id="denied-hosts">Denied hosts</h2></div><${DeniedHosts} since=${filter.since} until=${filter.until} mark=${records?.[0]?.sequence ?? 0} /></section>`}
    <div class=${`audit-grid${chosen ? " with-record" : ""}`}>
      <section class="panel" aria-label="Records" aria-busy=${String(loading)}>
        ${error ? html`<div class="panel-body"><${Failure} error=${error} retry=${again} /></div>` : null}
        ${records === null ? (error ? null : html`<${Loading} rows=${10} />`) : !records.length ? html`<${Empty} icon="audit" title="No record matches">${notes.length ? notes.join(" · ") : Object.keys(filter).length ? "Remove a filter, or search further back." : "The log is empty."}</${Empty}>`
          : html`<${Timeline} records=${records} chosen=${chosen} filter=${filter} /><${RecordTable} rows=${rows} opened=${opened} toggle=${toggle} chosen=${chosen} filter=${filter} />${cursor ? html`<div class="panel-body"><button class="button" onClick=${older}>Older records</button></div>` : null}`}
      </section>
      ${chosen && html`<${RecordPanel} key=${chosen} id=${chosen} filter=${filter} />`}
    </div>`;
}

/** j and k move through what is listed, Escape closes the open record. @param {any[][]} listed the records that each place stands for */
function useSteps(listed, /** @type {string} */ chosen, /** @type {Record<string, string>} */ filter) {
  useKeys((key) => {
    const step = { j: 1, k: -1 }[key];
    if (key === "Escape" && chosen) go(auditPath(filter));
    else if (step && listed.length) {
      const at = listed.findIndex((some) => some.some((one) => one.id === chosen || String(one.sequence) === chosen));
      go(auditPath(filter, listed[at < 0 ? 0 : Math.min(listed.length - 1, Math.max(0, at + step))][0].id));
    } else return false;
    return true;
  });
}

/** When a record closes, the focus that was in it returns to its row. */
function useReturn(/** @type {string} */ chosen) {
  const before = useRef(chosen);
  useEffect(() => {
    const closed = before.current;
    before.current = chosen;
    if (chosen || !closed || document.activeElement !== document.body) return;
    const name = CSS.escape(closed);
    /** @type {HTMLElement | null} */ (document.querySelector(`tr:is([data-id="${name}"], [data-sequence="${name}"]) a`) ?? document.getElementById("main"))?.focus();
  }, [chosen]);
}
