/** Explain a decision, under the policy in force or the text in the editor. */

import { CATEGORIES, isDecided } from "../categories.js";
import { html, useEffect, useState } from "../html.js";
import { Badge } from "../parts/badge.js";
import { Check, Field } from "../parts/field.js";
import { Given } from "../parts/given.js";
import { Failure } from "../parts/notice.js";
import { ask, get } from "../rest.js";
import { draft } from "./draft.js";

/** @param {{query: URLSearchParams, pick: (place: any) => void}} given */
export function Explain({ query, pick }) {
  const asked = query.get("category") ?? "publish";
  const [question, setQuestion] = useState({
    host: query.get("host") || "robot", node: query.get("node") ?? "",
    category: isDecided(asked) ? asked : "publish", resource: query.get("resource") ?? "",
  });
  const [underDraft, setUnderDraft] = useState(false);
  const [answer, setAnswer] = useState(/** @type {{value?: any, error?: unknown} | null} */ (null));
  const set = (/** @type {string} */ name) => (/** @type {string} */ value) => setQuestion({ ...question, [name]: value });
  const explain = async () => {
    try {
      const value = underDraft ? (await ask("POST", "/v1/policy/explain", { json: { ...question, text: draft.get().text } })).body : await get("/v1/policy/explain", question);
      setAnswer({ value });
    } catch (error) {
      setAnswer({ error });
    }
  };
  useEffect(() => {
    if (query.get("resource")) explain();
  }, []);
  const submit = (/** @type {Event} */ event) => {
    event.preventDefault();
    explain();
  };
  return html`<div class="panel-body stack"><form class="stack" onSubmit=${submit}>
      <div class="form-grid"><${Field} label="Host" mono value=${question.host} set=${set("host")} hint="an address, or the name of a host" required />
        <${Field} label="Node" mono value=${question.node} set=${set("node")} placeholder="/joystick" hint="the name it gives" /></div>
      <div class="form-grid"><${Field} label="Wants to" value=${question.category} set=${set("category")} options=${CATEGORIES} />
        <${Field} label="What" mono value=${question.resource} set=${set("resource")} placeholder="/cmd_vel" required /></div>
      <div class="row"><button class="button primary" type="submit">Explain</button><${Check} label="Use the text in the editor" on=${underDraft} set=${setUnderDraft} /></div></form>
    ${answer?.error ? html`<${Failure} error=${answer.error} />` : null}
    ${answer?.value && html`<${Explained} found=${answer.value} pick=${pick} />`}</div>`;
}

function Explained(/** @type {{found: any, pick: (place: any) => void}} */ { found, pick }) {
  return html`<div class="stack" role="status" data-explained>
    <div class="stack-tight"><div class="row"><${Badge} word=${found.decision} /><strong>${found.allowed ? "The request is allowed" : "The request is denied"}</strong></div><p><${Given} value=${found.reason} most=${600} /></p>${found.carried && html`<p><${Given} value=${found.carried} most=${300} /></p>`}</div>
    <dl class="facts"><dt>Rule</dt><dd>${found.rule ? html`<${Place} rule=${found.rule} pick=${pick} />` : html`<span class="muted">no rule applies</span>`}</dd>
      ${found.through.length > 0 && html`<dt>Matched text</dt><dd><${Given} value=${found.through.join(" → ")} mono /></dd>`}
      ${found.limit && html`<dt>Limit</dt><dd><${Given} value=${found.limit} most=${300} /></dd>`}</dl>
    ${found.lost.length > 0 && html`<div><h3>Overridden rules</h3><ul class="stack-tight">${found.lost.map((/** @type {any} */ one, /** @type {number} */ index) => html`<li key=${index} class="row"><${Badge} word=${one.would} /><${Place} rule=${one.rule} pick=${pick} /><span class="muted"><${Given} value=${one.why} most=${300} /></span></li>`)}</ul></div>`}
    ${found.command && html`<div class="nested"><h3>The call used</h3><${Explained} found=${found.command} pick=${pick} /></div>`}
    ${found.node && html`<div class="nested"><h3>The node's name</h3><${Explained} found=${found.node} pick=${pick} /></div>`}</div>`;
}

function Place(/** @type {{rule: any, pick: (place: any) => void}} */ { rule, pick }) {
  return html`<span><code>[<${Given} value=${rule.section} />] <${Given} value=${rule.key} most=${80} /></code>${" "}<button class="link nowrap" onClick=${() => pick({ line: rule.line, column: 1 })}>line ${rule.line}</button></span>`;
}
