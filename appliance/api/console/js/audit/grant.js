/** "Grant this": the smallest change of the policy that grants a denied request, with a link to the editor. */

import { html, useEffect, useRef, useState } from "../html.js";
import { Button } from "../parts/button.js";
import { UnifiedDiff } from "../parts/difference.js";
import { Given } from "../parts/given.js";
import { Failure } from "../parts/notice.js";
import { discard, draft, look, write } from "../policy/draft.js";
import { get } from "../rest.js";
import { go } from "../router.js";

/** @param {{id: string}} given */
export function Grant({ id }) {
  const [found, setFound] = useState(/** @type {any} */ (null));
  const [unsaved, setUnsaved] = useState(false); // whether this change would replace an unsaved text
  const [error, setError] = useState(/** @type {unknown} */ (null));
  const shown = useRef(/** @type {HTMLElement | null} */ (null));
  useEffect(() => shown.current?.focus(), [found]);
  const ask = async () => {
    setError(null);
    try {
      setFound(await get(`/v1/audit/${id}/grant`));
    } catch (problem) {
      setError(problem);
    }
  };
  const edit = async () => {
    await look();
    const { live, text, base } = draft.get();
    if (live?.revision !== found.revision) return ask(); // the change was computed for another policy
    if (text !== base && text !== found.text && !unsaved) return setUnsaved(true);
    discard();
    write(found.text);
    draft.update({ granted: true });
    const lines = live.text.split("\n");
    const changed = found.text.split("\n").findIndex((/** @type {string} */ one, /** @type {number} */ number) => one !== lines[number]);
    go(`/console/policy?line=${changed + 1}`);
  };
  if (error) return html`<${Failure} error=${error} retry=${ask} />`;
  if (!found) return html`<div class="row"><${Button} aria-keyshortcuts="g" onClick=${ask}>Grant this</${Button}><span class="muted small">Shows what would change; nothing is changed yet.</span></div>`;
  if (!found.added.length) return html`<p role="status" tabindex="-1" ref=${shown}>The policy in force grants it: it was denied for another reason, or before this revision.</p>`;
  return html`<section class="stack-tight" tabindex="-1" ref=${shown} aria-label="What would grant it"><${UnifiedDiff} lines=${found.diff} />
    ${found.findings.length > 0 && html`<p>The policy's tests fail with it:</p><ul class="plain-list">${found.findings.map((/** @type {string} */ one) => html`<li key=${one}><${Given} value=${one} most=${300} mono /></li>`)}</ul>`}
    <div class="row"><${Button} role="operator" tone="primary" aria-keyshortcuts="g" onClick=${edit}>${unsaved ? "Replace that text" : "Open in the editor"}</${Button}><span class="muted small" role="status">${unsaved ? "The editor has unloaded changes, which would be lost." : "A dry run there lists the affected hosts; load it with automatic rollback."}</span></div></section>`;
}
