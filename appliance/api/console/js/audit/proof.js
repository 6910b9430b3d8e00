/** Verification of the log, and its export. */

import { html, useState } from "../html.js";
import { count, whole } from "../numbers.js";
import { attempt } from "../parts/attempt.js";
import { Button } from "../parts/button.js";
import { Dialog } from "../parts/dialog.js";
import { Given } from "../parts/given.js";
import { Icon } from "../parts/icon.js";
import { Failure, Notice } from "../parts/notice.js";
import { get, queryText, send } from "../rest.js";
import { fileName, may } from "../session.js";
import { askedOf } from "./records.js";

export function Verify() {
  const [shown, setShown] = useState(/** @type {{value?: any, error?: unknown} | null} */ (null));
  const run = async () => {
    try {
      setShown({ value: await get("/v1/audit/verify") });
    } catch (error) {
      setShown({ error });
    }
  };
  return html`<${Button} role="operator" onClick=${run}><${Icon} name="check" size=${16} />Verify</${Button}>
    ${shown && html`<${Dialog} title="Verify the audit log" close=${() => setShown(null)}>${shown.error ? html`<${Failure} error=${shown.error} />` : html`<${Verdict} value=${shown.value} />`}</${Dialog}>`}`;
}

function Verdict(/** @type {{value: any}} */ { value }) {
  const unsigned = html`<${Notice} tone="warn" title="The log is consistent, but nothing is signed yet">Its completeness is not proven. Verify again in a minute.</${Notice}>`;
  return html`${value.ok && !value.signed_through ? unsigned : value.ok ? html`<${Notice} tone="allow" title="The log is consistent">Each of the ${whole(value.records)} records is unchanged, and every signature is valid. Records may have been cut off at the end.</${Notice}>`
    : html`<${Notice} tone="deny" title="The log was changed or is damaged">Save a copy of it now, and check the findings below.</${Notice}>`}
    <dl class="facts"><dt>Log</dt><dd><${Given} value=${value.log} mono /></dd><dt>Records</dt><dd>${whole(value.first)} to ${whole(value.last)}${value.removed ? `, ${count(value.removed)} removed by retention` : ""}</dd>
      <dt>Checkpoints</dt><dd>${count(value.checkpoints)}, signed ${count(value.signed_checkpoints)}, the last one through record ${whole(value.signed_through)}</dd><dt>Not sealed yet</dt><dd>${whole(value.unsealed)}</dd><dt>Key</dt><dd><${Given} value=${value.key} mono /></dd></dl>
    ${value.findings.length > 0 && html`<ul class="stack-tight">${value.findings.map((/** @type {any} */ one, /** @type {number} */ index) => html`<li key=${index}><${Notice} tone="deny" title=${`${one.kind}: ${one.first}${one.last === one.first ? "" : ` to ${one.last}`}`}><${Given} value=${one.message} most=${500} /></${Notice}></li>`)}</ul>`}
    <p class="muted small">To find a cut end, run <code>rosrv audit verify</code> as root on the appliance: it compares the log with the signer's own checkpoints.</p>`;
}

/** @param {{filter: Record<string, string>}} given */
export function Export({ filter }) {
  return html`<${Button} onClick=${() => take(`/v1/audit/export${queryText(askedOf(filter))}`, fileName("audit", `${now()}.ndjson`))}
    title="All records that match, one JSON object a line"><${Icon} name="down" size=${16} />Export</${Button}>
    <${Button} onClick=${() => take(`/v1/audit/export${queryText({ ...askedOf(filter), format: "csv" })}`, fileName("audit", `${now()}.csv`))}
    title="All records that match, for a spreadsheet; times in UTC"><${Icon} name="down" size=${16} />CSV</${Button}>`;
}

/** An evidence bundle of the filtered period. @param {{filter: Record<string, string>}} given */
export function Evidence({ filter: { since, until } }) {
  return html`<${Button} role=${may("investigator") ? "investigator" : "operator"} disabled=${!since} why="Choose a start time first"
    aria-keyshortcuts="e" onClick=${() => take(`/v1/evidence${queryText({ since, until })}`, fileName("evidence", `${now()}.zip`))}
    title="Everything in this period, with the policy and specifications in force, as a signed bundle"><${Icon} name="down" size=${16} />Evidence</${Button}>`;
}

function now() {
  return new Date().toISOString().slice(0, 19).replaceAll(":", "");
}

/** Download a REST answer as a file. */
export function take(/** @type {string} */ path, /** @type {string} */ name) {
  return attempt(async () => save(await (await send("GET", path)).blob(), name));
}

/** Download a file. @param {Blob} blob @param {string} name */
export function save(blob, name) {
  const url = URL.createObjectURL(blob);
  const link = document.createElement("a");
  link.href = url;
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(url), 10_000);
}
