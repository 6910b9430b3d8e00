/** Check whether the driver stops the base: the questions, warnings and outcomes of `rosrv guard check-driver`. */

import { html, useEffect, useRef, useState } from "#console/html.js";
import { Button } from "#console/parts/button.js";
import { Dialog } from "#console/parts/dialog.js";
import { Field } from "#console/parts/field.js";
import { Given } from "#console/parts/given.js";
import { Failure, Notice } from "#console/parts/notice.js";
import { useResource } from "#console/parts/resource.js";
import { ask, get } from "#console/rest.js";

const PATH = "/v1/guards/driver-check";
const TONES = /** @type {Record<string, "allow" | "deny">} */ ({ stopped: "allow", moving: "deny" });

/** Closing the window ends a check within three seconds, as the end of the command does. @param {{close: () => void}} given */
export function CheckDriver({ close }) {
  const [given, setGiven] = useState(/** @type {Record<string, string>} */ ({ seconds: "2", patience: "30" }));
  const [check, setCheck] = useState(/** @type {any} */ (null));
  const [error, setError] = useState(/** @type {unknown} */ (null));
  const open = useRef(new AbortController());
  useEffect(() => () => open.current.abort(), []);
  const { value } = useResource((signal) => get("/v1/guards/suggestions", {}, signal), []);
  const known = bases(value?.suggestions ?? []);
  const command = given.command ?? Object.keys(known)[0] ?? "";
  const by = given.by ?? known[command] ?? "";
  const [seconds, patience] = [given.seconds, given.patience].map(Number);
  const running = check !== null && check.command && !check.outcome;
  const set = (/** @type {string} */ name) => (/** @type {string} */ value) => setGiven({ ...given, [name]: value });
  const begin = async () => {
    const { signal } = open.current;
    setError(null);
    try {
      let { body } = await ask("POST", PATH, { json: { command, by, seconds, patience }, match: "*", signal });
      for (setCheck(body); body.command && !body.outcome; setCheck(body)) body = await get(PATH, {}, signal);
    } catch (failure) {
      if (signal.aborted) return;
      setCheck(null);
      setError(failure);
    }
  };
  const ready = command && by && seconds > 0 && patience > 0;
  const foot = html`<button class="button" onClick=${close}>${running ? "End the check" : check ? "Close" : "Not now"}</button>
    <${Button} role="admin" tone="danger" disabled=${!ready || running} why=${running ? "It runs" : "Name both topics and both times"} onClick=${begin}>${check && !running ? "Check again" : "The base may drive on"}</${Button}>`;
  return html`<${Dialog} title="Does the driver stop the base when commands end?" close=${close} foot=${foot}>
    <${Notice} tone="warn" title="May the base drive on?">While the base is driven slowly, its commands are withheld for up to ${seconds} s. A driver without a timeout drives on for that time: raise the wheels, or have free space and a hand on the emergency stop.</${Notice}>
    <div class="form-grid">
      <${Field} label="Commands" mono value=${command} set=${set("command")} disabled=${running} placeholder="/cmd_vel" hint="the topic of the base's velocities" />
      <${Field} label="Odometry" mono value=${by} set=${set("by")} disabled=${running} placeholder="/odom" hint="measured, not copied from the commands" />
      <${Field} label="Withhold motions at most for" value=${given.seconds} set=${set("seconds")} disabled=${running} inputmode="decimal" hint="seconds, up to 10" />
      <${Field} label="Wait for a slow drive" value=${given.patience} set=${set("patience")} disabled=${running} inputmode="decimal" hint="seconds, up to 300" /></div>
    <${Failure} error=${error} />
    ${check && html`<${Outcome} check=${check} seconds=${seconds} />`}</${Dialog}>`;
}

function Outcome(/** @type {{check: any, seconds: number}} */ { check, seconds }) {
  if (!check.command) return html`<${Notice} tone="warn" role="status" title="Not measured">not measured: the appliance was restarted; its relays pass commands again after at most ${seconds} s</${Notice}>`;
  if (!check.outcome) return html`<${Notice} role="status" title="The check runs">drive slowly now, at most 0.3 m/s and 0.6 rad/s, until the outcome appears</${Notice}>`;
  return html`<${Notice} tone=${TONES[check.outcome] ?? "warn"} role="status" title=${html`<${Given} value=${check.command} mono most=${60} />`}><${Given} value=${check.text} most=${300} /></${Notice}>`;
}

/** The odometry of each base, as the suggested guards have it. @param {any[]} suggestions @returns {Record<string, string>} */
function bases(suggestions) {
  const found = /** @type {Record<string, string>} */ ({});
  for (const { preset, topics } of suggestions) {
    if (preset === "deadman") found[topics.command] ??= "";
    if (preset === "fence") found[topics.command] = topics.by;
  }
  return found;
}
