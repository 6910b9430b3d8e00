/** Who drives, in the situation, and what both this line and the robot's page read. */

import { html } from "#console/html.js";
import { lasting } from "#console/moments.js";
import { Badge } from "#console/parts/badge.js";
import { Fact } from "#console/parts/fact.js";
import { Given } from "#console/parts/given.js";
import { Host, Sentence } from "#console/parts/host.js";
import { useResource } from "#console/parts/resource.js";
import { get } from "#console/rest.js";

const EVERY = 2000; // milliseconds
const MAX = 2; // hosts by name

export function useGroups() {
  const drive = useResource((signal) => get("/v1/drive", {}, signal), [], EVERY);
  return { ...drive, rows: drive.value?.groups ?? [] };
}

/** Who drives, in the situation: one line for each group. */
export function Drives() {
  const { value, error, heard, rows } = useGroups();
  const silent = rows.some((/** @type {any} */ one) => isSilent(one));
  const waits = rows.some((/** @type {any} */ one) => one.waiting.length);
  return html`<${Fact} name="Drives" to="/console/robot" failed=${error && heard} tone=${silent || waits || rows.some(isStuck) ? "warn" : ""}>${error && !value ? "not known" : !value ? "…" : !rows.length ? html`<span class="muted">every host that may: no [Authority]</span>` : rows.map((/** @type {any} */ one) => html`<div key=${one.group}>
    ${one.ranks.length ? html`<${Given} value=${one.group} most=${40} /> <${Badge} word=${one.standing} tone=${isStuck(one) ? "warn" : ""} /> ${one.held_seconds !== null && html`<span class="nowrap">for ${lasting(one.held_seconds)}</span>: `}<span class="muted"><${Sentence} value=${one.why} most=${200} /></span>` : one.holder ? html`<${Host} value=${one.holder} /> <span class="muted">drives</span> <${Given} value=${one.group} most=${40} /> <span class="muted nowrap">for ${lasting(one.held_seconds)}</span>${isSilent(one) && html` <${Badge} word=${`silent: ${one.left_seconds.toFixed(1)} s left`} tone="warn" />`}` : html`<span class="muted">no host drives</span> <${Given} value=${one.group} most=${40} />`}
    ${one.not_carried.filter((/** @type {any} */ each) => each.order).slice(0, MAX).map((/** @type {any} */ each) => html`<div class="muted small"><${NotCarried} one=${each} /></div>`)}
    ${one.waiting.length > 0 && html` <${Badge} word="waits" tone="warn" /> <${Host} value=${one.waiting[0]} />${one.waiting.length > 1 && ` and ${one.waiting.length - 1} more`}`}</div>`)}</${Fact}>`;
}

/** A host whose messages do not reach the robot. */
export function NotCarried(/** @type {{one: any}} */ { one: { host, nodes, topic } }) {
  return html`not carried: <${Host} value=${host} /> <${Given} value=${nodes[0]} most=${60} mono />${nodes.length > 1 && ` and ${nodes.length - 1} more`} to <${Given} value=${topic} most=${60} mono />`;
}

export function isSilent(/** @type {any} */ group) {
  return group.left_seconds !== null && group.left_seconds < group.lease / 2;
}

/** Whether lower ranks wait for a person. */
export function isStuck(/** @type {any} */ group) {
  return group.standing === "lost" || group.standing === "unknown";
}
