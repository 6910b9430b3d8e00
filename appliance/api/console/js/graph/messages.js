/** A topic's last message as subscribers receive it, and one of its numbers over time. The audit log has the query. */

import { html, useState } from "../html.js";
import { Moment } from "../moments.js";
import { Button } from "../parts/button.js";
import { Given } from "../parts/given.js";
import { SECONDS, useLook } from "../parts/look.js";
import { Failure } from "../parts/notice.js";
import { Plot } from "../parts/plot.js";

/** @param {{topic: string}} given */
export function Messages({ topic }) {
  const { looking, turn, seen: all, error } = useLook([topic]);
  const [number, setNumber] = useState("");
  const seen = all[topic] ?? [];
  const last = seen.at(-1);
  const names = last ? numbers(last.fields, "") : [];
  const chosen = names.includes(number) ? number : "";
  const points = chosen ? seen.map((one) => ({ time: one.time / 1e9, value: at(one.fields, chosen) })) : [];
  return html`<div><h3>Messages</h3><div class="row"><${Button} small role="operator" onClick=${turn}>${looking ? "Stop" : "Look"}</${Button}>
      <span class="muted small">${looking ? "As subscribers receive them, after the monitors." : "For a minute. The audit log records it."}</span></div>
    ${error ? html`<${Failure} error=${error} />` : null}
    ${!last && looking ? html`<p class="muted small" role="status">No message yet.</p>` : null}
    ${last && html`<p class="small"><${Moment} at=${new Date(last.time / 1e6).toISOString()} /> <${Given} value=${last.node} mono /> <span class="muted">${last.size} bytes</span></p>
      ${last.why && html`<p class="small"><${Given} value=${last.why} most=${400} /></p>`}
      <pre class="bytes" aria-label="The last message"><${Given} value=${JSON.stringify(last.fields, null, 1)} most=${6000} /></pre>
      ${names.length > 0 && html`<label class="row small">Draw <select value=${chosen} onChange=${(/** @type {any} */ event) => setNumber(event.target.value)}><option value="">nothing</option>${names.map((name) => html`<option key=${name} value=${name}>${name}</option>`)}</select></label>`}
      ${chosen && html`<${Plot} label=${chosen} unit="" say=${(/** @type {number | null} */ value) => (value === null ? "–" : String(Number(value.toPrecision(4))))} span=${SECONDS} height=${120} series=${[{ name: chosen, colour: "c1", points }]} />`}`}</div>`;
}

/** The paths of the first numbers in a message. @returns {string[]} */
function numbers(/** @type {any} */ value, /** @type {string} */ path) {
  if (typeof value === "number") return [path];
  if (typeof value !== "object" || value === null) return [];
  return Object.entries(value).flatMap(([name, inner]) => numbers(inner, path ? `${path}.${name}` : name)).slice(0, 100);
}

function at(/** @type {any} */ fields, /** @type {string} */ path) {
  const value = path.split(".").reduce((inner, name) => inner?.[name], fields);
  return typeof value === "number" ? value : null;
}
