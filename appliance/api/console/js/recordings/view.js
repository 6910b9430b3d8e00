/** The flight recorder's recordings: triggers and contents; a single recording on its time line. */

import { html, useState } from "../html.js";
import { live } from "../live.js";
import { lasting, Moment } from "../moments.js";
import { bytes, count, counted } from "../numbers.js";
import { Badge } from "../parts/badge.js";
import { Button } from "../parts/button.js";
import { Dialog } from "../parts/dialog.js";
import { Field } from "../parts/field.js";
import { Given } from "../parts/given.js";
import { Icon } from "../parts/icon.js";
import { Empty, Failure, Loading } from "../parts/notice.js";
import { useResource } from "../parts/resource.js";
import { done, failed } from "../parts/toast.js";
import { Problem } from "../problem.js";
import { ask, get } from "../rest.js";
import { Link, place } from "../router.js";
import { useStore } from "../store.js";
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
  const size = rows.reduce((sum, row) => sum + row.size, 0);
  return html`<div class="head"><h1>Recordings</h1>${value && html`<span class="head-sub">${counted(rows.length, "recording")}, ${bytes(size)}</span>`}
      <div class="head-actions"><${RecordNow} disabled=${off || !running} /></div></div>
    <section class="panel" aria-label="Recordings">
      ${off ? html`<${Empty} icon="recordings" title="The flight recorder is off">With <code>recorder: {enabled: true}</code> in appliance.yaml it keeps the robot's messages of the minute before an event.</${Empty}>`
        : error ? html`<div class="panel-body"><${Failure} error=${error} retry=${again} /></div>` : !value ? html`<${Loading} rows=${6} />`
        : !rows.length ? html`<${Empty} icon="recordings" title="No recording yet">A message dropped by a monitor, an alarm and the other triggers in <code>recorder.triggers</code> start one; so does Record now.</${Empty}>`
        : html`<div class="table-wrap"><table class="table stacked"><thead><tr><th>Began</th><th>Why</th><th class="number">Lasts</th><th class="number">Messages</th><th class="number">Size</th><th>State</th><th><span class="sr-only">Actions</span></th></tr></thead>
          <tbody>${rows.slice(0, shown).map((row) => html`<${Row} key=${row.id} row=${row} again=${again} />`)}</tbody></table></div>
          ${rows.length > shown && html`<div class="panel-body"><button class="button" onClick=${() => setShown(shown + PAGE)}>Older recordings</button></div>`}`}
    </section>`;
}

function Row(/** @type {{row: any, again: () => void}} */ { row, again }) {
  const [why, ...more] = row.triggers;
  const messages = row.topics.reduce((/** @type {number} */ sum, /** @type {any} */ one) => sum + one.messages, 0);
  return html`<tr><td class="first"><${Link} to=${`/console/recordings/${row.id}`}><${Moment} at=${row.began / 1e9} /></${Link}></td>
    <td class="why" data-label="Why"><span><${Badge} word=${why.what} tone=${kindOf(why.what).tone} /> <${Given} value=${why.text} most=${120} />${more.length > 0 && html` <span class="muted">and ${counted(more.length, "more", "more")}</span>`}</span></td>
    <td class="number nowrap" data-label="Lasts">${lasting((row.ended - row.began) / 1e9)}</td><td class="number" data-label="Messages"><span>${count(messages)} <span class="muted small nowrap">of ${counted(row.topics.length, "topic")}</span></span></td><td class="number nowrap" data-label="Size">${bytes(row.size)}</td>
    <td data-label="State">${row.complete ? html`<${Badge} word="complete" tone="allow" />` : html`<${Badge} word="incomplete" tone="warn" title=${row.why_not} />`}</td>
    <td><div class="row taking"><${Taking} row=${row} small /><${Remove} row=${row} small gone=${again} /></div></td></tr>`;
}

function RecordNow(/** @type {{disabled: boolean}} */ { disabled }) {
  const [open, setOpen] = useState(false);
  const [note, setNote] = useState("");
  const [after, setAfter] = useState("");
  const seconds = after.trim() === "" ? null : Number(after);
  const record = async () => {
    try {
      const { body } = await ask("POST", "/v1/recordings", { match: "*", json: { note, after: seconds } });
      done("It is being recorded", `Until ${new Date(body.ends / 1e6).toLocaleTimeString()}, or longer if more happens; then it is listed here.`);
      setNote("");
    } catch (failure) {
      failed(failure);
    }
    setOpen(false);
  };
  return html`<${Button} role="operator" tone="primary" disabled=${disabled} why="The flight recorder is not running" onClick=${() => setOpen(true)}><${Icon} name="recordings" size=${16} />Record now</${Button}>
    ${open && html`<${Dialog} title="Record the robot's messages" close=${() => setOpen(false)} foot=${html`<button class="button" onClick=${() => setOpen(false)}>Not now</button><${Button} role="operator" tone="primary" disabled=${seconds !== null && !(seconds > 0)} why="Enter a number of seconds above 0" onClick=${record}>Record</${Button}>`}>
      <p>Records the last seconds, from memory, and the next ones.</p><${Field} label="What happened" value=${note} set=${setNote} placeholder="The arm hit the door" maxlength="300" />
      <${Field} label="Seconds to record from now" value=${after} set=${setAfter} placeholder="as configured" inputmode="decimal" /></${Dialog}>`}`;
}
