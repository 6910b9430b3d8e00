/** Revoke a host, after confirmation. */

import { html, useState } from "#console/html.js";
import { useAttempt } from "#console/parts/attempt.js";
import { Button } from "#console/parts/button.js";
import { Dialog } from "#console/parts/dialog.js";
import { Field } from "#console/parts/field.js";
import { Given } from "#console/parts/given.js";
import { Failure } from "#console/parts/notice.js";
import { done } from "#console/parts/toast.js";
import { ask } from "#console/rest.js";

/** @param {{host: any, etag: string, close: () => void, after: () => void}} given */
export function Revoke({ host, etag, close, after }) {
  const [typed, setTyped] = useState("");
  const [error, attemptToRevoke] = useAttempt();
  const go = async () => {
    await attemptToRevoke(async () => {
      const { body } = await ask("DELETE", `/v1/hosts/${encodeURIComponent(host.name)}`, { match: etag });
      done(`${host.name} is revoked`, `${body.taken_back} registrations and grants were removed.`);
      close();
    });
    after();
  };
  const foot = html`<button class="button" onClick=${close}>Keep it</button><${Button} role="admin" tone="danger" disabled=${typed !== host.name} why="Type the host's name first" onClick=${go}>Revoke ${host.name}</${Button}>`;
  return html`<${Dialog} title=${`Revoke ${host.name}?`} close=${close} foot=${foot}><${Failure} error=${error} />
    <p>Its certificate is revoked, its tunnel closed, and its registrations removed, now. Its address <${Given} value=${host.address} mono /> is not reused. This cannot be undone, but the host can be enrolled again.</p>
    <${Field} label=${`Type ${host.name} to confirm`} mono value=${typed} set=${setTyped} /></${Dialog}>`;
}
