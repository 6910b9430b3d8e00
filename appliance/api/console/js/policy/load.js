/** Load the text, permanently or with commit-confirm. */

import { html, useEffect, useState } from "../html.js";
import { counted } from "../numbers.js";
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

const MINUTES = "300"; // preselected if connections would end, or the text came from a denial
const WITHIN = /** @type {[string, string][]} */ ([["", "Permanent"], ["60", "Roll back in 1 minute unless confirmed"], ["300", "Roll back in 5 minutes unless confirmed"], ["900", "Roll back in 15 minutes unless confirmed"]]);

/**
 * A policy that would end live connections or grants a denied request rolls back unless it is confirmed.
 * @param {any} report of a dry run @param {boolean} granted
 */
function preselected(report, granted) {
  return granted || report?.ends.length ? MINUTES : "";
}

/** @param {{close: () => void}} given */
export function LoadDialog({ close }) {
  const { live, text, signature, etag, report, errors, granted } = useStore(draft);
  const [note, setNote] = useState("");
  const [chosen, setWithin] = useState(/** @type {string | null} */ (null));
  const within = chosen ?? preselected(report, granted);
  const [error, setError] = useState(/** @type {any} */ (null));
  useEffect(() => {
    if (!report) dryRun().then((shown) => shown && setError(null), setError);
  }, [text, signature]);
  const go = async () => {
    setError(null);
    try {
      while (!draft.get().report) await dryRun(); // again if its result was ignored
      const seconds = chosen ?? preselected(draft.get().report, granted);
      const body = await load(note, seconds ? Number(seconds) : null);
      done(`Revision ${body.revision} is in force`, body.confirm_by ? "Confirm it before it rolls back." : `${body.revoked} registrations and connections were revoked.`);
      close();
    } catch (failure) {
      setError(failure);
      if (/** @type {any} */ (failure).status === 412) await look();
      else if (/** @type {any} */ (failure).findings?.length && !live.site_keys.length) close();
    }
  };
  const submit = (/** @type {Event} */ event) => {
    event.preventDefault();
    document.getElementById("load-policy")?.click(); // the button knows whether it is disabled or busy
  };
  const foot = html`<button class="button" onClick=${close}>Not yet</button><${Button} id="load-policy" tone="primary" role="admin" disabled=${errors > 0} why=${`The text has ${counted(errors, "error")}`} onClick=${go}>Load the policy</${Button}>`;
  return html`<${Dialog} wide title="Load this policy?" close=${close} foot=${foot}>
    <${Failure} error=${error} />
    ${error?.status === 412 && html`<p>Close this dialog and compare with revision ${live.revision} under Diff, then load again.</p>`}
    <form class="form-grid" onSubmit=${submit}><${Field} label="Comment" autofocus value=${note} set=${setNote} placeholder="Reason or ticket number" maxlength="200" hint="kept with the revision" /><${Field} label="Commit-confirm" value=${within} set=${setWithin} options=${WITHIN} /></form>
    <${Signature} asked=${live.site_keys.length > 0} value=${signature} set=${(/** @type {string} */ next) => draft.update({ signature: next, report: null })} />
    ${report && !report.loaded && html`<${Report} report=${report} />`}
    <div><h3>Changes to revision ${live.revision}${etag === `"${live.revision}"` ? "" : `, which is newer than the base of this text (${etag})`}</h3>
      <${Difference} old=${live.text} now=${text} same="The text is the policy in force." /></div></${Dialog}>`;
}
