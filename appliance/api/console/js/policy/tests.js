/** The policy's test cases, run on the text in the editor. */

import { html, useState } from "../html.js";
import { Badge } from "../parts/badge.js";
import { Button } from "../parts/button.js";
import { Given } from "../parts/given.js";
import { Empty, Failure, Notice } from "../parts/notice.js";
import { ask } from "../rest.js";
import { useStore } from "../store.js";
import { draft } from "./draft.js";

export function Tests() {
  const known = useStore(draft, (one) => one.tested);
  const [error, setError] = useState(/** @type {unknown} */ (null));
  const run = async () => {
    setError(null);
    try {
      draft.update({ tested: (await ask("POST", "/v1/policy/test", { json: { text: draft.get().text } })).body });
    } catch (failure) {
      draft.update({ tested: null });
      setError(failure);
    }
  };
  return html`<div class="panel-body stack"><div class="row"><${Button} tone="primary" onClick=${run}>Run the tests</${Button}><span class="muted small">on the text in the editor; a load that fails a test is rejected</span></div>
    <${Failure} error=${error} />
    ${known && !known.exists && html`<${Empty} icon="policy" title="This policy has no tests">Write <code><${Given} value=${known.file} most=${200} /></code>: who does what, allow or deny. See docs/policy.md for the format.</${Empty}>`}
    ${known?.exists && html`<${Notice} tone=${known.failed ? "deny" : "allow"} title=${known.failed ? `${known.failed} of ${known.passed + known.failed} fail` : `All ${known.passed} pass`}><${Given} value=${known.file} mono most=${200} /></${Notice}>
      <div class="table-wrap tall"><table class="table"><thead><tr><th>Result</th><th>Who</th><th>Wants</th><th>Expected</th><th>Decided</th></tr></thead><tbody>
      ${known.cases.slice(0, 300).map((/** @type {any} */ one) => html`<tr key=${`${one.line}:${one.column}`}><td><${Badge} word=${one.passed ? "pass" : "fail"} tone=${one.passed ? "allow" : "deny"} /></td><td><${Given} value=${one.caller_id} mono /><div class="muted small"><${Given} value=${one.host} mono /></div></td>
        <td>${one.category} <${Given} value=${one.resource} mono />${!one.passed && html`<div class="muted small"><${Given} value=${one.reason} most=${300} /> (line ${one.line})</div>`}</td><td>${one.expected}</td><td>${one.decision}</td></tr>`)}</tbody></table></div>`}</div>`;
}
