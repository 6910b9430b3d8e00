/** Messages: errors, hints, empty states, results. */

import { since } from "../elapsed.js";
import { html } from "../html.js";
import { lasting, useSeconds } from "../moments.js";
import { headline, Problem } from "../problem.js";
import { Given } from "./given.js";
import { Icon } from "./icon.js";

const ICONS = { deny: "stop", warn: "warn", allow: "check", note: "info" };

/** @param {{tone?: "deny" | "warn" | "allow" | "note", title?: any, children?: any, role?: string}} given */
export function Notice({ tone = "note", title, children, role }) {
  return html`<div class=${`notice ${tone}`} role=${role}>
    <${Icon} name=${ICONS[tone]} />
    <div class="notice-body">${title && html`<div class="notice-title">${title}</div>`}${children && html`<div>${children}</div>`}</div>
  </div>`;
}

/** The error of a failed request. @param {{error: unknown, retry?: () => void, heard?: import("../elapsed.js").Mark | null}} given `heard`: when the value came that is still shown */
export function Failure({ error, retry, heard }) {
  if (!error) return null;
  const text = error instanceof Error ? error.message : String(error);
  const problem = error instanceof Problem ? error : null;
  return html`<${Notice} tone=${problem?.passing ? "warn" : "deny"} title=${headline(error)} role="alert">
    <${Given} value=${text} most=${1200} />
    ${problem && problem.errors.length > 1 && html`<ul>${problem.errors.map((one) => html`<li><code><${Given} value=${one.where} /></code>: <${Given} value=${one.text} /></li>`)}</ul>`}
    ${heard && html`<div><${Earlier} heard=${heard} /></div>`}
    ${retry && html`<div><button class="button small" onClick=${retry}>Try again</button></div>`}
  </${Notice}>`;
}

function Earlier(/** @type {{heard: import("../elapsed.js").Mark}} */ { heard }) {
  useSeconds();
  return html`What is shown is of ${lasting(since(heard) / 1000)} ago.`;
}

/** An empty state: it describes the missing content and the next step. @param {{icon: any, title: string, children?: any}} given */
export function Empty({ icon, title, children }) {
  return html`<div class="empty"><${Icon} name=${icon} size=${26} /><strong>${title}</strong>${children && html`<p>${children}</p>`}</div>`;
}

/** Placeholders of the size of the rows being loaded. @param {{rows?: number}} given */
export function Loading({ rows = 5 }) {
  return html`<div class="panel-body stack" role="status"><span class="sr-only">Loading</span>
    ${Array.from({ length: rows }, (_, index) => html`<div key=${index} class="skeleton"></div>`)}</div>`;
}

/** Errors and warnings of a text; `pick(finding)` moves to its place. */
export function Findings(/** @type {{findings: import("../problem.js").Finding[], pick?: (one: any) => void}} */ { findings, pick }) {
  return html`<ul class="findings">${findings.map((one) => {
    const inside = html`<span class="place">${one.line}:${one.column}</span><span><${Given} value=${one.text} most=${600} /></span>`;
    const kind = `finding ${one.severity === "error" ? "error" : "warning"}`;
    return html`<li>${pick ? html`<button class=${kind} onClick=${() => pick(one)}>${inside}</button>` : html`<div class=${kind}>${inside}</div>`}</li>`;
  })}</ul>`;
}
