/** One recording: its triggers, its time line, and the messages and events at the selected time. */

import { html, useEffect, useRef, useState } from "#console/html.js";
import { clock, iso, lasting, Moment } from "#console/moments.js";
import { bytes, counted } from "#console/numbers.js";
import { Badge } from "#console/parts/badge.js";
import { Given } from "#console/parts/given.js";
import { Host } from "#console/parts/host.js";
import { Icon } from "#console/parts/icon.js";
import { Failure, Loading, Notice } from "#console/parts/notice.js";
import { useResource } from "#console/parts/resource.js";
import { get } from "#console/rest.js";
import { go, Link, place } from "#console/router.js";
import { useKeys } from "#console/shortcuts.js";
import { useStore } from "#console/store.js";
import { COLUMNS, Lanes } from "./lanes.js";
import { Messages } from "./messages.js";
import { Remove, Taking } from "./taking.js";
import { kindOf } from "./times.js";

const SHORTEST = 1e8; // shortest shown period, in nanoseconds
const SHOWN = 100; // most shown events

/** @param {{id: string}} given */
export function RecordingPage({ id }) {
  const path = `/v1/recordings/${encodeURIComponent(id)}`;
  const { value: row, error, again } = useResource((signal) => get(path, {}, signal), [path]);
  const head = html`<div class="head"><${Link} to="/console/recordings" class="button plain" aria-label="All recordings"><${Icon} name="back" /></${Link}><h1>Recording</h1>
    ${row && html`<span class="head-sub"><${Moment} at=${row.began / 1e9} />, ${lasting((row.ended - row.began) / 1e9)}, ${counted(row.topics.length, "topic")}, ${bytes(row.size)}</span>
      <div class="head-actions"><${Taking} row=${row} /><${Remove} row=${row} gone=${() => go("/console/recordings")} /></div>`}</div>`;
  if (error) return html`${head}<${Failure} error=${error} retry=${again} />`;
  if (!row) return html`${head}<section class="panel"><${Loading} rows=${8} /></section>`;
  return html`${head}${!row.complete && html`<div class="standing"><${Notice} tone="warn" title="It is not complete"><${Given} value=${row.why_not} most=${600} /></${Notice}></div>`}<${Incident} row=${row} path=${path} />`;
}

function Incident(/** @type {{row: any, path: string}} */ { row, path }) {
  const { query } = useStore(place);
  const record = query.get("record") ?? row.triggers[0].record;
  const trigger = row.triggers.find((/** @type {any} */ one) => one.record === record);
  const [part, setPart] = useState({ since: row.began, until: row.ended, around: record }); // `around`: the record whose events are listed
  const [{ at, about }, setAt] = useState({ at: trigger?.time ?? row.began, about: trigger ? record : null }); // `about`: the record that set the time
  const [topics, setTopics] = useState(/** @type {string[]} */ ([]));
  const line = useResource((signal) => get(`${path}/timeline`, { since: iso(part.since), until: iso(part.until), columns: COLUMNS, record: part.around }, signal), [path, part]);
  const events = line.value?.events ?? [];
  const chosen = (about && events.find((/** @type {any} */ one) => one.record === about)) ?? null;
  const move = (/** @type {number} */ time) => setAt({ at: time, about: null });
  const pick = (/** @type {any} */ event) => {
    setAt({ at: event.time, about: event.record });
    go(`/console/recordings/${row.id}?record=${event.record}`, { replace: true });
  };
  const placed = useRef(trigger ? record : ""); // the record that set the selected time
  useEffect(() => {
    const known = events.find((/** @type {any} */ one) => one.record === record);
    if (!known && line.value && part.around !== record) setPart({ ...part, around: record });
    if (!known || placed.current === record) return;
    placed.current = record;
    setAt({ at: known.time, about: record });
  }, [record, events]);
  useSteps(events, at, pick);
  const all = () => setPart({ since: row.began, until: row.ended, around: about ?? record });
  const zoom = (/** @type {number} */ factor) => {
    const span = Math.min(row.ended - row.began, Math.max(SHORTEST, (part.until - part.since) * factor));
    const since = Math.min(row.ended - span, Math.max(row.began, at - span / 2));
    setPart({ since, until: since + span, around: about ?? record });
  };
  return html`<section class="panel" aria-labelledby="line"><div class="panel-head"><h2 id="line">Time line</h2><span class="muted small">${lasting((part.until - part.since) / 1e9)} shown</span>
      <span class="end"><button class="button small" aria-label="Nearer" title="Nearer (+)" onClick=${() => zoom(1 / 3)}><${Icon} name="plus" size=${16} /></button><button class="button small" aria-label="Farther" title="Farther (-)" onClick=${() => zoom(3)}><${Icon} name="minus" size=${16} /></button><button class="button small" onClick=${all} title="All of it (0)">All</button></span></div>
      ${line.error ? html`<div class="panel-body"><${Failure} error=${line.error} retry=${line.again} /></div>` : !line.value ? html`<${Loading} rows=${8} />`
        : html`<${Lanes} line=${line.value} at=${at} move=${move} zoom=${zoom} all=${all} topics=${topics} choose=${setTopics} about=${chosen?.resource ?? null} />`}</section>
    <div class="incident-grid"><${Events} line=${line.value} chosen=${chosen} pick=${pick} row=${row} />
      <div class="stack">${chosen && html`<${Event} event=${chosen} />`}<${Messages} path=${path} at=${at} record=${about} topics=${topics} clear=${() => setTopics([])} span=${(part.until - part.since) / 1e9} /></div></div>`;
}

function Events(/** @type {any} */ { line, chosen, pick, row }) {
  const [most, setMost] = useState(SHOWN);
  const events = line?.events ?? [];
  const list = useRef(/** @type {HTMLElement | null} */ (null));
  const place = events.indexOf(chosen);
  useEffect(() => {
    if (place >= most) setMost(place + SHOWN);
    const row = /** @type {HTMLElement | null} */ (list.current?.children[place]);
    if (list.current && row) list.current.scrollTop = row.offsetTop - list.current.offsetTop - row.offsetHeight; // the page does not scroll
  }, [place, most]);
  const span = (row.ended - row.began) / 1e9;
  return html`<section class="panel" aria-labelledby="happened"><div class="panel-head"><h2 id="happened">What happened</h2><span class="muted small end">j, k: next, previous</span></div>
    ${!line ? html`<${Loading} />` : !events.length ? html`<p class="panel-body muted">Only messages in this period.</p>`
      : html`<ul class="event-list tall happened" ref=${list}>${events.slice(0, most).map((/** @type {any} */ one) => html`<li key=${one.record} class=${`event${one === chosen ? " chosen" : ""}`}>
        <button class="event-pick" aria-pressed=${String(one === chosen)} onClick=${() => pick(one)}><span class="event-time mono small">${clock(one.time / 1e9, span)}</span><span class="event-badge"><${Badge} word=${one.kind === "notice" ? "else" : one.kind} tone=${kindOf(one.kind).tone} />${one.times > 1 && html` <span class="count-badge">${counted(one.times, "time")}</span>`}</span>
        <span class="event-body"><${Given} value=${one.resource} mono most=${80} none="" /> <span class="event-reason"><${Given} value=${one.reason || one.event} most=${140} /></span></span></button></li>`)}</ul>
        ${events.length > most ? html`<div class="panel-body"><button class="button" onClick=${() => setMost(most + SHOWN)}>More events</button></div>` : null}
        ${line.more_events > 0 && html`<p class="panel-body muted small">${counted(line.more_events, "further event")} in this period: zoom in to list them.</p>`}`}</section>`;
}

function Event(/** @type {{event: any}} */ { event }) {
  return html`<section class="panel" aria-labelledby="chosen"><div class="panel-head"><h2 id="chosen"><${Given} value=${event.event} /></h2><${Badge} word=${event.decision ?? event.severity} /><span class="end"><${Link} class="button small" to=${`/console/audit/${event.record}`}>Audit record</${Link}></span></div>
    <div class="panel-body stack-tight"><p class="record-reason"><${Given} value=${event.reason} most=${600} none="no reason given" /></p>
    <dl class="facts"><dt>Node</dt><dd><${Given} value=${event.caller_id} mono most=${200} /></dd><dt>Host</dt><dd><${Host} value=${event.host} /></dd><dt>About</dt><dd><${Given} value=${event.resource} mono most=${200} /></dd><dt>When</dt><dd><${Moment} at=${iso(event.time)} /></dd></dl></div></section>`;
}

/** The keys j and k move through the events, starting at the selected time. */
function useSteps(/** @type {any[]} */ events, /** @type {number} */ at, /** @type {(event: any) => void} */ pick) {
  useKeys((key) => {
    const next = key === "j" ? events.find((one) => one.time > at) : key === "k" ? events.findLast((one) => one.time < at) : null;
    if (next) pick(next);
    return Boolean(next);
  });
}
