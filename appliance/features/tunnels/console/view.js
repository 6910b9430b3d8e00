/** Hosts: tunnels, certificates, open ports; enrol and revoke. */

import { html, useState } from "#console/html.js";
import { live } from "#console/live.js";
import { lasting, Moment } from "#console/moments.js";
import { bytes, counted } from "#console/numbers.js";
import { attempt } from "#console/parts/attempt.js";
import { Badge } from "#console/parts/badge.js";
import { Button } from "#console/parts/button.js";
import { Given } from "#console/parts/given.js";
import { Host } from "#console/parts/host.js";
import { Icon } from "#console/parts/icon.js";
import { Empty, Failure, Loading, Notice } from "#console/parts/notice.js";
import { useResource } from "#console/parts/resource.js";
import { done } from "#console/parts/toast.js";
import { ask } from "#console/rest.js";
import { useStore } from "#console/store.js";
import { Block, Blocked } from "#console/hosts/block.js";
import { Enrol } from "./enrol.js";
import { Revoke } from "./revoke.js";

const EVERY = 30_000; // milliseconds
const TONES = { up: "allow", down: "warn", expired: "deny", revoked: "", "not wanted": "", awaited: "note", "not enrolled": "" };

export function Hosts() {
  const [open, setOpen] = useState(/** @type {{what: "enrol" | "again" | "revoke", host?: any} | null} */ (null));
  const mark = useStore(live, (one) => JSON.stringify(one.status?.ipsec ?? null));
  const blocks = useStore(live, (one) => JSON.stringify(one.status?.blocks ?? null));
  const isolation = useStore(live, (one) => one.status?.isolation);
  const { value, error, heard, again } = useResource((signal) => ask("GET", "/v1/hosts", { signal }), [mark], EVERY);
  const body = value?.body;
  const etag = value?.etag ?? "";
  if (!body) return html`<div class="head"><h1>Hosts</h1></div>${error ? html`<${Failure} error=${error} retry=${again} />` : html`<section class="panel"><${Loading} rows=${8} /></section>`}`;
  const reload = () => attempt(async () => {
    const { body: now } = await ask("POST", "/v1/hosts/reload", { match: etag });
    done("hosts.yaml was read again", `${counted(now.declared.length, "host")} declared.`);
    again();
  });
  return html`<div class="head"><h1>Hosts</h1><span class="head-sub">${counted(body.hosts.length, "tunnel")}, ${body.hosts.filter((/** @type {any} */ one) => one.state === "up").length} up; ${counted(body.machines.length, "other machine")} without a tunnel</span>
      <div class="head-actions"><${Button} role="operator" onClick=${reload} title=${`Read ${body.hosts_file} again`}><${Icon} name="again" size=${16} />Reload hosts.yaml</${Button}><${Block}>Block a host…</${Block}><${Button} role="admin" tone="primary" onClick=${() => setOpen({ what: "enrol" })}><${Icon} name="plus" size=${16} />Enrol a host</${Button}></div></div>
    <div class="standing"><${Failure} error=${error} retry=${again} heard=${heard} />${isolation === "none" && html`<${Notice} title="Tunnels need isolation netns or container">With isolation none the appliance shares the robot's network, and no host can be enrolled.</${Notice}>`}
      ${body.troubles.map((/** @type {string} */ one) => html`<${Notice} key=${one} tone="warn" title="Needs attention"><${Given} value=${one} most=${400} /></${Notice}>`)}</div>
    <div class="stack"><${Blocked} mark=${blocks} /><section class="panel" aria-label="Hosts with tunnels">${!body.hosts.length ? html`<${Empty} icon="hosts" title="No host is enrolled">Enrol an operator's laptop or a second robot: it gets a name (host:NAME in the policy) and an address that no other host can use.</${Empty}>` : html`<${HostTable} hosts=${body.hosts} open=${setOpen} />`}</section>
      <section class="panel" aria-labelledby="machines"><div class="panel-head"><h2 id="machines">Other machines without a tunnel</h2></div>${!body.machines.length ? html`<${Empty} icon="hosts" title="No other machine runs nodes without a tunnel">Nodes on the appliance's own machine are in the graph only.</${Empty}>` : html`<${MachineTable} machines=${body.machines} />`}</section>
      <section class="panel"><div class="panel-body"><dl class="facts"><dt>ESP runs in</dt><dd>${body.esp ?? html`<span class="muted">no tunnels are open</span>`}</dd><dt>Key exchange</dt><dd>${body.key_exchange.length ? html`<${Given} value=${body.key_exchange.join(", ")} mono />` : html`<span class="muted">not known yet</span>`}${body.post_quantum === null ? "" : body.post_quantum ? html` <${Badge} word="post-quantum" tone="allow" />` : html` <${Badge} word="not post-quantum" />`}</dd>
        <dt>Addresses</dt><dd><${Given} value=${body.pool} mono />, the appliance is <${Given} value=${body.address} mono /></dd><dt>Declared in</dt><dd><${Given} value=${body.hosts_file} mono most=${200} /></dd></dl></div></section></div>
    ${open?.what === "revoke" && html`<${Revoke} host=${open.host} etag=${etag} close=${() => setOpen(null)} after=${again} />`}
    ${(open?.what === "enrol" || open?.what === "again") && html`<${Enrol} host=${open.host} etag=${etag} close=${() => setOpen(null)} after=${again} />`}`;
}

function HostTable(/** @type {{hosts: any[], open: (what: any) => void}} */ { hosts, open }) {
  return html`<div class="table-wrap"><table class="table stacked hosts"><thead><tr><th>Host</th><th>Tunnel</th><th>Address</th><th>From</th><th>Certificate until</th><th>Last seen</th><th>Ports</th><th><span class="sr-only">Actions</span></th></tr></thead>
    <tbody>${hosts.map((one) => html`<tr key=${one.name} data-host=${one.name}><td class="first"><strong><${Given} value=${one.name} /></strong>${one.groups.length > 0 && html`<div class="muted small"><${Given} value=${one.groups.join(", ")} most=${80} /></div>`}${one.divergence && html`<div class="small"><${Given} value=${one.divergence} most=${200} /></div>`}</td>
      <td data-label="Tunnel"><div><${Badge} word=${one.state} tone=${TONES[/** @type {keyof typeof TONES} */ (one.state)]} />${one.state === "up" && html`<div class="muted small nowrap">for ${lasting(one.seconds)}</div>`}${one.token_expires && html`<div class="muted small">token until <${Moment} at=${one.token_expires} /></div>`}</div></td>
      <td data-label="Address"><${Given} value=${one.address} mono /></td><td data-label="From"><div><${Given} value=${one.remote} mono />${one.remote && html`<div class="muted small nowrap">${bytes(one.bytes_in)} in, ${bytes(one.bytes_out)} out</div>`}</div></td>
      <td class="nowrap" data-label="Certificate"><div>${one.expires === null ? html`<span class="muted">–</span>` : html`<${Moment} at=${one.expires} always="day" />`}${one.expires_soon && html`<div><${Badge} word="expires soon" tone="warn" /></div>`}${one.renewing && html`<div class="muted small">a renewed certificate waits for the host</div>`}</div></td>
      <td class="nowrap" data-label="Last seen"><${Moment} at=${one.last_seen} /></td><td data-label="Ports"><${Ports} ports=${one.ports} address=${one.address} /></td>
      <td><div class="row row-end"><${Block} small host=${one.name}>Block…</${Block}>${one.state !== "revoked" && html`<${Button} small role="admin" onClick=${() => open({ what: "again", host: one })}>${one.enrolled === null ? "Token" : "New kit"}</${Button}>`}${one.enrolled !== null && one.revoked === null && html`<${Button} small role="admin" tone="danger" onClick=${() => open({ what: "revoke", host: one })}>Revoke</${Button}>`}</div></td></tr>`)}</tbody></table></div>`;
}

function MachineTable(/** @type {{machines: any[]}} */ { machines }) {
  return html`<div class="table-wrap"><table class="table stacked"><thead><tr><th>Machine</th><th class="number">Nodes</th><th>Ports of its nodes</th><th><span class="sr-only">Actions</span></th></tr></thead><tbody>${machines.map((one) => html`<tr key=${one.address}><td class="first"><${Host} value=${one.address} /></td><td class="number" data-label="Nodes">${one.nodes}</td><td data-label="Ports"><${Ports} ports=${one.ports} address=${one.address} /></td><td><div class="row row-end"><${Block} small host=${one.address}>Block…</${Block}></div></td></tr>`)}</tbody></table></div>`;
}

/** The last check's result: whether other machines can reach the ports of the host's nodes. */
function Ports(/** @type {{ports: any, address: string}} */ { ports, address }) {
  const tone = { closed: "allow", open: "deny", unknown: "" }[/** @type {string} */ (ports.state)];
  return html`<div><${Badge} word=${ports.state} tone=${tone} />${ports.state === "unknown" ? html`<div class="muted small">on another machine: <code>rosrv protect --check ${address}</code></div>` : html`<div class="muted small">seen <${Moment} at=${ports.checked} /></div>`}
    ${ports.open.length > 0 && html`<div class="small mono">${ports.open.slice(0, 8).join(", ")}${ports.open.length > 8 ? " …" : ""}</div>`}</div>`;
}
