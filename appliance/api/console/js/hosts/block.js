/** Block a host during an incident, and the list of blocked hosts. */

import { html, useEffect, useState } from "../html.js";
import { applianceNow } from "../live.js";
import { Moment } from "../moments.js";
import { counted } from "../numbers.js";
import { attempt, useAttempt } from "../parts/attempt.js";
import { Button } from "../parts/button.js";
import { Dialog } from "../parts/dialog.js";
import { Check, Field } from "../parts/field.js";
import { Given } from "../parts/given.js";
import { Failure } from "../parts/notice.js";
import { useResource } from "../parts/resource.js";
import { done } from "../parts/toast.js";
import { Problem } from "../problem.js";
import { ask, get } from "../rest.js";

const TIMES = /** @type {[string, string][]} */ ([["900", "15 minutes"], ["3600", "1 hour"], ["28800", "8 hours"], ["86400", "1 day"], ["", "Until it is unblocked"]]);

/** A button that opens the dialog. @param {{host?: string, small?: boolean, children: any, after?: () => void}} given `host`: its address or name */
export function Block({ host = "", small = false, children, after = () => {} }) {
  const [open, setOpen] = useState(false);
  return html`<${Button} role="operator" tone="danger" small=${small} onClick=${() => setOpen(true)}>${children}</${Button}>
    ${open && html`<${BlockDialog} host=${host} close=${() => setOpen(false)} after=${after} />`}`;
}

function BlockDialog(/** @type {{host: string, close: () => void, after: () => void}} */ { host, close, after }) {
  const [address, setAddress] = useState(host);
  const [seconds, setSeconds] = useState("3600");
  const [note, setNote] = useState("");
  const [force, setForce] = useState(false);
  const [error, attemptToBlock] = useAttempt();
  const block = () => attemptToBlock(async () => {
    const json = { address: address.trim(), for_seconds: seconds ? Number(seconds) : null, note, force };
    const { body } = await ask("POST", "/v1/blocks", { match: "*", json });
    const uses = body.ended.uses.length ? ` Ended: ${body.ended.uses.join("; ")}.` : "";
    const others = body.other_addresses.length ? ` Not blocked: its other address ${body.other_addresses.join(", ")}.` : "";
    const undo = async () => {
      await takeBack(body);
      after();
    };
    done(`${body.name || body.address} is blocked`, `It lost ${ended(body.ended)}.${uses}${others}`, undo);
    after();
    close();
  });
  const foot = html`<button class="button" onClick=${close}>Not now</button><${Button} role="operator" tone="danger" disabled=${!address.trim()} why="Enter the host's address or name first" onClick=${block}>Block the host</${Button}>`;
  return html`<${Dialog} title="Block this host?" close=${close} foot=${foot}><${Failure} error=${error} />
    <p>The host is refused at every entrance, whatever the policy says: its registrations, connections, sessions and tunnel end. When the block ends, the policy decides again.</p>
    <${Field} label="Address, or name of an enrolled host" mono value=${address} set=${setAddress} placeholder="10.0.0.7" maxlength="64" />
    <${Present} host=${address.trim()} />
    <${Field} label="For" value=${seconds} set=${setSeconds} options=${TIMES} />
    <${Field} label="Note for other operators" value=${note} set=${setNote} placeholder="tablet lost" maxlength="200" />
    ${error?.status === 422 && html`<${Check} label="Block it even if it is the robot's own host, or yours" on=${force} set=${setForce} />`}</${Dialog}>`;
}

/** Lift a block, or bring back the one that it replaced; a block that another operator has given since then stays. @param {any} block */
async function takeBack({ address, name, since, who, replaced }) {
  const { blocks } = await get("/v1/blocks");
  const now = blocks.find((/** @type {any} */ one) => one.address === address);
  if (now?.since !== since || now?.who !== who) {
    throw new Problem(412, { detail: now ? `${now.who} has blocked ${name || address} again since then: that block stays. Hosts lists it.` : `The block of ${name || address} has ended since then.` });
  }
  if (!replaced) await ask("DELETE", `/v1/blocks/${encodeURIComponent(address)}`, { match: "*" });
  else {
    const left = replaced.until === null ? null : Math.max(1, replaced.until - applianceNow());
    await ask("POST", "/v1/blocks", { match: "*", json: { address, for_seconds: left, note: replaced.note, force: true } });
  }
  done(replaced ? `${name || address} has its earlier block` : `${name || address} is no longer blocked`);
}

/** What would end. @param {{host: string}} given */
function Present({ host }) {
  const { value } = useResource((signal) => Promise.all([get("/v1/graph", {}, signal), get("/v1/hosts", {}, signal)]), []);
  if (!value || !host) return null;
  const [graph, { hosts }] = value;
  const address = hosts.find((/** @type {any} */ one) => one.name === host)?.address ?? host;
  const nodes = graph.nodes.filter((/** @type {any} */ one) => one.host === address);
  const sum = (/** @type {"publishes" | "subscribes" | "offers"} */ field) => nodes.reduce((/** @type {number} */ total, /** @type {any} */ one) => total + one[field].length, 0);
  if (!nodes.length) return html`<p class="muted">No node of this host is registered now.</p>`;
  return html`<div><p>Would end: ${ended({ publications: sum("publishes"), subscriptions: sum("subscribes"), services: sum("offers") })} of ${counted(nodes.length, "node")}.</p>
    <p class="muted"><${Given} value=${nodes.map((/** @type {any} */ one) => one.name).join(", ")} most=${300} /></p></div>`;
}

/** @param {Record<string, number>} counts */
function ended(counts) {
  const words = /** @type {[string, string][]} */ ([["publications", "publication"], ["subscriptions", "subscription"], ["services", "service"], ["parameters", "parameter subscription"], ["connections", "connection"]]);
  return words.filter(([name]) => counts[name]).map(([name, word]) => counted(counts[name], word)).join(", ") || "nothing: nothing of it was registered";
}

/** The blocked hosts, if there are any. @param {{mark: string}} given `mark`: changes when they do */
export function Blocked({ mark }) {
  const { value, again } = useResource((signal) => get("/v1/blocks", {}, signal), [mark]);
  useEffect(() => {
    const ends = (value?.blocks ?? []).flatMap((/** @type {any} */ one) => (one.until === null ? [] : [(one.until - applianceNow()) * 1000]));
    if (!ends.length) return undefined;
    const timer = setTimeout(again, Math.max(1000, Math.min(...ends, 2 ** 31 - 1)));
    return () => clearTimeout(timer);
  }, [value]);
  const unblock = (/** @type {any} */ one) => () => attempt(async () => {
    const { body } = await ask("DELETE", `/v1/blocks/${encodeURIComponent(one.address)}`, { match: "*" });
    done(`${one.name || one.address} is no longer blocked`, `${counted(body.restored, "registration")} returned.`);
  }, again);
  if (!value?.blocks.length) return null;
  return html`<section class="panel" aria-labelledby="blocked"><div class="panel-head"><h2 id="blocked">Blocked hosts</h2></div>
    <div class="table-wrap"><table class="table stacked"><thead><tr><th>Host</th><th>Since</th><th>Until</th><th>By</th><th>Note</th><th><span class="sr-only">Actions</span></th></tr></thead>
    <tbody>${value.blocks.map((/** @type {any} */ one) => html`<tr key=${one.address}><td class="first"><${Given} value=${one.address} mono /> ${one.name && html`<${Given} value=${one.name} />`}</td>
      <td data-label="Since" class="nowrap"><${Moment} at=${one.since} /></td><td data-label="Until" class="nowrap">${one.until === null ? "it is unblocked" : html`<${Moment} at=${one.until} />`}</td>
      <td data-label="By"><${Given} value=${one.who} most=${40} /></td><td data-label="Note"><${Given} value=${one.note} most=${200} /></td>
      <td><div class="row row-end"><${Button} small role="operator" onClick=${unblock(one)}>Unblock</${Button}></div></td></tr>`)}</tbody></table></div></section>`;
}
