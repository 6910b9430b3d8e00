/** The door of the signed-in person on the robot's page. Its picture, plot and pad are loaded when it is opened. */

import { html, useEffect, useState } from "#console/html.js";
import { OUTDATED } from "#console/outdated.js";
import { attempt } from "#console/parts/attempt.js";
import { Badge } from "#console/parts/badge.js";
import { Button } from "#console/parts/button.js";
import { Field } from "#console/parts/field.js";
import { Given } from "#console/parts/given.js";
import { Failure, Loading, Notice } from "#console/parts/notice.js";
import { inTime, useResource } from "#console/parts/resource.js";
import { done, failed } from "#console/parts/toast.js";
import { ask, get } from "#console/rest.js";
import { Link } from "#console/router.js";
import { session } from "#console/session.js";
import { useStore } from "#console/store.js";

const STARTING = 2000; // milliseconds between two looks at a door that does not serve yet
const PARTS = { Button, Failure, Field, Given, Loading, Notice, ask, failed, optional };

export function OwnDoor() {
  const { value, error, heard, again } = useResource((signal) => get("/v1/door", {}, signal), [], (value) => (value?.door?.trouble ? STARTING : 0));
  const [open, setOpen] = useState(/** @type {{Teleop: any, ticket: string} | null} */ (null));
  const [ended, setEnded] = useState("");
  const signedIn = useStore(session, ({ current }) => current !== null);
  const door = value?.door;
  useEffect(() => {
    if (!signedIn) setOpen(null);
  }, [signedIn]);
  const enter = async () => {
    setEnded("");
    try {
      const { Teleop } = await loaded();
      const { body } = await ask("POST", "/v1/door/tickets", { match: "*" });
      setOpen({ Teleop, ticket: `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}${body.path}` });
    } catch (failure) {
      failed(failure);
      again();
    }
  };
  const leave = (/** @type {string} */ reason) => {
    setOpen(null);
    setEnded(reason);
    again();
  };
  const add = () => attempt(async () => {
    await ask("POST", "/v1/doors", { json: { name: value.name }, match: "*" });
    done(`${value.name} is added`, `It has the rights of door:${value.name} in the policy.`);
  }, again);
  const rights = door && `/console/policy?${new URLSearchParams({ tab: "explain", host: `door:${door.name}`, node: door.node })}`;
  return html`<section class="panel" aria-labelledby="own-door"><div class="panel-head"><h2 id="own-door">Your door</h2>${door && html`<${Badge} word=${`door:${door.name}`} tone="note" />`}
      ${door && html`<span class="end"><${Link} class="button small" to=${rights}>Rights</${Link}>${open ? html`<${Button} small onClick=${() => leave("")}>Close</${Button}>` : html`<${Button} small tone="primary" disabled=${door.trouble !== ""} why=${door.trouble} onClick=${enter}>Open</${Button}>`}</span>`}</div>
    ${error && html`<div class="panel-body"><${Failure} error=${error} retry=${again} heard=${heard} /></div>`}
    ${!value ? !error && html`<${Loading} rows=${1} />`
      : !door ? html`<div class="panel-body row"><span><${Given} value=${value.reason} most=${300} /></span>${value.name && html`<${Button} small role="admin" onClick=${add}>Add door ${value.name}</${Button}>`}</div>`
      : open && signedIn ? html`<${open.Teleop} key=${open.ticket} parts=${PARTS} ticket=${open.ticket} name=${door.name} address=${door.address} ended=${leave} />`
      : html`<div class="panel-body stack-tight">${ended && html`<${Notice} tone="warn" title="Closed" role="status"><${Given} value=${ended} most=${300} /></${Notice}>`}
        <p class="muted">${door.trouble ? html`<${Given} value=${door.trouble} most=${200} />` : "A picture, a plot and a pad, with the rights of your door."}</p></div>`}</section>`;
}

async function loaded() {
  try {
    return await import("./teleop/view.js");
  } catch {
    throw new Error(OUTDATED);
  }
}

/** The answer to a request, or null if the appliance has no such path. */
async function optional(/** @type {string} */ path) {
  try {
    return await inTime((signal) => get(path, undefined, signal));
  } catch (failure) {
    if (/** @type {any} */ (failure).status === 404) return null;
    throw failure;
  }
}
