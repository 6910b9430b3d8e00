/** Letting a host out for good: asked twice, done within a second. */

import { html, useState } from "../html.js";
import { Button } from "../parts/button.js";
import { Dialog } from "../parts/dialog.js";
import { Field } from "../parts/field.js";
import { Given } from "../parts/given.js";
import { Failure } from "../parts/notice.js";
import { done } from "../parts/toast.js";
import { ask } from "../rest.js";

/** @param {{host: any, etag: string, close: () => void, after: () => Promise<void>}} given */
export function Revoke({ host, etag, close, after }) {
  const [typed, setTyped] = useState("");
  const [error, setError] = useState(/** @type {unknown} */ (null));
  const go = async () => {
    setError(null);
    try {
      const { body } = await ask("DELETE", `/v1/hosts/${encodeURIComponent(host.name)}`, { match: etag });
      done(`${host.name} is revoked`, `${body.taken_back} registrations and grants were taken back.`);
      await after();
      close();
    } catch (failure) {
      setError(failure);
      await after();
    }
  };
  const foot = html`<button class="button" onClick=${close}>Keep it</button><${Button} role="admin" tone="danger" disabled=${typed !== host.name} why="Type the host's name first" onClick=${go}>Revoke ${host.name}</${Button}>`;
  return html`<${Dialog} title=${`Revoke ${host.name}?`} close=${close} foot=${foot}><${Failure} error=${error} />
    <p>Its certificate ends, its tunnel is closed, and what it registered is taken back, now. Its address <${Given} value=${host.address} mono /> is given to no other. It cannot be undone; the host can be enrolled anew.</p>
    <${Field} label=${`Type ${host.name} to confirm`} mono value=${typed} set=${setTyped} /></${Dialog}>`;
}
