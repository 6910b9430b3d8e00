/** Earlier revisions of the policy, their differences, and rollback. */

import { html, useState } from "../html.js";
import { Moment } from "../moments.js";
import { attempt } from "../parts/attempt.js";
import { Badge } from "../parts/badge.js";
import { Button } from "../parts/button.js";
import { Dialog } from "../parts/dialog.js";
import { Difference } from "../parts/difference.js";
import { Editor } from "../parts/editor.js";
import { actor, Given } from "../parts/given.js";
import { Failure, Loading } from "../parts/notice.js";
import { useResource } from "../parts/resource.js";
import { done } from "../parts/toast.js";
import { get } from "../rest.js";
import { useStore } from "../store.js";
import { change, draft, revisions } from "./draft.js";

export function Revisions() {
  const live = useStore(draft, (one) => one.live);
  const { value, error, again } = useResource(revisions, [live?.revision]);
  const [open, setOpen] = useState(/** @type {{revision: number, back: boolean} | null} */ (null));
  if (error) return html`<div class="panel-body"><${Failure} error=${error} retry=${again} /></div>`;
  if (!value) return html`<${Loading} />`;
  return html`<div class="table-wrap"><table class="table"><thead><tr><th class="number">Revision</th><th>When</th><th>Who</th><th>Comment</th><th><span class="sr-only">Actions</span></th></tr></thead><tbody>
    ${value.map((/** @type {any} */ one) => html`<tr key=${one.revision}><td class="number">${one.revision}</td><td class="nowrap"><${Moment} at=${one.loaded} /></td><td><${Given} value=${actor(one.who)} most=${40} /></td><td><${Given} value=${one.note} most=${120} none="" /></td>
      <td><div class="row">${one.in_force ? html`<${Badge} word="in force" tone="allow" />` : html`<${Button} small onClick=${() => setOpen({ revision: one.revision, back: false })}>Compare</${Button}><${Button} small role="operator" onClick=${() => setOpen({ revision: one.revision, back: true })}>Roll back</${Button}>`}</div></td></tr>`)}</tbody></table></div>
    ${open && html`<${RevisionDialog} revision=${open.revision} back=${open.back} close=${() => setOpen(null)} />`}`;
}

/** A kept revision beside the one in force; with `back`, the page asks whether to roll back to it. */
function RevisionDialog(/** @type {{revision: number, back: boolean, close: () => void}} */ { revision, back, close }) {
  const live = useStore(draft, (one) => one.live);
  const { value, error } = useResource((signal) => get(`/v1/policy/revisions/${revision}`, {}, signal), [revision]);
  const go = () => attempt(async () => {
    const body = await change("rollback", { revision });
    done(`Revision ${body.revision} is in force`, `It has the text of revision ${revision}; ${body.revoked} registrations and connections were revoked.`);
    close();
  });
  const foot = back ? html`<button class="button" onClick=${close}>Leave it</button><${Button} tone="primary" role="operator" disabled=${!value} onClick=${go}>Roll back to revision ${revision}</${Button}>` : undefined;
  return html`<${Dialog} wide title=${back ? `Roll back to revision ${revision}?` : `Revision ${revision} beside revision ${live.revision}`} close=${close} foot=${foot}>
    ${error ? html`<${Failure} error=${error} />` : !value ? html`<${Loading} rows=${4} />` : html`<p class="muted">${back ? "Changes to the policy in force:" : "Removed lines are from the older revision."}</p>
      <${Difference} old=${back ? live.text : value.text} now=${back ? value.text : live.text} same="The texts are the same." />`}</${Dialog}>`;
}

/** The text of one kept revision, at a line. @param {{revision: number, line: number, close: () => void}} given */
export function RevisionText({ revision, line, close }) {
  const { value, error } = useResource((signal) => get(`/v1/policy/revisions/${revision}`, {}, signal), [revision]);
  return html`<${Dialog} wide title=${`Revision ${revision}, not in force now`} close=${close}>
    ${error ? html`<${Failure} error=${error} />` : !value ? html`<${Loading} rows=${4} />` : html`<${Editor} label=${`Policy, revision ${revision}`} language="policy" value=${value.text} line=${{ number: line, count: 0 }} height="56vh" />`}</${Dialog}>`;
}
