/** What stops the robot, in the situation: the guards that act or hold, or else the last stop. */

import { html } from "#console/html.js";
import { Ago, useApplianceTime } from "#console/parts/ago.js";
import { Fact } from "#console/parts/fact.js";
import { Given } from "#console/parts/given.js";
import { Host } from "#console/parts/host.js";
import { dateOf, isNow, Moment } from "#console/moments.js";
import { counted } from "#console/numbers.js";
import { useGuards } from "./state.js";

const ACTS = /** @type {Record<string, string>} */ ({ stopping: "stops", withholding: "withholds", holding: "holds", broken: "is broken, and does not guard" });
const LATELY = 900; // seconds in which a stop that has ended is news
const BEGINS = 10; // seconds in which a stop is red: then the robot is held
const MAX = 2; // guards by name

export function Stops() {
  const { body, error, heard } = useGuards({ presets: false });
  const now = useApplianceTime();
  const rows = body?.guards ?? [];
  const acting = rows.filter((/** @type {any} */ one) => one.state in ACTS);
  const lately = rows.filter((/** @type {any} */ one) => one.last_stop?.until && now !== null && now - secondsOf(one.last_stop.until) < LATELY)
    .sort((/** @type {any} */ one, /** @type {any} */ other) => secondsOf(other.last_stop.until) - secondsOf(one.last_stop.until));
  const idle = rows.filter((/** @type {any} */ one) => one.state === "off" || one.state === "shadow");
  if (acting.length) return html`<${Fact} name="Stops" failed=${error && heard} to="/console/robot" tone=${acting.some((/** @type {any} */ one) => one.state === "holding" || one.state === "broken" || begins(one, now)) ? "deny" : ""}>${acting.slice(0, MAX).map((/** @type {any} */ one) => html`<${Acting} key=${one.name} guard=${one} now=${now} />`)}${acting.length > MAX && html`<div class="muted">and ${acting.length - MAX} more</div>`}</${Fact}>`;
  if (lately.length) return html`<${Fact} name="Stops" failed=${error && heard} to="/console/robot" tone=${isNow(lately[0].last_stop.until, now) ? "warn" : ""}><${Stopped} guard=${lately[0]} /></${Fact}>`;
  const said = error && !body ? "not known" : !body ? "…" : !rows.length ? "no guard is loaded" : `nothing: ${counted(rows.length - idle.length, "guard")} on watch`;
  return html`<${Fact} name="Stops" failed=${error && heard} to="/console/robot" tone=${idle.length ? "warn" : ""}>${said}${idle.length > 0 && html`, <${Given} value=${idle[0].name} most=${40} /> ${idle[0].state === "off" ? "is off" : "only records"}${idle.length > 1 && ` and ${idle.length - 1} more`}`}</${Fact}>`;
}

/** Whether the stop of a guard that acts has just begun. @param {any} guard @param {number | null} now */
export function begins({ state, last_stop }, now) {
  return state === "stopping" && last_stop !== null && isNow(last_stop.since, now, BEGINS);
}

/** Since when a guard holds the robot, and who drove. */
export function Held(/** @type {{guard: any}} */ { guard: { name, last_stop } }) {
  const [host, node] = last_stop.host ? [last_stop.host, last_stop.node] : [last_stop.publisher_host, last_stop.publisher_node];
  return html`<span class="muted">held by</span> <${Given} value=${name} most=${40} /> <span class="muted">since</span> <${Moment} at=${last_stop.since} />${host && html` (<${Host} value=${host} /> <${Given} value=${node} most=${60} mono />)`}`;
}

function Acting(/** @type {{guard: any, now: number | null}} */ { guard, now }) {
  const { name, state, topics, why_held, last_stop, error } = guard;
  const why = error || (state === "holding" ? why_held : last_stop?.cause);
  if (state === "stopping" && last_stop && !begins(guard, now)) return html`<div><${Held} guard=${guard} />${why && html`<div class="muted small"><${Given} value=${why} most=${120} /></div>`}</div>`;
  return html`<div><${Given} value=${name} most=${40} /> <span class="muted">${ACTS[state]}</span> <${Given} value=${topics.command} mono most=${60} />${state !== "holding" && !error && last_stop && html`<${From} stop=${last_stop} /> <${Ago} at=${last_stop.since} lasts />`}${why && html`<div class="muted small"><${Given} value=${why} most=${120} /></div>`}</div>`;
}

function Stopped(/** @type {{guard: any}} */ { guard: { name, topics, last_stop } }) {
  return html`<div><${Given} value=${name} most=${40} /> <span class="muted">stopped</span> <${Given} value=${topics.command} mono most=${60} /><${From} stop=${last_stop} />, <${Ago} at=${last_stop.until} />${last_stop.cause && html`<div class="muted small"><${Given} value=${last_stop.cause} most=${120} /></div>`}</div>`;
}

function From(/** @type {{stop: any}} */ { stop }) {
  return stop.host ? html` <span class="muted">of</span> <${Host} value=${stop.host} />` : null;
}

function secondsOf(/** @type {string | number} */ at) {
  return dateOf(at).getTime() / 1000;
}
