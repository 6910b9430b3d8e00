/** The two appliances and the witness: a panel, and a banner on every view while something is wrong. */

import { html } from "#console/html.js";
import { live } from "#console/live.js";
import { lasting, Moment } from "#console/moments.js";
import { counted } from "#console/numbers.js";
import { Badge } from "#console/parts/badge.js";
import { Fact } from "#console/parts/fact.js";
import { Given } from "#console/parts/given.js";
import { Icon } from "#console/parts/icon.js";
import { useStore } from "#console/store.js";
import { SwitchOver } from "./switch.js";

const SILENT = 5; // seconds, as in features/standby/standby_summary.py
const GRAVE = ["both-active", "not-serving", "standby-refuses", "standby-unready", "standby-unchecked", "standby-away", "standby-behind", "witness-refuses", "witness-silent", "standby-blind", "witness-disk", "follower-trouble"];

/** The panel on Now. @param {{status: any}} given */
export function PairNow({ status }) {
  return status.standby && html`<${Pair} state=${status.standby} orders />`;
}

/** The panel. @param {{state: any, orders?: boolean}} given `orders`: with the button for the switchover */
export function Pair({ state, orders = false }) {
  const { other, witness, obstacle, troubles } = state;
  const active = state.role === "active";
  return html`<section class="panel" aria-labelledby="pair"><div class="panel-head"><h2 id="pair">Two appliances</h2>
      ${orders && html`<span class="end"><${SwitchOver} state=${state} /></span>`}</div>
    <div class="table-wrap"><table class="table"><thead><tr><th>Appliance</th><th>State</th></tr></thead><tbody>
      <tr><${Name} name=${state.name} address=${state.address} more="this one" /><td><${Badge} word=${state.role} tone=${active ? "allow" : "note"} /><div class="muted small">since <${Moment} at=${state.since} />, epoch ${state.epoch}</div>${active ? null : html`<${Obstacle} text=${obstacle} />`}</td></tr>
      <tr><${Name} name=${other.name} address=${other.address} /><td>${active ? html`<${Follower} other=${other} troubles=${troubles} />` : html`<${Leader} other=${other} />`}</td></tr>
      <tr><${Name} name="Witness" address=${witness.address} more="on the robot" /><td><${Witness} witness=${witness} name=${state.name} active=${active} /></td></tr>
    </tbody></table></div>
    <div class="panel-body small muted">Nodes reach the active appliance at <${Given} value=${state.fixed} mono />.${active ? ` ${waits(state)}` : ""}</div></section>`;
}

/** Whether the standby could take over, in the situation: at once, while an alarm waits a minute for a machine that is updated. */
export function Ready() {
  const state = useStore(live, (one) => one.status?.standby);
  if (!state) return null;
  const { other, troubles } = state;
  const [words, why] = !other.connected ? [`is away${other.trouble_seconds === null ? "" : ` for ${lasting(other.trouble_seconds)}`}`, other.reason]
    : troubles.length ? ["cannot take over", troubles[0]] : other.in_sync ? ["can take over", ""] : ["is behind: it cannot take over", ""];
  const wrong = !other.connected || troubles.length > 0 || !other.in_sync;
  return html`<${Fact} name="Standby" to="/console/now" show="pair" tone=${wrong ? "warn" : ""}><${Given} value=${other.name} most=${40} /> <span class=${wrong ? "" : "muted"}>${words}</span>${why && html`<div class="muted small"><${Given} value=${why} most=${100} /></div>`}</${Fact}>`;
}

/** The most urgent condition of the two appliances. */
export function PairBanner() {
  const alarm = useStore(live, (one) => one.alarms.find(({ kind }) => GRAVE.includes(kind)));
  return alarm ? html`<${Banner} text=${alarm.text} />` : null;
}

/** A condition of the two appliances. */
export function Banner(/** @type {{text: string}} */ { text }) {
  return html`<div class="banner" role="status"><${Icon} name="warn" /><span><${Given} value=${text} most=${400} /></span></div>`;
}

function Name(/** @type {{name: string, address: string, more?: string}} */ { name, address, more }) {
  return html`<td class="first"><strong><${Given} value=${name} most=${40} /></strong>${more && html` <span class="muted small">${more}</span>`}<div class="small"><${Given} value=${address} mono /></div></td>`;
}

/** The standby, as the active appliance sees it. */
function Follower(/** @type {{other: any, troubles: string[]}} */ { other, troubles }) {
  if (!other.connected) return html`<${Away} other=${other} />`;
  if (other.in_sync) return troubles.length ? html`<${Obstacle} text=${troubles[0]} />` : html`<${Badge} word="in sync" tone="allow" /><div class="muted small">can take over</div>`;
  const lag = other.behind_changes ? `${counted(other.behind_changes, "change")}, ${counted(other.behind_bytes, "byte")}` : "the last changes";
  return html`<${Badge} word="behind" tone="warn" /><div class="muted small">lacks ${lag}; cannot take over</div>`;
}

/** Why the standby cannot take over, although it follows. */
function Obstacle(/** @type {{text: string}} */ { text }) {
  return text ? html`<${Badge} word="cannot take over" tone="deny" /><div class="muted small"><${Given} value=${text} most=${200} /></div>` : null;
}

/** The active appliance, as the standby sees it. */
function Leader(/** @type {{other: any}} */ { other }) {
  return other.connected ? html`<${Badge} word="active" tone="allow" /><div class="muted small">connected: its changes arrive here</div>` : html`<${Away} other=${other} />`;
}

function Away(/** @type {{other: any}} */ { other }) {
  return html`<${Badge} word="away" tone="deny" /><div class="muted small">${other.trouble_seconds === null ? "" : `for ${lasting(other.trouble_seconds)}`}${other.reason && html`: <${Given} value=${other.reason} most=${200} />`}</div>`;
}

function Witness(/** @type {{witness: any, name: string, active: boolean}} */ { witness, name, active }) {
  const { answered_seconds: seconds, holder, refusal, trouble } = witness;
  const silent = seconds === null || seconds >= SILENT;
  const wrong = active && !silent && holder !== "" && holder !== name;
  const held = holder ? html`the lease is held by <${Given} value=${holder} most=${40} />` : "no appliance holds the lease";
  const words = silent ? (seconds === null ? "it has never answered" : `no answer for ${lasting(seconds)}`) : refusal || trouble ? html`<${Given} value=${refusal || trouble} most=${200} />` : held;
  return html`<${Badge} word=${silent ? "silent" : wrong ? "names the other" : refusal ? "refuses" : trouble ? "cannot save" : "answers"} tone=${silent || wrong || refusal || trouble ? "deny" : "allow"} /><div class="muted small">${words}</div>`;
}

function waits(/** @type {any} */ state) {
  return state.answers_alone ? "Answers do not wait for the standby, because it is not in sync." : "Answers wait until the standby has stored each change.";
}
