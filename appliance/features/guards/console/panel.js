/** Guards on the robot's page: states, margins, the map of each fence, and a button for each verb of `rosrv guard`. */

import { html, useState } from "#console/html.js";
import { Moment } from "#console/moments.js";
import { counted } from "#console/numbers.js";
import { useApplianceTime } from "#console/parts/ago.js";
import { Badge } from "#console/parts/badge.js";
import { Button } from "#console/parts/button.js";
import { Dialog } from "#console/parts/dialog.js";
import { Field } from "#console/parts/field.js";
import { Given } from "#console/parts/given.js";
import { Icon } from "#console/parts/icon.js";
import { useLook } from "#console/parts/look.js";
import { Empty, Failure, Loading, Notice } from "#console/parts/notice.js";
import { done } from "#console/parts/toast.js";
import { ask } from "#console/rest.js";
import { Link } from "#console/router.js";
import { Beliefs } from "./belief.js";
import { CheckDriver } from "./driver.js";
import { Area } from "./area.js";
import { margins } from "./margins.js";
import { Margins } from "./meter.js";
import { begins, Held } from "./situation.js";
import { useGuards } from "./state.js";
import { Suggest } from "./suggest.js";
import { SetValues } from "./values.js";

const TONES = { free: "allow", stopping: "deny", withholding: "", holding: "deny", shadow: "note", off: "", broken: "deny" };
const WITHIN = /** @type {[string, string][]} */ ([["60", "unless confirmed within 1 minute"], ["300", "unless confirmed within 5 minutes"], ["3600", "unless confirmed within an hour"], ["", "never"]]);
const WATCHED = 6; // topics that are watched at once: control answers eight queries at a time

export function Guards() {
  const guards = useGuards();
  const { body, error, heard, again } = guards;
  const rows = body?.guards ?? [];
  const topics = /** @type {string[]} */ ([...new Set(rows.flatMap((/** @type {any} */ one) => [one.topics.by, one.topics.command].filter(Boolean)))].slice(0, WATCHED));
  const { looking, turn, seen, error: unseen } = useLook(topics);
  const [open, setOpen] = useState("");
  const close = () => setOpen("");
  return html`<section class="panel" aria-labelledby="guards"><div class="panel-head"><h2 id="guards">Guards</h2>${body && html`<span class="muted small">${counted(rows.length, "guard")}</span>`}
      <span class="end">${rows.length > 0 && html`<${Button} small role="operator" aria-pressed=${String(looking)} title="Reads positions and commands for a minute; the audit log records it" onClick=${turn}><${Icon} name=${looking ? "pause" : "play"} size=${14} />${looking ? "Stop watching" : "Watch"}</${Button}>`}
        <${Button} small role="admin" title="Measures whether the driver stops the base when commands end" onClick=${() => setOpen("driver")}><${Icon} name="check" size=${14} />Check the driver</${Button}>
        <${Button} small tone=${rows.length ? "" : "primary"} onClick=${() => setOpen("suggest")}><${Icon} name="plus" size=${14} />Suggest guards</${Button}></span></div>
    ${unseen ? html`<div class="panel-body"><${Failure} error=${unseen} /></div>` : null}
    ${body?.warnings.map((/** @type {string} */ one) => html`<div key=${one} class="panel-body"><${Notice} tone="warn"><${Given} value=${one} most=${400} /></${Notice}></div>`)}
    ${error ? html`<div class="panel-body"><${Failure} error=${error} retry=${again} heard=${heard} /></div>` : null}
    ${!body ? (error ? null : html`<${Loading} rows=${3} />`)
      : !rows.length ? html`<${Empty} icon="robot" title="No guard">A guard stops the robot when its commands end, when it leaves a fence or drives too fast. Suggest guards reads the graph and proposes them.</${Empty}>`
      : html`<div class="table-wrap"><table class="table stacked"><thead><tr><th>Guard</th><th>State</th><th>Guards</th><th>How close it came</th><th class="number">Stopped</th><th><span class="sr-only">Actions</span></th></tr></thead>
        <tbody>${rows.map((/** @type {any} */ one) => html`<${Guard} key=${one.name} guard=${one} guards=${guards} seen=${seen} />`)}</tbody></table></div>`}
    ${rows.filter((/** @type {any} */ one) => one.loads.polygon).map((/** @type {any} */ one) => html`<div key=${one.name} class="panel-body"><h3><${Given} value=${one.name} most=${60} /></h3><${Area} guard=${one} seen=${seen} /></div>`)}
    ${open === "suggest" && html`<${Suggest} guards=${guards} close=${close} />`}${open === "driver" && html`<${CheckDriver} close=${close} />`}</section>`;
}

function Guard(/** @type {{guard: any, guards: ReturnType<typeof useGuards>, seen: Record<string, any[]>}} */ { guard, guards, seen }) {
  const [open, setOpen] = useState("");
  const close = () => setOpen("");
  const now = useApplianceTime();
  const preset = guards.body.presets.find((/** @type {any} */ one) => one.preset === guard.preset);
  const path = `/v1/monitors/${encodeURIComponent(guard.name)}`;
  const turn = (/** @type {string} */ said, /** @type {string} */ more, /** @type {any} */ json) => guards.order(`${guard.name} ${said}`, more, "PATCH", path, { json });
  const found = margins(guard, seen);
  return html`<tr data-guard=${guard.name}>
    <td class="first"><${Link} to=${`/console/monitors/${encodeURIComponent(guard.name)}`}><strong><${Given} value=${guard.name} most=${60} /></strong></${Link}><div class="muted small">${guard.preset === guard.name ? "" : `${guard.preset}: `}${preset?.what}</div>
      ${guard.origin !== "current" && html`<div class="small"><${Badge} word=${guard.origin} tone="warn" /> ${guard.origin === "older" ? `the text of ${guard.preset} ${guard.version}; the present version is ${preset?.version}` : "not the text of the preset"}</div>`}</td>
    <td data-label="State"><span>${guard.state === "stopping" && guard.last_stop && !begins(guard, now) ? html`<${Held} guard=${guard} />` : html`<${Badge} word=${guard.state} tone=${TONES[/** @type {keyof typeof TONES} */ (guard.state)]} />`}${(guard.why_held || guard.error) && html`<div class="small muted"><${Given} value=${guard.why_held || guard.error} most=${200} /></div>`}
      ${guard.off_until && html`<div class="small muted">until <${Moment} at=${guard.off_until} /></div>`}${guard.confirm_by && html`<div class="small muted">returns to shadow mode at <${Moment} at=${guard.confirm_by} />, unless confirmed</div>`}
      <div><${Button} small tone="plain" role="operator" title="The guard's variables, such as the position that it has; the audit log records it" onClick=${() => setOpen("values")}>Values…</${Button}></div></span></td>
    <td data-label="Guards"><span><${Given} value=${guard.topics.command} mono most=${60} />${guard.topics.by && html`<div class="small muted">by <${Given} value=${guard.topics.by} mono most=${60} /></div>`}</span></td>
    <td data-label="Margins">${found.length ? html`<${Margins} margins=${found} />` : html`<span class="muted small">${"–"}</span>`}</td>
    <td class="number" data-label=${guard.state === "shadow" ? "Would stop" : "Stopped"}>${guard.state === "shadow" ? html`<span class="muted" title="would have stopped">(${guard.stops})</span>` : guard.stops}</td>
    <td><div class="row row-end guard-verbs">
      ${guard.state === "holding" && !guard.error && html`<${Button} small role="operator" tone="primary" onClick=${() => turn("is resumed", "Its topics are released.", { held: false })}>Resume</${Button}>`}
      ${guard.state === "shadow" && html`<${Button} small role="operator" tone="primary" onClick=${() => setOpen("enforce")}>Enforce</${Button}>`}
      ${guard.confirm_by && html`<${Button} small role="operator" tone="primary" onClick=${() => guards.order(`${guard.name} stays in force`, "It is confirmed.", "POST", "/v1/monitors/confirm")}>Confirm</${Button}>`}
      ${guard.state === "off" && html`<${Button} small role="operator" tone="primary" onClick=${() => turn("is in force", "It acts from now on.", { enabled: true })}>Turn on</${Button}>`}
      <${Button} small role="operator" onClick=${() => setOpen("set")}>Set…</${Button}>
      ${guard.origin === "older" && html`<${Button} small role="admin" onClick=${() => setOpen("upgrade")}>Upgrade</${Button}>`}
      ${guard.state !== "shadow" && guard.state !== "holding" && html`<${Button} small role="operator" onClick=${() => setOpen("shadow")}>Shadow</${Button}>`}
      <${Button} small role="admin" tone="danger" onClick=${() => setOpen("remove")}>Remove</${Button}></div>
      ${open === "values" && html`<${Beliefs} guard=${guard} close=${close} />`}
      ${open === "set" && html`<${SetValues} guard=${guard} preset=${preset} seen=${seen} guards=${guards} close=${close} />`}
      ${open === "enforce" && html`<${Enforce} guard=${guard} guards=${guards} path=${path} close=${close} />`}
      ${open === "shadow" && html`<${Confirm} title=${`Put ${guard.name} into shadow mode?`} verb="Shadow mode" role="operator" tone="danger" close=${close} act=${() => turn("is in shadow mode", "It only records what it would have done.", { shadow: true })}>
        <p>It stops the robot no longer: it only records what it would have done.</p></${Confirm}>`}
      ${open === "upgrade" && html`<${Confirm} title=${`Upgrade ${guard.name}?`} verb="Upgrade" role="admin" close=${close} act=${() => guards.order(`${guard.name} is upgraded`, "It begins in its initial state.", "POST", `/v1/guards/${encodeURIComponent(guard.name)}/upgrade`)}>
        <p>It is made again from ${guard.preset} ${preset?.version}, with its topics and values, and begins again: the base is stopped until the next command. <code>rosrv guard upgrade ${guard.name} --dry-run</code> reports the differences.</p></${Confirm}>`}
      ${open === "remove" && html`<${Confirm} title=${`Remove ${guard.name}?`} verb="Remove" role="admin" tone="danger" close=${close} act=${() => guards.order(`${guard.name} is removed`, "", "DELETE", path, { undo: guard.origin === "current" ? bringBack(guard) : undefined })}>
        <p>It stops the robot no longer. The file <code><${Given} value=${guard.file} /></code> on disk is kept: remove it there also, or the next reload loads it again.</p></${Confirm}>`}</td></tr>`;
}

/**
 * A function that makes a removed guard again, in its initial state, unless the specifications have changed since. One that
 * was off, or in force until it is confirmed, comes back in shadow mode. @param {any} guard
 */
function bringBack({ name, preset, topics, types, given, loads, state, confirm_by }) {
  const constants = given.filter((/** @type {any} */ one) => one.kind !== "topic").map((/** @type {any} */ one) => [one.name, String(one.value)]);
  const shadow = state === "shadow" || state === "off" || confirm_by !== null;
  const json = { name, preset, topics, types, values: { ...Object.fromEntries(constants), ...loads }, shadow };
  return async (/** @type {string} */ tag) => {
    await ask("POST", "/v1/guards", { json, match: `"${tag}"` });
    done(`${name} is back`, shadow ? "It is in shadow mode: it only records." : "It begins in its initial state.");
  };
}

function Enforce(/** @type {{guard: any, guards: ReturnType<typeof useGuards>, path: string, close: () => void}} */ { guard, guards, path, close }) {
  const [within, setWithin] = useState("300");
  const said = within ? "It acts from now on, and returns to shadow mode unless you confirm it." : "It acts from now on.";
  const act = () => guards.order(`${guard.name} is in force`, said, "PATCH", path, { json: { shadow: false }, query: { confirm_within: within } });
  return html`<${Confirm} title=${`Bring ${guard.name} into force?`} verb="Enforce" role="operator" close=${close} act=${act}>
    <p>It stops the robot from now on. In shadow mode it would have stopped, changed or sent ${counted(guard.stops, "message")}.</p>
    <${Field} label="Back to shadow mode" value=${within} set=${setWithin} options=${WITHIN} /></${Confirm}>`;
}

function Confirm(/** @type {{title: string, verb: string, role: "operator" | "admin", tone?: string, close: () => void, act: () => Promise<boolean>, children?: any}} */ { title, verb, role, tone = "primary", close, act, children }) {
  const go = async () => {
    close();
    await act();
  };
  return html`<${Dialog} title=${title} close=${close} foot=${html`<button class="button" onClick=${close}>Not now</button><${Button} role=${role} tone=${tone} onClick=${go}>${verb}</${Button}>`}>${children}</${Dialog}>`;
}
