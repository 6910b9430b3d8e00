/** The switches of a monitor: enable, promote, resume. */

import { html } from "../html.js";
import { attempt } from "../parts/attempt.js";
import { Button, Switch } from "../parts/button.js";
import { Icon } from "../parts/icon.js";
import { done } from "../parts/toast.js";

/** @param {{row: any, monitors: any}} given */
export function MonitorSwitch({ row, monitors }) {
  const on = row.enabled || row.shadow;
  const change = () => attempt(async () => {
    await monitors.change(row.name, { enabled: !on });
    done(`${row.name} is ${on ? "disabled" : "enabled"}`, on ? "Messages pass unchanged." : "It handles events from now on.");
  }, monitors.again);
  return html`<${Switch} role="operator" on=${on} label=${`${row.name} enabled`} change=${change} />`;
}

/** Enforce from shadow mode, or (disabled) move into shadow mode. @param {{row: any, monitors: any}} given */
export function Enforce({ row, monitors }) {
  const change = () => attempt(async () => {
    await monitors.change(row.name, { shadow: !row.shadow });
    done(row.shadow ? `${row.name} is enforced` : `${row.name} is in shadow mode`, row.shadow ? "It acts from now on." : "It only records what it would have done.");
  }, monitors.again);
  return html`<${Button} small role="operator" onClick=${change}><${Icon} name=${row.shadow ? "up" : "play"} size=${14} />${row.shadow ? "Enforce" : "Try"}</${Button}>`;
}

/** @param {{row: any, monitors: any}} given */
export function Resume({ row, monitors }) {
  const change = () => attempt(async () => {
    await monitors.change(row.name, { held: false });
    done(`${row.name} is resumed`, "Its topics are released.");
  }, monitors.again);
  return html`<${Button} small role="operator" onClick=${change}><${Icon} name="play" size=${14} />Resume</${Button}>`;
}
