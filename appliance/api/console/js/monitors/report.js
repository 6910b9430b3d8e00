/** The result of a dry run or load of a specification. */

import { html } from "../html.js";
import { counted } from "../numbers.js";
import { Given } from "../parts/given.js";
import { Failure, Findings, Notice } from "../parts/notice.js";

/** @param {{findings: any[], report: any, error: any, pick: (one: any) => void}} given */
export function Outcome({ findings, report, error, pick }) {
  const errors = findings.filter((one) => one.severity === "error");
  if (!findings.length && !report && !error) return null;
  return html`<div class="stack" data-outcome>
    ${error && !errors.length ? html`<${Failure} error=${error} />` : null}
    ${errors.length > 0 && html`<${Notice} tone="deny" role="alert" title=${`Rejected: ${counted(errors.length, "error")}`}>Nothing was changed. Select an error to move to its place.</${Notice}>`}
    ${findings.length > 0 && html`<${Findings} findings=${findings} pick=${pick} />`}
    ${report && html`<${Notice} tone="allow" role="status" title=${report.loaded ? `Revision ${report.revision} is in force` : "It can be loaded"}>
      ${["added", "changed", "removed"].filter((word) => report[word]?.length).map((word) => html`<div key=${word}>${word}: <${Given} value=${report[word].join(", ")} most=${300} /></div>`)}
      ${!report.added?.length && !report.changed?.length && !report.removed?.length && "No monitor changes."}</${Notice}>`}</div>`;
}
