/** The flight recorder's recordings: triggers and contents; a single recording on its time line. */

import { html, useState } from "#console/html.js";
import { live } from "#console/live.js";
import { lasting, Moment } from "#console/moments.js";
import { bytes, counted } from "#console/numbers.js";
import { attempt } from "#console/parts/attempt.js";
import { Badge } from "#console/parts/badge.js";
import { Button } from "#console/parts/button.js";
import { Dialog } from "#console/parts/dialog.js";
import { Field } from "#console/parts/field.js";
import { Given } from "#console/parts/given.js";
import { Host } from "#console/parts/host.js";
import { Icon } from "#console/parts/icon.js";
import { Empty, Failure, Loading } from "#console/parts/notice.js";
import { useResource } from "#console/parts/resource.js";
import { done } from "#console/parts/toast.js";
import { Problem } from "#console/problem.js";
import { ask, get } from "#console/rest.js";
import { Link, place } from "#console/router.js";
import { useStore } from "#console/store.js";
import { RecordingPage } from "./recording.js";
import { Remove, Taking } from "./taking.js";
import { kindOf } from "./times.js";

const PAGE = 50;

export function Recordings() {
  const { rest } = useStore(place);
  const kept = useStore(live, (one) => JSON.stringify(one.status?.recorder ?? null));
  const list = useResource((signal) => get("/v1/recordings", {}, signal), [kept]);
  if (rest) return html`<${RecordingPage} key=${rest} id=${rest} />`;
  return html`<${List} ...${list} running=${Boolean(JSON.parse(kept)?.running)} />`;
}

function List(/** @type {{value: any, error: unknown, again: () => void, running: boolean}} */ { value, error, again, running }) {
  const [shown, setShown] = useState(PAGE);
  const off = error instanceof Problem && error.status === 404;
  const rows = [...(value?.recordings ?? [])].reverse();
  const making = value?.in_progress ?? [];
  const groups = alike(rows);
  const size = rows.reduce((sum, row) => sum + row.size, 0);
  return html`<div class="head"><h1>Recordings</h1>${value && html`<span class="head-sub">${counted(rows.length, "recording")}, ${bytes(size)}${making.length ? `, ${making.length} being made` : ""}</span>`}
      <div class="head-actions"><${RecordNow} disabled=${off || !running} /></div></div>
    <section class="panel" aria-label="Recordings">
      ${off ? html`<${Empty} icon="recordings" title="The flight recorder is off">With <code>recorder: {enabled: true}</code> in appliance.yaml it keeps the robot's messages of the minute before an event.</${Empty}>`
        : error ? html`<div class="panel-body"><${Failure} error=${error} retry=${again} /></div>` : !value ? html`<${Loading} rows=${6} />`
        : !rows.length && !making.length ? html`<${Empty} icon="recordings" title="No recording yet">A message dropped by a monitor, an alarm and the other triggers in <code>recorder.triggers</code> start one; so does Record now.</${Empty}>`
        : html`<div class="table-wrap"><table class="table stacked"><thead><tr><th>What happened</th><th>Began</th><th class="number">Lasts</th><th class="number">Contents</th><th class="number">Size</th><th>State</th><th><span class="sr-only">Actions</span></th></tr></thead>
          <tbody>${making.map((/** @type {any} */ one) => html`<${Making} key=${one.id} one=${one} />`)}${groups.slice(0, shown).map((some) => html`<${Alike} key=${some[some.length - 1].id} rows=${some} again=${again} />`)}</tbody></table></div>
          ${groups.length > shown && html`<div class="panel-body"><button class="button" onClick=${() => setShown(shown + PAGE)}>Older recordings</button></div>`}`}
    </section>`;
}

/** Recordings with equal first triggers in a row, newest first. @param {any[]} rows */
export function alike(rows) {
  /** @type {any[][]} */
  const found = [];
  for (const row of rows) {
    const equal = row.triggers[0].equal;
    if (equal && found.at(-1)?.[0].triggers[0].equal === equal) /** @type {any[]} */ (found.at(-1)).push(row);
    else found.push([row]);
  }
  return found;
}

function Making(/** @type {{one: any}} */ { one }) {
  return html`<tr><td class="first why"><${Why} why=${one.trigger} /></td><td data-label="Began"><${Moment} at=${one.began / 1e9} /></td>
    <td colspan="3" data-label="Lasts"><span>until <${Moment} at=${one.ends / 1e9} />, or later if more happens</span></td><td data-label="State"><${Badge} word="being made" tone="note" /></td><td></td></tr>`;
}

function Alike(/** @type {{rows: any[], again: () => void}} */ { rows, again }) {
  const [open, setOpen] = useState(false);
  const count = rows.length > 1 && html`<button class="count-badge" aria-expanded=${String(open)} title=${open ? "Show the last one only" : "Show each recording"} onClick=${() => setOpen(!open)}>${counted(rows.length, "recording")}<${Icon} name=${open ? "minus" : "plus"} size=${12} /></button>`;
  return html`<${Row} row=${rows[0]} first=${rows[rows.length - 1]} count=${count} again=${again} />${open && rows.slice(1).map((row) => html`<${Row} key=${row.id} row=${row} part again=${again} />`)}`;
}

/** The first trigger. @param {{why: any, to?: string, count?: any, more?: number}} given `to`: the recording's page; `more`: further triggers */
function Why({ why, to, count, more = 0 }) {
  const name = why.monitor || why.resource ? html`${why.monitor && html`<strong><${Given} value=${why.monitor} most=${60} /></strong>`}${why.monitor && why.resource && " on "}${why.resource && html`<${Given} value=${why.resource} most=${80} mono />`}` : html`<${Given} value=${why.text} most=${120} />`;
  return html`<div class="row"><${Badge} word=${why.what} tone=${kindOf(why.what).tone} />${to ? html`<${Link} to=${to}>${name}</${Link}>` : html`<span>${name}</span>`}
      ${(why.caller_id || why.host) && html`<span class="muted">by <${Given} value=${why.caller_id} most=${60} mono none="no name" /> of <${Host} value=${why.host} none="no address" /></span>`}${count}</div>
      ${(why.monitor || why.resource) && html`<div class="muted"><${Given} value=${why.text} most=${160} />${more > 0 && html` <span class="small">and ${counted(more, "more", "more")}</span>`}</div>`}`;
}

/** @param {{row: any, first?: any, count?: any, part?: boolean, again: () => void}} given `first`: the oldest of the recordings that the row stands for */
function Row({ row, first = row, count, part = false, again }) {
  const [why, ...more] = row.triggers;
  const messages = row.topics.reduce((/** @type {number} */ sum, /** @type {any} */ one) => sum + one.messages, 0);
  return html`<tr class=${part ? "part" : ""}><td class="first why"><${Why} why=${why} to=${`/console/recordings/${row.id}`} count=${count} more=${more.length} /></td>
    <td data-label="Began"><span><${Moment} at=${row.began / 1e9} />${first !== row && html` <span class="muted small nowrap">since <${Moment} at=${first.began / 1e9} /></span>`}</span></td>
    <td class="number nowrap" data-label="Lasts">${lasting((row.ended - row.began) / 1e9)}</td>
    <td class="number" data-label="Contents"><span>${counted(messages, "message")} <span class="muted small nowrap">of ${counted(row.topics.length, "topic")}</span></span></td>
    <td class="number" data-label="Size"><span><span class="nowrap">${bytes(row.size)}</span> <span class="muted small mono">${row.id}</span></span></td>
    <td data-label="State">${row.complete ? html`<${Badge} word="complete" tone="allow" />` : html`<${Badge} word="incomplete" tone="warn" title=${row.why_not} />`}</td>
    <td><div class="row taking"><${Taking} row=${row} small /><${Remove} row=${row} small gone=${again} /></div></td></tr>`;
}

function RecordNow(/** @type {{disabled: boolean}} */ { disabled }) {
  const [open, setOpen] = useState(false);
  const [note, setNote] = useState("");
  const [after, setAfter] = useState("");
  const seconds = after.trim() === "" ? null : Number(after);
  const record = () => attempt(async () => {
    const { body } = await ask("POST", "/v1/recordings", { match: "*", json: { note, after: seconds } });
    done("It is being recorded", `Until ${new Date(body.ends / 1e6).toLocaleTimeString()}, or longer if more happens; then it is listed here.`);
    setNote("");
  }, () => setOpen(false));
  return html`<${Button} role="operator" tone="primary" disabled=${disabled} why="The flight recorder is not running" onClick=${() => setOpen(true)}><${Icon} name="recordings" size=${16} />Record now</${Button}>
    ${open && html`<${Dialog} title="Record the robot's messages" close=${() => setOpen(false)} foot=${html`<button class="button" onClick=${() => setOpen(false)}>Not now</button><${Button} role="operator" tone="primary" disabled=${seconds !== null && !(seconds > 0)} why="Enter a number of seconds above 0" onClick=${record}>Record</${Button}>`}>
      <p>Records the last seconds, from memory, and the next ones.</p><${Field} label="What happened" value=${note} set=${setNote} placeholder="The arm hit the door" maxlength="300" />
      <${Field} label="Seconds to record from now" value=${after} set=${setAfter} placeholder="as configured" inputmode="decimal" /></${Dialog}>`}`;
}
