/** Details of the selected item: publishers, subscribers, rates; for a denial the rule and its line. */

import { html } from "../html.js";
import { Moment } from "../moments.js";
import { bytes, count, counted, rate } from "../numbers.js";
import { Badge } from "../parts/badge.js";
import { Given } from "../parts/given.js";
import { Host, Sentence } from "../parts/host.js";
import { Icon } from "../parts/icon.js";
import { Rule } from "../parts/rule.js";
import { Link } from "../router.js";
import { Messages } from "./messages.js";
import { Rates } from "./rates.js";

const MAX = 60;

/** @param {{item: any, line: any, denials: any[], shown: {items: Map<string, any>, lines: Map<string, any>}, choose: (key: string | null) => void, open: (key: string) => void}} given `shown`: all that is drawn */
export function Details({ item, line, denials, shown, choose, open }) {
  const title = line ? "Denied" : item.members ? "Group" : { node: "Node", topic: "Topic", service: "Service", party: item.owners ? "Uses other hosts' names" : "Denied host", missing: "Denied, not in the graph", master: "RVMaster" }[/** @type {string} */ (item.kind)];
  return html`<section class="panel details" aria-labelledby="details"><div class="panel-head"><h2 id="details">${title}</h2>
      <span class="end"><button class="button plain small" onClick=${() => choose(null)} aria-label="Close the details"><${Icon} name="close" size=${16} /></button></span></div>
    <div class="panel-body stack">${line ? html`<${Attempt} records=${line.denials} />` : item.members ? html`<${Group} item=${item} shown=${shown} choose=${choose} open=${open} />`
      : html`<h3><${Given} value=${item.name} most=${300} mono /></h3>${part(item, choose)}<${Refusals} item=${item} denials=${denials} />`}</div></section>`;
}

function part(/** @type {any} */ item, /** @type {(key: string) => void} */ choose) {
  const row = item.row;
  if (item.owners) return html`<p>This host was denied ${counted(item.denied, "time")} under names of nodes of <${Given} value=${item.owners.join(", ")} most=${200} mono />.</p>`;
  if (!row) return html`<p class="muted"><${Given} value=${item.sub} /></p>`;
  if (item.kind === "node")
    return html`<dl class="facts"><dt>Host</dt><dd><${Host} value=${row.host} /></dd><dt>State</dt><dd><${Badge} word=${row.state} /></dd></dl>
      <${Names} title="Publishes" names=${row.publishes} letter="t" choose=${choose} /><${Names} title="Subscribes" names=${row.subscribes} letter="t" choose=${choose} /><${Names} title="Offers" names=${row.offers} letter="s" choose=${choose} />`;
  const path = html`<dt>Path</dt><dd>${row.mediated ? html`<${Badge} word="mediated" tone="note" /> through the relay` : html`<${Badge} word="direct" /> bypasses the appliance`}</dd>`;
  if (item.kind === "service")
    return html`<dl class="facts"><dt>Offered by</dt><dd><${Given} value=${row.node} mono /></dd>${path}<dt>Messages</dt><dd>${count(row.messages)}</dd><dt>Clients now</dt><dd>${row.connections.length}</dd></dl>`;
  return html`<dl class="facts"><dt>Type</dt><dd><${Given} value=${row.type} mono /></dd>${path}</dl>
    <div><h3>${counted(row.publishers.length, "publisher")}</h3><ul class="plain-list">${row.publishers.slice(0, MAX).map((/** @type {any} */ one) => html`<li key=${one.node}><button class="link" onClick=${() => choose(`n${one.node}`)}><${Given} value=${one.node} mono /></button>${" "}
      <span class="muted small">${rate(one.messages_per_second)} messages/s, ${bytes(one.bytes_per_second)}/s, ${count(one.messages)} in all${one.dropped ? `, ${count(one.dropped)} dropped` : ""}</span></li>`)}</ul></div>
    <${Names} title="Subscribers" names=${row.subscribers} letter="n" choose=${choose} />
    ${row.mediated && row.publishers.length > 0 && html`<${Rates} key=${row.name} topic=${row} /><${Messages} key=${`m${row.name}`} topic=${row.name} />`}`;
}

function Names(/** @type {{title: string, names: string[], letter: string, choose: (key: string) => void}} */ { title, names, letter, choose }) {
  if (!names.length) return null;
  return html`<div><h3>${title} <span class="muted">${names.length}</span></h3><ul class="plain-list">${names.slice(0, MAX).map((name) => html`<li key=${name}><button class="link" onClick=${() => choose(letter + name)}><${Given} value=${name} mono /></button></li>`)}
    ${names.length > MAX && html`<li class="muted">and ${names.length - MAX} more</li>`}</ul></div>`;
}

function Group(/** @type {{item: any, shown: {items: Map<string, any>, lines: Map<string, any>}, choose: (key: string) => void, open: (key: string) => void}} */ { item, shown, choose, open }) {
  const lines = [...shown.lines.values()];
  const ends = (/** @type {"from" | "to"} */ own, /** @type {"from" | "to"} */ other, /** @type {string} */ kind) => lines.filter((one) => one.kind === kind && one[own] === item.key && one[other] !== item.key).map((one) => ({ line: one, end: shown.items.get(one[other]) })).filter(({ end }) => end);
  return html`<h3><${Given} value=${item.name} mono /></h3><p class="muted">${item.sub}, drawn as one.</p><button class="button" onClick=${() => open(item.key)}>Open the group</button>
    <${Ends} title="Gets messages from" ends=${ends("to", "from", "flow")} choose=${choose} /><${Ends} title="Sends messages to" ends=${ends("from", "to", "flow")} choose=${choose} />
    <${Ends} title="Others denied here" ends=${ends("to", "from", "denied")} choose=${choose} /><${Ends} title="Denied at" ends=${ends("from", "to", "denied")} choose=${choose} />
    <h3>In it</h3>
    <ul class="plain-list">${item.members.slice(0, MAX).map((/** @type {any} */ one) => html`<li key=${one.key}><${Given} value=${one.name} mono /></li>`)}${item.members.length > MAX && html`<li class="muted">and ${item.members.length - MAX} more</li>`}</ul>`;
}

function Ends(/** @type {{title: string, ends: {line: any, end: any}[], choose: (key: string) => void}} */ { title, ends, choose }) {
  if (!ends.length) return null;
  return html`<div><h3>${title}</h3><ul class="plain-list">${ends.map(({ line, end }) => html`<li key=${line.key}><button class="link" onClick=${() => choose(line.kind === "denied" ? line.key : end.key)}><${Given} value=${end.name} mono /></button>
    ${line.kind === "denied" ? html` <${Badge} word=${line.would ? "would deny" : "deny"} />` : html` <span class="muted small">${rate(line.rate)} messages/s</span>`}</li>`)}</ul></div>`;
}

function Attempt(/** @type {{records: any[]}} */ { records }) {
  const first = records[0];
  return html`<div class="stack-tight"><div class="row"><${Badge} word=${first.decision} /><span class="muted small">${counted(records.length, "time")}, last <${Moment} at=${first.time} /></span></div>
      <p><${Sentence} value=${first.reason} most=${500} /></p></div>
    <dl class="facts"><dt>Who</dt><dd><${Given} value=${first.caller_id} mono none="no name" /></dd><dt>Host</dt><dd><${Host} value=${first.host} /></dd><dt>Wanted</dt><dd>${first.category} <${Given} value=${first.resource} mono /></dd>
      <dt>Rule</dt><dd><${Rule} rule=${first.rule} revision=${first.revision} /></dd></dl>
    <div class="row"><${Link} class="button" to=${`/console/audit/${first.id}`}>Open the record</${Link}>
      <${Link} class="button" to=${explainPath(first)}>Explain</${Link}></div>
    ${records.length > 1 && html`<div><h3>All of them</h3><ul class="plain-list">${records.slice(0, 20).map((one) => html`<li key=${one.id}><${Link} to=${`/console/audit/${one.id}`}><${Moment} at=${one.time} /></${Link}> <span class="muted">${one.category}</span> <${Given} value=${one.resource} mono /></li>`)}</ul></div>`}`;
}

function Refusals(/** @type {{item: any, denials: any[]}} */ { item, denials }) {
  const own = denials.filter((one) =>
    item.kind === "party" ? one.host === item.host
    : item.kind === "node" ? one.caller_id === item.name && one.host === item.host : one.resource === item.name).slice(0, 8);
  if (!own.length) return null;
  return html`<div><h3>Recently denied</h3><ul class="plain-list">${own.map((one) => html`<li key=${one.id}><${Link} to=${`/console/audit/${one.id}`}><${Moment} at=${one.time} /></${Link}> <span class="muted">${one.category}</span> <${Given} value=${item.kind === "topic" ? one.caller_id : one.resource} mono />${item.callers?.length > 1 && html` <span class="muted">as</span> <${Given} value=${one.caller_id} mono />`}
    <div class="small"><${Rule} rule=${one.rule} revision=${one.revision} /></div></li>`)}</ul></div>`;
}

function explainPath(/** @type {any} */ one) {
  const words = new URLSearchParams({ tab: "explain", host: one.host ?? "", node: one.caller_id ?? "", category: one.category ?? "", resource: one.resource ?? "" });
  return `/console/policy?${words}`;
}
