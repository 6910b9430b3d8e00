/** Command authority on the robot's page: who holds each group of topics and services, who waits, and the hand-over. */

import { html, useId, useState } from "#console/html.js";
import { lasting } from "#console/moments.js";
import { attempt } from "#console/parts/attempt.js";
import { Badge } from "#console/parts/badge.js";
import { Button } from "#console/parts/button.js";
import { Dialog } from "#console/parts/dialog.js";
import { Field } from "#console/parts/field.js";
import { Given } from "#console/parts/given.js";
import { Host, Sentence, useHosts } from "#console/parts/host.js";
import { Empty, Failure, Loading } from "#console/parts/notice.js";
import { done } from "#console/parts/toast.js";
import { ask } from "#console/rest.js";
import { isSilent, isStuck, NotCarried, useGroups } from "./situation.js";

const VERBS = { assign: "Assign", free: "Free", ask: "Ask" }; // as those of `rosrv drive`

export function Drive() {
  const { value, error, heard, again, rows } = useGroups();
  return html`<section class="panel" aria-labelledby="drive"><div class="panel-head"><h2 id="drive">Who drives</h2></div>
    ${error && html`<div class="panel-body"><${Failure} error=${error} retry=${again} heard=${heard} /></div>`}
    ${!value ? !error && html`<${Loading} rows=${2} />`
      : !rows.length ? html`<${Empty} icon="hosts" title="No command authority">Every host with the right to publish commands the robot. <code>[Authority]</code> in the policy names topics that one host at a time commands.</${Empty}>`
      : html`<div class="table-wrap"><table class="table stacked"><thead><tr><th>Group</th><th>Driver or holder</th><th>Waits</th><th><span class="sr-only">Actions</span></th></tr></thead>
        <tbody>${rows.map((/** @type {any} */ one) => html`<${Group} key=${one.group} group=${one} again=${again} />`)}</tbody></table></div>`}</section>`;
}

function Group(/** @type {{group: any, again: () => void}} */ { group, again }) {
  const [open, setOpen] = useState(/** @type {keyof typeof VERBS | ""} */ (""));
  const button = (/** @type {keyof typeof VERBS} */ verb, /** @type {any} */ more = {}) => html`<${Button} small role="operator" ...${more} onClick=${() => setOpen(verb)}>${VERBS[verb]}…</${Button}>`;
  return html`<tr data-group=${group.group}>
    <td class="first"><strong><${Given} value=${group.group} most=${64} /></strong><div class="muted small">${group.names.map((/** @type {string} */ name) => html`<div key=${name}><${Given} value=${name} mono most=${80} /></div>`)}</div></td>
    <td data-label=${group.ranks.length ? "Driver" : "Holder"}><div>${group.ranks.length ? html`<${Badge} word=${group.standing} tone=${isStuck(group) ? "warn" : ""} /> ${group.held_seconds !== null && html`<span class="nowrap">for ${lasting(group.held_seconds)}</span>: `}<${Sentence} value=${group.why} most=${200} /><div class="muted small"><${Given} value=${group.ranks.join(" > ")} mono most=${200} /></div>` : group.holder ? html`<${Host} value=${group.holder} /><div class="muted small">for ${lasting(group.held_seconds)}; ends after ${lasting(group.lease)} of silence${isSilent(group) && html` <${Badge} word=${`silent: ${group.left_seconds.toFixed(1)} s left`} tone="warn" />`}</div>` : html`<${Badge} word="no host" />`}${group.not_carried.map((/** @type {any} */ one) => html`<div key=${`${one.host} ${one.topic}`} class="muted small"><${NotCarried} one=${one} /></div>`)}</div></td>
    ${group.ranks.length ? html`<td></td>` : html`<td data-label="Waits"><div>${group.waiting.length ? group.waiting.map((/** @type {string} */ host) => html`<div key=${host}><${Host} value=${host} /></div>`) : html`<span class="muted">–</span>`}</div></td>`}
    <td><div class="row row-end">${group.ranks.length ? button("free", { disabled: !isStuck(group), why: "No lower rank waits for a person" }) : html`${button("assign", { tone: group.holder ? "" : "primary" })}${button("free", { disabled: !group.holder, why: "No host holds it" })}${button("ask")}`}</div>
      ${open && html`<${HandOver} verb=${open} group=${group} again=${again} close=${() => setOpen("")} />`}</td></tr>`;
}

function HandOver(/** @type {{verb: keyof typeof VERBS, group: any, again: () => void, close: () => void}} */ { verb, group, again, close }) {
  const [host, setHost] = useState(verb === "free" ? (group.waiting[0] ?? "") : "");
  const [holder] = useState(group.holder); // the order is for the state that the person saw when the dialog opened
  const hosts = useHosts();
  const id = useId();
  const free = verb === "free";
  const go = () => attempt(async () => {
    const { body } = await ask("POST", `/v1/drive/${encodeURIComponent(group.group)}/${verb}`, { json: group.ranks.length ? {} : { free: { to: host, holder }, assign: { host, holder }, ask: { host } }[verb], match: "*" });
    done(body.ranks.length ? `${body.group} is ${body.standing}` : body.holder ? `${body.holder} holds ${body.group}` : `No host holds ${body.group}`, body.waiting.length ? `${body.waiting.length} waiting` : "");
    close();
  }, again);
  const text = {
    assign: html`${holder && html`<${Host} value=${holder} /> loses the group. `}The host drives from now on, if the policy lets it take the group or override its holder. Messages of all other hosts on these topics are dropped.`,
    free: group.ranks.length ? "The group is handed back: the next node that moves drives." : html`<${Host} value=${holder} /> loses the group. It goes to this host, or without one to the first that waits.`,
    ask: "The host waits for the group. It gets the group once that is free, if the policy lets it take the group.",
  }[verb];
  const submit = (/** @type {Event} */ event) => {
    event.preventDefault();
    if (host || free) go();
  };
  return html`<${Dialog} title=${`${VERBS[verb]} ${group.group}`} close=${close} foot=${html`<button class="button" onClick=${close}>Not now</button><${Button} role="operator" tone="primary" disabled=${!host && !free} why="Name a host" onClick=${go}>${VERBS[verb]}</${Button}>`}>
    <p>${text}</p>${!group.ranks.length && html`<form onSubmit=${submit}><${Field} label="Host" mono value=${host} set=${setHost} list=${id} hint="an address, or the name of a host" /></form>`}
    <datalist id=${id}>${hosts.map((one) => html`<option key=${one} value=${one}></option>`)}</datalist></${Dialog}>`;
}
