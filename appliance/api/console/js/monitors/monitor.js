/** One monitor: state, actions over time, events, properties and specification. */

import { html, useState } from "../html.js";
import { live } from "../live.js";
import { Moment } from "../moments.js";
import { count, counted, lately } from "../numbers.js";
import { attempt } from "../parts/attempt.js";
import { Badge } from "../parts/badge.js";
import { Button } from "../parts/button.js";
import { Dialog } from "../parts/dialog.js";
import { Editor } from "../parts/editor.js";
import { Check, Field } from "../parts/field.js";
import { Given } from "../parts/given.js";
import { Icon } from "../parts/icon.js";
import { Empty, Failure, Loading, Notice } from "../parts/notice.js";
import { Plot } from "../parts/plot.js";
import { Signature } from "../parts/signature.js";
import { useResource } from "../parts/resource.js";
import { Tabs } from "../parts/tabs.js";
import { done } from "../parts/toast.js";
import { ask, get, send } from "../rest.js";
import { go, Link } from "../router.js";
import { may } from "../session.js";
import { useStore } from "../store.js";
import { useSpecification } from "./draft.js";
import { Outcome } from "./report.js";
import { counters, countOf, stateOf } from "./state.js";
import { Enforce, MonitorSwitch, Resume } from "./switches.js";

/** @param {{name: string, row: any, monitors: any}} given `row` is undefined for a monitor that is not loaded */
export function MonitorPage({ name, row, monitors }) {
  const path = `/v1/monitors/${encodeURIComponent(name)}`;
  const { value, error, again } = useResource((signal) => get(path, {}, signal), [path, monitors.body.revision]);
  const [removing, setRemoving] = useState(false);
  const head = html`<div class="head"><${Link} to="/console/monitors" class="button plain" aria-label="All monitors"><${Icon} name="back" /></${Link}><h1><${Given} value=${name} most=${80} /></h1>
    ${row && html`<${Badge} word=${stateOf(row)} /><span class="head-sub"><${Given} value=${row.file} mono most=${80} /></span>
      <div class="head-actions">${row.held && !row.error && html`<${Resume} row=${row} monitors=${monitors} />`}${(row.shadow || !row.enabled) && html`<${Enforce} row=${row} monitors=${monitors} />`}<span class="row"><span class="small muted">Enabled</span><${MonitorSwitch} row=${row} monitors=${monitors} /></span>
        <${Button} role="admin" tone="danger" onClick=${() => setRemoving(true)}>Remove</${Button}></div>`}</div>`;
  if (!row) return html`${head}<section class="panel"><${Empty} icon="monitors" title="This monitor is not loaded">It may have been removed. Its actions are still in the <${Link} to=${`/console/audit?category=monitor&text=${encodeURIComponent(name)}`}>audit log</${Link}>.</${Empty}></section>`;
  const held = row.error ? html`<${Notice} tone="deny" role="alert" title=${`It does nothing${row.held ? ", and holds its topics" : ""}: its file has an error`}><${Given} value=${row.error} most=${400} />. Load a corrected <${Given} value=${row.file} mono most=${80} /></${Notice}>` : row.held && html`<${Notice} tone="deny" role="alert" title="It holds its topics, and drops every message there">${row.why_held || "its relay process was restarted"}. When it is safe, resume it: <code>rosrv monitor resume ${name}</code></${Notice}>`;
  return html`${head}${held}
    <div class="policy-grid"><div class="stack"><${Verdicts} name=${name} row=${row} />${error ? html`<${Failure} error=${error} retry=${again} />` : !value ? html`<section class="panel"><${Loading} /></section>` : html`<${Specification} key=${`${value.file} ${value.text}`} monitor=${value} monitors=${monitors} />`}</div>
      <div class="stack">${value && html`<${About} monitor=${value} path=${path} />`}<${History} path=${path} row=${row} /></div></div>
    ${removing && html`<${Remove} name=${name} row=${row} path=${path} monitors=${monitors} close=${() => setRemoving(false)} />`}`;
}

function Verdicts(/** @type {{name: string, row: any}} */ { name, row }) {
  const samples = useStore(live, (one) => one.samples);
  const [span, setSpan] = useState(900);
  const series = /** @type {any[]} */ ([["verdicts", "c1", 0], ["dropped", "c2", 1], ["changed", "c3", 2], ["faults", "c4", 3]]).map(([word, colour, place]) => ({ name: word, colour, points: counters(samples, name, place), lately: lately(samples, countOf(name, place)) }));
  return html`<section class="panel" aria-labelledby="verdicts"><div class="panel-head"><h2 id="verdicts">Activity</h2><span class="end">${[[900, "15 min"], [3600, "1 h"]].map(([seconds, word]) => html`<button key=${word} class="button small" aria-pressed=${String(span === seconds)} onClick=${() => setSpan(Number(seconds))}>${word}</button>`)}</span></div>
    <div class="panel-body stack"><dl class="figures">${[["Events", row.events], ["Verdicts", row.verdicts], ...(row.shadow ? [["Would have dropped", row.would_drop], ["Would have changed", row.would_change], ["Missed", row.missed]] : [["Dropped", row.drops], ["Changed", row.changes]]), ["Faults", row.faults], ...(row.slice_limit ? [["Slices", row.slices], ["Slice limit", row.slice_limit]] : [])].map(([word, value]) => html`<div key=${word}><dt>${word}</dt><dd>${count(value)}</dd></div>`)}</dl>
      <${Plot} label=${`What ${name} does`} series=${series} span=${span} /></div></section>`;
}

function Specification(/** @type {{monitor: any, monitors: any}} */ { monitor, monitors }) {
  const draft = useSpecification(monitor.text, monitor.file);
  const [note, setNote] = useState("");
  const [signature, setSignature] = useState("");
  const [asking, setAsking] = useState(false);
  const [hold, setHold] = useState(false);
  const [line, setLine] = useState(/** @type {any} */ (null));
  const changed = draft.text !== monitor.text;
  const files = { [monitor.file]: draft.text };
  const signatures = { [monitor.file]: signature };
  const dry = () => draft.send(files, { dry: true, signatures });
  const load = async () => {
    const body = await draft.send(files, { dry: false, note, signatures, hold, match: monitors.etag });
    setAsking(false);
    if (body) {
      done(`Revision ${body.revision} of the specifications is in force`, body.changed.join(", "));
      await monitors.again();
    }
  };
  const findings = draft.report || draft.findings.length || draft.error ? draft.findings : monitor.warnings;
  return html`<section class="panel" aria-labelledby="specification"><div class="panel-head"><h2 id="specification">Specification</h2>${changed && html`<${Badge} word="changed here, not loaded" tone="warn" />`}
      <span class="end">${changed && html`<button class="button small plain" onClick=${() => draft.write(monitor.text)}>Discard</button>`}<${Button} small role="operator" onClick=${dry} title="Compile and check (Ctrl S)">Dry run</${Button}><${Button} small role="admin" tone="primary" disabled=${!changed} why="The text is unchanged" onClick=${() => setAsking(true)}>Replace</${Button}></span></div>
    ${draft.stale && html`<div class="panel-body"><${Notice} tone="warn" title="Another text of this file came into force while you wrote">Replace puts yours in its place; Discard shows it.</${Notice}></div>`}
    ${(draft.report || draft.error || findings.length > 0) && html`<div class="panel-body"><${Outcome} report=${draft.report} error=${draft.error} findings=${findings} pick=${(/** @type {any} */ one) => setLine({ number: one.line, column: one.column, count: (line?.count ?? 0) + 1 })} /></div>`}
    <${Editor} label=${`Specification ${monitor.file}`} language="rv" value=${draft.text} change=${draft.write} findings=${findings} line=${line} dry=${() => may("operator") && dry()} height="46vh" />
    ${asking && html`<${Dialog} title=${`Replace ${monitor.file}?`} close=${() => setAsking(false)} foot=${html`<button class="button" onClick=${() => setAsking(false)}>Not yet</button><${Button} role="admin" tone="primary" onClick=${load}>Replace</${Button}>`}>
      <p>The specification is compiled and replaced between two messages. Monitors of this file start in their initial state; others keep theirs.</p><${Field} label="Comment" value=${note} set=${setNote} placeholder="Reason or ticket number" maxlength="200" />
      <${Check} label="Load even if monitors then hold topics with traffic, until they are resumed" on=${hold} set=${setHold} />
      <${Signature} asked=${monitors.body.site_keys.length > 0} value=${signature} set=${setSignature} /></${Dialog}>`}</section>`;
}

function About(/** @type {{monitor: any, path: string}} */ { monitor, path }) {
  const [tab, setTab] = useState(monitor.properties.length ? "properties" : "events");
  return html`<section class="panel" aria-label="About the monitor"><${Tabs} label="About the monitor" tabs=${[["properties", `Properties ${monitor.properties.length}`], ["events", `Events ${monitor.alphabet.length}`]]} chosen=${tab} choose=${setTab}>
    ${tab === "events" ? html`<div class="table-wrap"><table class="table"><thead><tr><th>Event</th><th>On</th><th class="number">Line</th></tr></thead><tbody>${monitor.alphabet.map((/** @type {any} */ one) => html`<tr key=${`${one.name}${one.line}`}><td><code><${Given} value=${one.name} /></code></td>
        <td>${one.topic ? html`<${Given} value=${one.topic} mono /><div class="muted small"><${Given} value=${one.type} most=${80} />${one.part && ` (${one.part})`}</div>` : `every ${one.every} s`}</td><td class="number">${one.line}</td></tr>`)}</tbody></table></div>`
      : !monitor.properties.length ? html`<${Empty} icon="monitors" title="No properties">This monitor acts only in its events.</${Empty}>`
      : html`<div class="panel-body stack">${monitor.properties.map((/** @type {any} */ one, /** @type {number} */ index) => html`<div key=${index} class="stack-tight"><div class="row"><${Badge} word=${one.logic} tone="note" /><span class="muted small">handles ${one.handled.join(", ") || "nothing"}</span></div><pre class="bytes"><${Given} value=${one.formula} most=${1500} /></pre>${monitor.certificates[index] && html`<p class="muted small"><${Given} value=${monitor.certificates[index].replace(/^\w+: /, "")} most=${200} /></p>`}</div>`)}
        ${monitor.properties.some((/** @type {any} */ one) => one.drawn) && html`<${Picture} path=${path} name=${monitor.name} />`}</div>`}</${Tabs}></section>`;
}

/** The automata as an image, never as part of the page. */
function Picture(/** @type {{path: string, name: string}} */ { path, name }) {
  const { value } = useResource(async (signal) => (await send("GET", `${path}/picture`, { signal })).text(), [path]);
  if (!value) return null;
  return html`<img class="automaton" alt=${`Automata of ${name}`} src=${`data:image/svg+xml;charset=utf-8,${encodeURIComponent(value)}`} />`;
}

function History(/** @type {{path: string, row: any}} */ { path, row }) {
  const mark = [row.verdicts, row.drops, row.changes, row.faults, row.enabled, row.shadow, row.would_drop, row.would_change].join();
  const { value, error, again } = useResource((signal) => get(`${path}/history`, { limit: 200 }, signal), [path, mark]);
  return html`<section class="panel" aria-labelledby="history"><div class="panel-head"><h2 id="history">Latest actions</h2><span class="end"><${Link} class="small" to=${`/console/audit?category=monitor&text=${encodeURIComponent(row.name)}`}>In the audit log</${Link}></span></div>
    ${error ? html`<div class="panel-body"><${Failure} error=${error} retry=${again} /></div>` : !value ? html`<${Loading} /> ` : !value.happened.length ? html`<${Empty} icon="monitors" title="Nothing yet">Verdicts, dropped and changed messages appear here.</${Empty}>`
      : html`<ul class="event-list tall">${value.happened.slice(0, 40).map((/** @type {any} */ one) => html`<li key=${one.sequence} class="event"><span class="event-time"><${Link} to=${`/console/audit/${one.sequence}`}><${Moment} at=${one.time} /></${Link}></span><span class="event-badge"><${Badge} word=${one.category ?? one.event.replace(/^(monitor|message|trial) /, "")} tone=${tone(one)} /></span>
        <div class="event-body"><${Given} value=${one.resource} mono most=${60} />${one.count ? html` <span class="muted">${counted(one.count, "more", "more")}</span>` : ""}<div class="event-reason"><${Given} value=${one.reason} most=${200} none="" /></div></div></li>`)}</ul>`}</section>`;
}

function tone(/** @type {any} */ one) {
  return { "message dropped": "warn", "monitor fault": "deny", "message changed": "note", "stop begun": "warn", "stop ended": "note", "monitor verdict": "note" }[/** @type {string} */ (one.event)] ?? "";
}

function Remove(/** @type {any} */ { name, row, path, monitors, close }) {
  const others = monitors.body.monitors.filter((/** @type {any} */ one) => one.file === row.file && one.name !== name).map((/** @type {any} */ one) => one.name);
  const remove = () => attempt(async () => {
    const { body } = await ask("DELETE", path, { match: monitors.etag });
    done(`${row.file} is removed`, `Revision ${body.revision} of the specifications is in force.`);
    go("/console/monitors");
    await monitors.again();
  }, close);
  return html`<${Dialog} title=${`Remove ${name}?`} close=${close} foot=${html`<button class="button" onClick=${close}>Keep it</button><${Button} role="admin" tone="danger" onClick=${remove}>Remove</${Button}>`}>
    <p>Its topics are no longer monitored. The file <code><${Given} value=${row.file} /></code> on disk is kept.</p>
    ${others.length > 0 && html`<p>This also removes the other monitors of this file: <${Given} value=${others.join(", ")} most=${200} />.</p>`}</${Dialog}>`;
}
