/** Approvals: which hosts wait for an operator, for what, and the buttons that approve or refuse. */

import { html, useEffect, useRef, useState } from "#console/html.js";
import { lasting } from "#console/moments.js";
import { Badge } from "#console/parts/badge.js";
import { Button } from "#console/parts/button.js";
import { Given } from "#console/parts/given.js";
import { Host } from "#console/parts/host.js";
import { Failure } from "#console/parts/notice.js";
import { useStore } from "#console/store.js";
import { TIMES, wants } from "./call.js";
import { again, decide, held } from "./held.js";
import { WAKES } from "./slots.js";
import { Sound } from "./sound.js";

const CHECKED = 100; // milliseconds between two looks at the places of the rows

export function Approvals() {
  const { rows, error, heard } = useStore(held);
  const table = useRef(/** @type {HTMLElement | null} */ (null));
  const steady = useAwake(table);
  return html`<section class="panel" aria-labelledby="approvals"><div class="panel-head"><h2 id="approvals">Approvals</h2>${!error && rows?.length === 0 && html`<span class="muted small">no call waits</span>`}<span class="end"><${Sound} /></span></div>
    ${error ? html`<div class="panel-body"><${Failure} error=${error} retry=${again} heard=${heard} /></div>` : null}
    ${rows?.length ? html`<div class="table-wrap" ref=${table}><table class="table stacked"><thead><tr><th>Host</th><th>Wants to</th><th>State</th><th><span class="sr-only">Actions</span></th></tr></thead>
        <tbody>${rows.map((one) => html`<${Row} key=${one.number} one=${one} steady=${steady} />`)}</tbody></table></div>` : null}</section>`;
}

/**
 * Whether the buttons act: not for half a second after a row changed its place on the page, also by what is above it. `now` is
 * whether they act at this moment, `awake` what was drawn last.
 * @param {{current: HTMLElement | null}} table
 */
function useAwake(table) {
  const [awake, setAwake] = useState(false);
  const last = useRef({ places: "", moved: performance.now() });
  const now = () => {
    const rows = [...table.current?.querySelectorAll("tr[data-approval]") ?? []];
    const places = rows.map((row) => [row.getAttribute("data-approval"), Math.round(row.getBoundingClientRect().top + scrollY)]).join();
    if (places !== last.current.places) last.current = { places, moved: performance.now() };
    return performance.now() - last.current.moved >= WAKES;
  };
  useEffect(() => {
    const timer = setInterval(() => setAwake(now()), CHECKED);
    return () => clearInterval(timer);
  }, []);
  return { awake, now };
}

function Row(/** @type {{one: any, steady: {awake: boolean, now: () => boolean}}} */ { one, steady }) {
  const off = { disabled: !steady.awake, why: "It wakes in half a second" };
  const order = (/** @type {"approve" | "refuse"} */ verb, /** @type {number} */ seconds = 0) => () => (steady.now() ? decide(one.number, verb, seconds || undefined) : undefined);
  const waits = one.state === "waits";
  const once = waits && one.category === "call";
  return html`<tr data-approval=${one.number}>
    <td class="first"><${Host} value=${one.host} /><div class="muted small"><${Given} value=${one.caller_id} mono most=${64} /></div></td>
    <td data-label="Wants to"><div>${wants(one)}</div></td>
    <td data-label="State"><div><${Badge} word=${one.state === "lease" ? "approved" : one.state} tone=${waits ? "warn" : one.state === "refused" ? "deny" : "allow"} /><div class="muted small">approval ${one.number}, ${lasting(one.left_seconds)} left${one.who && ` (${one.who})`}</div></div></td>
    <td><div class="row row-end">${once && html`<${Button} small role="operator" tone="primary" ...${off} onClick=${order("approve")}>Approve once</${Button}>`}
      ${waits && TIMES.map((seconds) => html`<${Button} key=${seconds} small role="operator" ...${off} onClick=${order("approve", seconds)}>For ${lasting(seconds)}</${Button}>`)}
      ${one.state !== "refused" && html`<${Button} small role="operator" ...${off} onClick=${order("refuse")}>${waits ? "Refuse" : "End"}</${Button}>`}</div></td></tr>`;
}
