/** Errors in the text, failed tests, and the changes that the text would make. */

import { html } from "../html.js";
import { counted } from "../numbers.js";
import { Badge } from "../parts/badge.js";
import { Given } from "../parts/given.js";
import { Empty, Failure, Findings, Notice } from "../parts/notice.js";
import { useStore } from "../store.js";
import { draft } from "./draft.js";

const SHOWN = 50; // most hosts, and most connections of a host

/** @param {{pick: (finding: any) => void}} given */
export function Check({ pick }) {
  const { error, findings, report, text, base } = useStore(draft);
  const errors = findings.filter((one) => one.severity === "error");
  const ours = findings.filter((one) => one.file === "policy" || !one.file.includes(".tests."));
  const ofTests = findings.filter((one) => !ours.includes(one));
  if (!error && !report && !findings.length) {
    return html`<${Empty} icon="policy" title=${text === base ? "This is the policy in force" : "No errors in this text"}>${text === base ? "Change the text; errors appear in place while you write." : "A dry run shows live connections that would end and requests that would be decided differently."}</${Empty}>`;
  }
  return html`<div class="panel-body stack">
    ${error && !errors.length ? html`<${Failure} error=${error} />` : null}
    ${errors.length > 0 && html`<${Notice} tone="deny" role="alert" title=${`Rejected: ${counted(errors.length, "error")}`}>Nothing was changed. Select an error to move to its place.</${Notice}>`}
    ${ours.length > 0 && html`<${Findings} findings=${ours} pick=${pick} />`}
    ${ofTests.length > 0 && html`<div><h3>Tests that fail</h3><${Findings} findings=${ofTests} /></div>`}
    ${report && html`<${Report} report=${report} />`}</div>`;
}

/** The effect of a text. @param {{report: any}} given */
export function Report({ report }) {
  const ends = report.ends.length;
  const what = counted(ends, "live connection");
  const title = report.loaded ? `Revision ${report.revision} is in force${ends ? `, and ended ${what}` : ""}` : ends ? `It can be loaded, and would end ${what}` : "It can be loaded";
  const taken = report.revoked === null ? "" : ` ${counted(report.revoked, "registration or connection", "registrations and connections")} revoked.`;
  return html`<${Notice} tone=${ends ? "warn" : "allow"} role="status" title=${title}>${report.changes.length ? `${counted(report.changes.length, "live request")} ${report.loaded ? "are" : "would be"} decided differently.` : "No live request is decided differently."}${taken}
      ${ends > 0 && html`<${Ends} ends=${report.ends} />`}</${Notice}>
    ${report.changes.length > 0 && html`<div class="table-wrap"><table class="table"><thead><tr><th>Now</th><th>Then</th><th>Node</th><th>Wants</th></tr></thead><tbody>
      ${report.changes.slice(0, 200).map((/** @type {any} */ one, /** @type {number} */ index) => html`<tr key=${index}><td><${Badge} word=${one.now} /></td><td><${Badge} word=${one.then} /></td><td><${Given} value=${one.caller_id} mono /><div class="muted small"><${Given} value=${one.host} mono /></div></td>
        <td>${one.category} <${Given} value=${one.resource} mono /><div class="muted small"><${Given} value=${one.reason} most=${300} /></div></td></tr>`)}</tbody></table></div>`}`;
}

/** What would end, by host: the host with the most connections first. @param {{ends: any[]}} given */
function Ends({ ends }) {
  const groups = new Map();
  for (const one of ends) groups.has(one.host) ? groups.get(one.host).push(one) : groups.set(one.host, [one]);
  const hosts = [...groups].sort(([, one], [, other]) => other.length - one.length);
  return html`<ul class="plain-list">${hosts.slice(0, SHOWN).map(([host, of]) => html`<li key=${host}><details><summary><${Given} value=${host} mono />: ${counted(of.length, "connection")}</summary>
      <ul class="plain-list nested">${of.slice(0, SHOWN).map((/** @type {any} */ one, /** @type {number} */ index) => html`<li key=${index}>${one.what} <${Given} value=${one.resource} mono /> of <${Given} value=${one.caller_id || "a client"} mono /></li>`)}<${More} count=${of.length} what="connections" /></ul></details></li>`)}<${More} count=${hosts.length} what="hosts" /></ul>`;
}

function More(/** @type {{count: number, what: string}} */ { count, what }) {
  return count > SHOWN && html`<li>and ${count - SHOWN} more ${what}</li>`;
}
