/** How many calls wait, in the situation. */

import { html } from "#console/html.js";
import { counted } from "#console/numbers.js";
import { Fact } from "#console/parts/fact.js";
import { useStore } from "#console/store.js";
import { held } from "./held.js";
import { waitingOf } from "./slots.js";

export function Waits() {
  const { rows, error, heard } = useStore(held);
  const waiting = waitingOf(rows).length;
  const lasts = (rows ?? []).filter((one) => one.state === "lease").length;
  return html`<${Fact} name="Waits" failed=${error && heard} to="/console/robot" tone=${waiting ? "warn" : ""}>${waiting ? counted(waiting, "call waits for you", "calls wait for you") : rows ? "no call waits" : error ? "not known" : "…"}${lasts > 0 && html` <span class="muted">${counted(lasts, "approval lasts", "approvals last")}</span>`}</${Fact}>`;
}
