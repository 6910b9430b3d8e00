/** The planned switchover, after confirmation. */

import { html, useState } from "#console/html.js";
import { useAttempt } from "#console/parts/attempt.js";
import { Button } from "#console/parts/button.js";
import { Dialog } from "#console/parts/dialog.js";
import { Given } from "#console/parts/given.js";
import { Failure } from "#console/parts/notice.js";
import { done } from "#console/parts/toast.js";
import { ask } from "#console/rest.js";

/** The button that opens the dialog. @param {{state: any}} given */
export function SwitchOver({ state }) {
  const [open, setOpen] = useState(false);
  const { other, troubles } = state;
  return html`<${Button} small role="admin" disabled=${troubles.length > 0} why=${troubles[0]} onClick=${() => setOpen(true)}>Switch over…</${Button}>
    ${open && html`<${Confirm} name=${state.name} other=${other} close=${() => setOpen(false)} />`}`;
}

function Confirm(/** @type {{name: string, other: any, close: () => void}} */ { name, other, close }) {
  const [error, attempt] = useAttempt();
  const go = () => attempt(async () => {
    await ask("POST", "/v1/standby/switch", { match: "*" });
    done("The switchover is ordered", `${other.name} becomes the active appliance.`);
    close();
  });
  const foot = html`<button class="button" onClick=${close}>Not now</button><${Button} role="admin" tone="danger" onClick=${go}>Switch over</${Button}>`;
  return html`<${Dialog} title=${`Switch over to ${other.name}?`} close=${close} foot=${foot}><${Failure} error=${error} />
    <p><${Given} value=${other.name} most=${40} /> becomes the active appliance and <${Given} value=${name} most=${40} /> its standby, for example before an update of this machine.</p>
    <p>Nodes reconnect automatically: their topics and services pause for a moment. This console then links to that of <${Given} value=${other.name} most=${40} />.</p></${Dialog}>`;
}
