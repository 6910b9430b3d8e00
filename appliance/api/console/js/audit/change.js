/** A monitor's changes to a message: by field if the message type is known, otherwise by byte. */

import { html } from "../html.js";
import { Given } from "../parts/given.js";

const BYTES = 256;

/** @param {{detail: Record<string, any>}} given */
export function Change({ detail }) {
  const { before, after, before_fields: old, after_fields: now } = detail;
  if (!before && !after) return null;
  if (old || now) {
    const rows = compared(old ?? {}, now ?? null);
    return html`<div class="table-wrap"><table class="table change"><thead><tr><th>Field</th><th>${now ? "Before" : "Message"}</th>${now && html`<th>After</th>`}</tr></thead>
      <tbody>${rows.map((one) => html`<tr key=${one.path} class=${one.differs ? "differs" : ""}><td><code><${Given} value=${one.path} most=${80} /></code></td>
        <td class="mono">${one.differs ? html`<del><${Given} value=${one.old} /></del>` : html`<${Given} value=${one.old} />`}</td>${now && html`<td class="mono">${one.differs ? html`<ins><${Given} value=${one.now} /></ins>` : html`<${Given} value=${one.now} />`}</td>`}</tr>`)}</tbody></table></div>`;
  }
  return html`<div class="stack-tight">${before && html`<h3>Bytes${after ? " before" : ""}</h3><pre class="bytes">${grouped(before)}</pre>`}${after && html`<h3>Bytes after</h3><pre class="bytes">${grouped(after)}</pre>`}</div>`;
}

/** The fields of both messages, differing fields first. @param {any} old @param {any} now */
export function compared(old, now) {
  const [before, after] = [flat(old), now === null ? null : flat(now)];
  const paths = [...new Set([...before.keys(), ...(after?.keys() ?? [])])];
  const rows = paths.map((path) => ({ path, old: before.get(path), now: after?.get(path), differs: after !== null && before.get(path) !== after.get(path) }));
  return rows.sort((a, b) => Number(b.differs) - Number(a.differs));
}

function flat(/** @type {any} */ value, /** @type {string} */ path = "", found = new Map()) {
  if (value !== null && typeof value === "object" && Object.keys(value).length) {
    for (const [name, part] of Object.entries(value)) flat(part, Array.isArray(value) ? `${path}[${name}]` : path ? `${path}.${name}` : name, found);
  } else found.set(path, typeof value === "string" ? value : JSON.stringify(value));
  return found;
}

function grouped(/** @type {string} */ hex) {
  const shown = hex.slice(0, BYTES * 2).replace(/(..)/g, "$1 ").trim();
  return hex.length > BYTES * 2 ? `${shown} … ${hex.length / 2} bytes` : shown;
}
