/** Approvals: which hosts wait for an operator, for what, and the buttons that approve or refuse. */

import { html, useEffect } from "#console/html.js";
import { lasting } from "#console/moments.js";
import { Badge } from "#console/parts/badge.js";
import { Button } from "#console/parts/button.js";
import { Given } from "#console/parts/given.js";
import { Host } from "#console/parts/host.js";
import { Failure } from "#console/parts/notice.js";
import { useResource } from "#console/parts/resource.js";
import { done, failed } from "#console/parts/toast.js";
import { ask, get } from "#console/rest.js";

const EVERY = 2000; // milliseconds
const DOES = /** @type {Record<string, string>} */ ({ publish: "publishes", call: "calls", write: "writes" });
const LEASES = [30, 300]; // seconds
const SHOWN = 160; // characters; the number of bytes tells that the arguments have more

/** The table; nothing while nothing waits and no approval lasts. */
export function Approvals() {
  const { value, error, again } = useResource((signal) => get("/v1/approvals", {}, signal), []);
  useEffect(() => {
    const timer = setInterval(again, EVERY);
    return () => clearInterval(timer);
  }, []);
  const rows = value?.approvals ?? [];
  if (!rows.length && !error) return null;
  return html`<section class="panel" aria-labelledby="approvals"><div class="panel-head"><h2 id="approvals">Approvals</h2></div>
    ${error && !value ? html`<div class="panel-body"><${Failure} error=${error} retry=${again} /></div>`
      : html`<div class="table-wrap"><table class="table stacked"><thead><tr><th>Host</th><th>Wants to</th><th>State</th><th><span class="sr-only">Actions</span></th></tr></thead>
        <tbody>${rows.map((/** @type {any} */ one) => html`<${Row} key=${one.number} one=${one} again=${again} />`)}</tbody></table></div>`}</section>`;
}

function Row(/** @type {{one: any, again: () => void}} */ { one, again }) {
  const go = async (/** @type {string} */ verb, /** @type {any} */ json) => {
    try {
      const { body } = await ask("POST", `/v1/approvals/${one.number}/${verb}`, { json, match: "*" });
      done(`Approval ${body.number}: ${body.state}`, `${body.host} ${body.resource}`);
    } catch (failure) {
      failed(failure);
    }
    again();
  };
  const waits = one.state === "waits";
  const once = waits && one.category === "call";
  return html`<tr data-approval=${one.number}>
    <td class="first"><${Host} value=${one.host} /><div class="muted small"><${Given} value=${one.caller_id} mono most=${64} /></div></td>
    <td data-label="Wants to"><div>${DOES[one.category]} <${Given} value=${one.resource} mono most=${80} />${one.category === "call" && html`<div class="muted small">${one.sha256 ? html`<${Given} value=${`${one.type} ${printable(one.arguments)}`} mono most=${160} />${one.size > SHOWN && html` of ${one.size} bytes`}` : "with any arguments"}</div>`}</div></td>
    <td data-label="State"><div><${Badge} word=${one.state} tone=${waits ? "warn" : one.state === "refused" ? "deny" : "allow"} /><div class="muted small">approval ${one.number}, ${lasting(one.left_seconds)} left${one.who && ` (${one.who})`}</div></div></td>
    <td><div class="row row-end">${once && html`<${Button} small role="operator" tone="primary" onClick=${() => go("approve", {})}>Approve once</${Button}>`}
      ${waits && LEASES.map((seconds) => html`<${Button} key=${seconds} small role="operator" onClick=${() => go("approve", { seconds })}>For ${lasting(seconds)}</${Button}>`)}
      ${one.state !== "refused" && html`<${Button} small role="operator" onClick=${() => go("refuse", undefined)}>${waits ? "Refuse" : "End"}</${Button}>`}</div></td></tr>`;
}

/** Return the text in the arguments of a call, and a point for every other byte. @param {string} hex */
function printable(hex) {
  const codes = (hex.match(/../g) ?? []).map((byte) => parseInt(byte, 16));
  return codes.length ? String.fromCharCode(...codes.map((code) => (code > 31 && code < 127 ? code : 0xb7))) : "without arguments";
}
