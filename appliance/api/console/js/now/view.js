/** Now: state, rates, denials and alarms. */

import { html } from "../html.js";
import { live } from "../live.js";
import { inOwnZone, lasting, Moment } from "../moments.js";
import { count, counted, growth, lately } from "../numbers.js";
import { useApplianceTime } from "../parts/ago.js";
import { Badge } from "../parts/badge.js";
import { FeatureParts } from "../parts/features.js";
import { By, Given } from "../parts/given.js";
import { Loading } from "../parts/notice.js";
import { Plot } from "../parts/plot.js";
import { Link } from "../router.js";
import { useKeys } from "../shortcuts.js";
import { useAge } from "../standing.js";
import { useStore } from "../store.js";
import { Alarms, placeOf } from "./alarms.js";
import { Doings, Refusals } from "./lists.js";
import { Situation } from "./situation.js";

const SPAN = 900;
const DROPS = 1; // index in the counts of a monitor: verdicts, drops, changes, faults

export function Now() {
  const status = useStore(live, (one) => one.status);
  const alarms = useStore(live, (one) => one.alarms);
  const now = useApplianceTime();
  useKeys((key) => {
    const step = { j: 1, k: -1 }[key];
    if (!step) return false;
    const entries = /** @type {HTMLElement[]} */ ([...document.querySelectorAll("main :is(.alarm-text, .event-reason a)")]);
    const at = entries.indexOf(/** @type {HTMLElement} */ (document.activeElement));
    entries[at < 0 ? 0 : Math.min(entries.length - 1, Math.max(0, at + step))]?.focus();
    return true;
  });
  if (!status) return html`<div class="head"><h1>Now</h1></div><section class="panel"><${Loading} /></section>`;
  return html`<div class="head"><h1>Now</h1><span class="head-sub">running for ${now === null ? "…" : lasting(now - status.since)}</span></div>
    <${Situation} /><${Alarms} alarms=${alarms} />
    <${Health} status=${status} alarms=${alarms} />
    <div class="now-grid">
      <div class="stack"><${Curves} /><${Refusals} /></div>
      <div class="stack"><${FeatureParts} place="now" status=${status} /><${Doings} /><${Processes} status=${status} /></div>
    </div>`;
}

function Health(/** @type {{status: any, alarms: any[]}} */ { status, alarms }) {
  const grave = alarms.filter((one) => one.severity === "alarm").length;
  const warnings = alarms.filter((one) => one.severity === "warning").length;
  const { old } = useAge();
  const state = old ? ["", "Not known"] : grave ? ["deny", "Needs attention"] : warnings ? ["warn", "In service, with warnings"] : ["allow", "In service"];
  const first = alarms.find((one) => one.severity !== "notice");
  const isolation = status.isolation === "none" ? "isolation none: ports of nodes stay open" : `isolation ${status.isolation}`;
  const { policy, monitors, ipsec, audit } = status;
  const broken = Object.keys(monitors.left_out).length;
  return html`<section class="cards" aria-label="Health">
    <${Card} name="Appliance" to=${first ? placeOf(first) : "/console/now"} tone=${state[0]} figure=${state[1]} words>${first ? html`<${Given} value=${inOwnZone(first.text)} most=${120} />` : isolation}</${Card}>
    <${Card} name="Policy" to="/console/policy" figure=${`Revision ${policy.revision}`} words tone=${policy.confirm_by ? "warn" : ""}>${policy.confirm_by ? "rolls back unless confirmed" : html`<${By} who=${policy.who} most=${30} />${policy.differs_from_file ? ", differs from the file" : ""}`}</${Card}>
    <${Card} name="Nodes" to="/console/graph" figure=${count(status.nodes)}>${counted(status.topics, "topic")}, ${counted(status.services, "service")}${status.shadows ? `, ${status.shadows} lost` : ""}</${Card}>
    <${Card} name="Monitors enabled" to="/console/monitors" figure=${`${monitors.enabled} of ${monitors.loaded}`} tone=${broken || monitors.held.length || monitors.failing.length ? "deny" : ""}>${broken ? `${counted(broken, "file")} with an error` : monitors.held.length ? `${monitors.held.length} hold their topics` : monitors.failing.length ? `${monitors.failing.length} failing` : "none held, none failing"}</${Card}>
    <${Card} name="Tunnels up" to="/console/hosts" figure=${`${ipsec.up} of ${ipsec.enrolled}`}>${ipsec.enrolled ? "enrolled hosts" : "no host is enrolled"}</${Card}>
    <${Card} name="Audit log" to="/console/audit" words tone=${audit.failed ? "deny" : audit.degraded || audit.forwarding?.trouble ? "warn" : ""} figure=${audit.failed ? "Not written" : audit.degraded ? "Degraded" : audit.forwarding?.trouble ? "Not forwarded" : "Written"}>${audit.lag_records ? `${counted(audit.lag_records, "record")} waiting, ${audit.lag_seconds.toFixed(1)} s` : "nothing waiting"}</${Card}>
  </section>`;
}

function Card(/** @type {any} */ { name, to, figure, tone = "", words = false, children }) {
  return html`<${Link} to=${to} class=${`card ${tone}`}><span class="card-name">${name}</span><span class=${words ? "card-words" : "card-figure"}>${figure}</span><span class="card-more">${children}</span></${Link}>`;
}

function Curves() {
  const samples = useStore(live, (one) => one.samples);
  const series = (/** @type {string} */ name, /** @type {any} */ colour, /** @type {(one: any) => number} */ read) => ({ name, colour, points: growth(samples, read), lately: lately(samples, read) });
  return html`<section class="panel" aria-labelledby="curves"><div class="panel-head"><h2 id="curves">Rates, last 15 minutes</h2></div>
    <div class="panel-body plots">
      <div><h3>Decisions</h3><${Plot} label="Decisions" span=${SPAN} series=${[series("allowed", "c1", (one) => one.allowed), series("denied", "c2", (one) => one.denied)]} /></div>
      <div><h3>Messages through the relay</h3><${Plot} label="Messages" span=${SPAN} series=${[series("relayed", "c3", (one) => one.messages), series("dropped by monitors", "c2", droppedByMonitors), series("missed by slow subscribers", "c4", (one) => one.dropped)]} /></div>
    </div></section>`;
}

function droppedByMonitors(/** @type {import("../live.js").Sample} */ sample) {
  return Object.values(sample.monitors).reduce((sum, counts) => sum + counts[DROPS], 0);
}

function Processes(/** @type {{status: any}} */ { status }) {
  const restarted = status.processes.filter((/** @type {any} */ one) => one.restarts).length;
  return html`<section class="panel" aria-labelledby="processes"><details><summary class="panel-head"><h2 id="processes">Processes</h2><span class="muted small">${counted(status.processes.length, "process", "processes")}${restarted ? `, ${restarted} restarted` : ""}</span></summary>
    <div class="table-wrap"><table class="table"><thead><tr><th>Role</th><th class="number">Process</th><th>Since</th><th class="number">Restarts</th></tr></thead>
    <tbody>${numbered(status.processes).map(({ name, one }) => html`<tr key=${name}><td><${Given} value=${name} /></td><td class="number">${one.pid}</td><td class="nowrap"><${Moment} at=${one.since} /></td>
      <td class="number">${one.restarts ? html`<${Badge} word=${String(one.restarts)} tone="warn" />` : "0"}</td></tr>`)}</tbody></table></div></details></section>`;
}

/** Processes with the names that `rosrv status` prints: processes of one role are numbered from 0. @param {any[]} processes @returns {{name: string, one: any}[]} */
export function numbered(processes) {
  return processes.map((one, at) => {
    const same = (/** @type {any} */ other) => other.role === one.role;
    return { name: processes.filter(same).length > 1 ? `${one.role} ${processes.slice(0, at).filter(same).length}` : one.role, one };
  });
}
