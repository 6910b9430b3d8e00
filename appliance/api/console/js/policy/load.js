/** Bringing the text into force: why, and whether it goes back by itself. */

import { html, useEffect, useState } from "../html.js";
import { Button } from "../parts/button.js";
import { Dialog } from "../parts/dialog.js";
import { Difference } from "../parts/difference.js";
import { Field } from "../parts/field.js";
import { Failure } from "../parts/notice.js";
import { Signature } from "../parts/signature.js";
import { done } from "../parts/toast.js";
import { useStore } from "../store.js";
import { Report } from "./check.js";
import { draft, dryRun, load, look } from "./draft.js";

const WITHIN = /** @type {[string, string][]} */ ([["", "Stays until it is changed"], ["60", "Goes back in 1 minute unless confirmed"], ["300", "Goes back in 5 minutes unless confirmed"], ["900", "Goes back in 15 minutes unless confirmed"]]);

/** @param {{close: () => void}} given */
export function LoadDialog({ close }) {
  const { live, text, signature, etag, report } = useStore(draft);
  const [note, setNote] = useState("");
  const [within, setWithin] = useState("");
  const [error, setError] = useState(/** @type {any} */ (null));
  useEffect(() => {
    if (!report) dryRun().then(() => setError(null), setError);
  }, [text, signature]);
  const go = async () => {
    setError(null);
    try {
      const body = await load(note, within ? Number(within) : null);
      done(`Revision ${body.revision} is in force`, body.confirm_by ? "Confirm it before it goes back." : `${body.revoked} registrations and connections were taken back.`);
      close();
    } catch (failure) {
      setError(failure);
      if (/** @type {any} */ (failure).status === 412) await look();
      else if (/** @type {any} */ (failure).findings?.length && !live.site_keys.length) close();
    }
  };
  const foot = html`<button class="button" onClick=${close}>Not yet</button><${Button} tone="primary" role="admin" onClick=${go}>Load the policy</${Button}>`;
  return html`<${Dialog} wide title="Load this policy?" close=${close} foot=${foot}>
    <${Failure} error=${error} />
    ${error?.status === 412 && html`<p>Close this, and look at what is different from revision ${live.revision} under Diff; then load again.</p>`}
    <div class="form-grid"><${Field} label="Comment" value=${note} set=${setNote} placeholder="Why, or a ticket" maxlength="200" hint="kept with the revision" /><${Field} label="If you lock yourself out" value=${within} set=${setWithin} options=${WITHIN} /></div>
    <${Signature} asked=${live.site_keys.length > 0} value=${signature} set=${(/** @type {string} */ next) => draft.update({ signature: next, report: null })} />
    ${report && !report.loaded && html`<${Report} report=${report} />`}
    <div><h3>Changes to revision ${live.revision}${etag === `"${live.revision}"` ? "" : `, which is newer than what this text was begun from (${etag})`}</h3>
      <${Difference} old=${live.text} now=${text} same="The text is that of the policy in force." /></div></${Dialog}>`;
}
