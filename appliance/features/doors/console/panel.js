/** Doors on the robot's page: who is connected, by which ticket, and where each door's rights are explained. */

import { html, useState } from "#console/html.js";
import { Moment } from "#console/moments.js";
import { count, counted } from "#console/numbers.js";
import { attempt, useAttempt } from "#console/parts/attempt.js";
import { Badge } from "#console/parts/badge.js";
import { Button } from "#console/parts/button.js";
import { Dialog } from "#console/parts/dialog.js";
import { Field } from "#console/parts/field.js";
import { Given } from "#console/parts/given.js";
import { Icon } from "#console/parts/icon.js";
import { Empty, Failure, Loading, Notice } from "#console/parts/notice.js";
import { useResource } from "#console/parts/resource.js";
import { done, failed } from "#console/parts/toast.js";
import { ask, get } from "#console/rest.js";
import { Link } from "#console/router.js";

const EVERY = 5000; // milliseconds
const HOURS = /** @type {[string, string][]} */ ([["1", "1 hour"], ["8", "8 hours"], ["24", "1 day"], ["168", "7 days"]]);

export function Doors() {
  const { value, error, heard, again } = useResource((signal) => get("/v1/doors", {}, signal), [], EVERY);
  const [adding, setAdding] = useState(false);
  const rows = value?.doors ?? [];
  const connected = rows.reduce((/** @type {number} */ sum, /** @type {any} */ one) => sum + one.connections, 0);
  return html`<section class="panel" aria-labelledby="doors"><div class="panel-head"><h2 id="doors">Doors</h2>${rows.length > 0 && html`<span class="muted small">${counted(connected, "connection")}</span>`}
      <span class="end"><${Button} small role="admin" onClick=${() => setAdding(true)}><${Icon} name="plus" size=${14} />Add a door…</${Button}></span></div>
    ${error && html`<div class="panel-body"><${Failure} error=${error} retry=${again} heard=${heard} /></div>`}
    ${!value ? !error && html`<${Loading} rows=${2} />`
      : !rows.length ? html`<${Empty} icon="key" title="No door">A door lets a browser, a viewer or an agent in, with rights of its own: the policy names it <code>door:NAME</code>.</${Empty}>`
      : html`<div class="table-wrap"><table class="table stacked"><thead><tr><th>Door</th><th>Opened by</th><th class="number">Connected</th><th class="number">Received</th><th class="number">Sent</th><th class="number">Dropped</th><th><span class="sr-only">Actions</span></th></tr></thead>
        <tbody>${rows.map((/** @type {any} */ one) => html`<${DoorRow} key=${one.name} door=${one} again=${again} />`)}</tbody></table></div>`}
    ${adding && html`<${Add} again=${again} close=${() => setAdding(false)} />`}</section>`;
}

function DoorRow(/** @type {{door: any, again: () => void}} */ { door, again }) {
  const [open, setOpen] = useState("");
  const close = () => setOpen("");
  const remove = async () => {
    close();
    await attempt(async () => {
      await ask("DELETE", `/v1/doors/${encodeURIComponent(door.name)}`, { match: "*" });
      done(`${door.name} is removed`, "Its connections and tickets have ended.", async () => {
        await ask("POST", "/v1/doors", { json: { name: door.name, port: door.port, source: door.source }, match: "*" });
        done(`${door.name} is back`, "Its tickets stay ended.");
        again();
      });
    }, again);
  };
  const rights = `/console/policy?${new URLSearchParams({ tab: "explain", host: `door:${door.name}`, node: door.node })}`;
  return html`<tr data-door=${door.name}>
    <td class="first"><strong><${Given} value=${door.name} most=${40} /></strong><div class="muted small"><${Given} value=${door.address} mono /> <${Given} value=${door.node} mono most=${60} /></div>
      ${door.trouble && html`<div><${Badge} word="does not serve" tone="deny" /> <span class="small"><${Given} value=${door.trouble} most=${200} /></span></div>`}</td>
    <td data-label="Opened by"><div>${door.port && html`<div>port ${door.port} from <${Given} value=${door.source || "anywhere"} mono />${!door.source && html` <${Badge} word="every host" tone="warn" />`}</div>`}
      ${door.tickets.map((/** @type {any} */ one) => html`<div key=${one.id} class="small">ticket <${Given} value=${one.id} mono /> until <${Moment} at=${one.expires} />, by <${Given} value=${one.who} most=${40} /></div>`)}
      ${!door.port && !door.tickets.length && html`<span class="muted small">no valid ticket</span>`}</div></td>
    <td class="number" data-label="Connected">${door.connections ? html`<${Clients} door=${door} />` : "0"}</td>
    <td class="number" data-label="Received">${count(door.received)}</td><td class="number" data-label="Sent">${count(door.sent)}</td>
    <td class="number" data-label="Dropped"><div>${count(door.dropped)}${door.refused > 0 && html`<div class="small muted">${counted(door.refused, "connection")} refused</div>`}</div></td>
    <td><div class="row row-end door-verbs"><${Link} class="button small" to=${rights}>Rights</${Link}><${Button} small role="operator" onClick=${() => setOpen("ticket")}>Ticket…</${Button}><${Button} small role="admin" tone="danger" onClick=${() => setOpen("remove")}>Remove</${Button}></div>
      ${open === "ticket" && html`<${Ticket} door=${door} again=${again} close=${close} />`}
      ${open === "remove" && html`<${Dialog} title=${`Remove ${door.name}?`} close=${close} foot=${html`<button class="button" onClick=${close}>Keep it</button><${Button} role="admin" tone="danger" onClick=${remove}>Remove</${Button}>`}>
        <p>Its ${counted(door.connections, "connection")} and ${counted(door.tickets.length, "ticket")} end at once. Its address stays reserved for its name.</p></${Dialog}>`}</td></tr>`;
}

/** The connections of a door, and what each did in the last minute. */
function Clients(/** @type {{door: any}} */ { door }) {
  const more = door.connections - door.clients.length;
  return html`<details class="door-clients"><summary><${Badge} word=${String(door.connections)} tone="allow" /><span class="sr-only"> connected: show them</span></summary><ul class="small">${door.clients.map((/** @type {any} */ one, /** @type {number} */ index) => html`<li key=${index}><${Given} value=${one.address} mono />${one.who && html` by <${Given} value=${one.who} most=${40} />`}
      <div class="muted">${one.protocol} since <${Moment} at=${one.since} /></div><div class="muted">in the last minute ${count(one.received)} received, ${count(one.sent)} sent${one.refused > 0 && `, ${counted(one.refused, "refusal")}`}</div></li>`)}${more > 0 && door.clients.length > 0 && html`<li class="muted">and ${more} more</li>`}</ul></details>`;
}

/** Make a ticket, and show it once. */
function Ticket(/** @type {{door: any, again: () => void, close: () => void}} */ { door, again, close }) {
  const [hours, setHours] = useState("8");
  const [made, setMade] = useState(/** @type {any} */ (null));
  const make = () => attempt(async () => {
    setMade((await ask("POST", `/v1/doors/${encodeURIComponent(door.name)}/tickets`, { json: { seconds: Number(hours) * 3600 }, match: "*" })).body);
  }, again);
  const address = made && `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}${made.path}`;
  const copy = async () => {
    try {
      await navigator.clipboard.writeText(address);
      done("The address is copied");
    } catch {
      failed(new Error("This browser does not let the page copy: select the address, and copy it."));
    }
  };
  const foot = made ? html`<button class="button" onClick=${close}>Close</button><${Button} tone="primary" onClick=${copy}>Copy</${Button}>`
    : html`<button class="button" onClick=${close}>Not now</button><${Button} role="operator" tone="primary" onClick=${make}>Make a ticket</${Button}>`;
  return html`<${Dialog} title=${`A ticket for ${door.name}`} close=${close} foot=${foot}>
    ${made ? html`<${Notice} tone="warn" title="Shown only here">Whoever has this address has the rights of <code>door:${door.name}</code> until <${Moment} at=${made.expires} always="day" />.</${Notice}>
        <${Field} label="Address of the WebSocket" mono value=${address} set=${() => {}} readonly onFocus=${(/** @type {any} */ event) => event.target.select()} hint="for a viewer's field for a rosbridge or Foxglove connection" />`
      : html`<p>A ticket is an address with which a browser or viewer opens this door.</p><${Field} label="Valid for" value=${hours} set=${setHours} options=${HOURS} />`}</${Dialog}>`;
}

function Add(/** @type {{again: () => void, close: () => void}} */ { again, close }) {
  const [name, setName] = useState("");
  const [port, setPort] = useState("");
  const [source, setSource] = useState("");
  const [error, attemptToAdd] = useAttempt();
  const add = () => attemptToAdd(async () => {
    const { body } = await ask("POST", "/v1/doors", { json: { name, port: port ? Number(port) : null, source }, match: "*" });
    done(`${body.name} is added`, `It has the address ${body.address}.`);
    again();
    close();
  });
  const submit = (/** @type {Event} */ event) => {
    event.preventDefault();
    if (name) add();
  };
  return html`<${Dialog} title="Add a door" close=${close} foot=${html`<button class="button" onClick=${close}>Not now</button><${Button} role="admin" tone="primary" disabled=${!name} why="It needs a name" onClick=${add}>Add</${Button}>`}>
    <${Failure} error=${error} />
    <form class="form-grid" onSubmit=${submit}><${Field} label="Name" mono value=${name} set=${setName} hint=${html`the policy names it door:${name || "NAME"}`} maxlength="31" />
      <${Field} label="Port for an agent" value=${port} set=${setPort} inputmode="numeric" hint="empty: only tickets open it" />
      <${Field} label="The agent's address" mono value=${source} set=${setSource} hint="or its network; empty: any host" /></form>
    ${port && !source && html`<${Notice} tone="warn" title="Every host that reaches this port has the rights of the door">Give the agent's address.</${Notice}>`}</${Dialog}>`;
}
