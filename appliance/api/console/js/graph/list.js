/** The graph as a table, for reading and for screen readers. */

import { html, useState } from "../html.js";
import { bytes, counted, rate } from "../numbers.js";
import { Badge } from "../parts/badge.js";
import { Given } from "../parts/given.js";
import { Empty } from "../parts/notice.js";

const PAGE = 100;

/** @param {{topics: any[], denials: any[], choose: (key: string) => void, chosen: string | null}} given `denials`: records of the last hour */
export function TopicList({ topics, denials, choose, chosen }) {
  const [page, setPage] = useState(0);
  const pages = Math.max(1, Math.ceil(topics.length / PAGE));
  const at = Math.min(page, pages - 1);
  if (!topics.length) return html`<${Empty} icon="graph" title="No topic">No match, or no node has registered a topic.</${Empty}>`;
  return html`<div class="table-wrap"><table class="table stacked topics"><thead><tr><th>Topic</th><th>Type</th><th>Path</th><th>Publishers</th><th>Subscribers</th><th>Denied</th><th class="number">Per second</th></tr></thead>
    <tbody>${topics.slice(at * PAGE, (at + 1) * PAGE).map((one) => html`<tr key=${one.name} class=${chosen === `t${one.name}` ? "chosen" : ""}>
      <td class="first"><button class="link" onClick=${() => choose(`t${one.name}`)}><${Given} value=${one.name} mono most=${80} /></button></td><td data-label="Type"><${Given} value=${one.type} most=${60} mono /></td>
      <td data-label="Path">${one.mediated ? html`<${Badge} word="mediated" tone="note" />` : html`<${Badge} word="direct" />`}</td>
      <td data-label="Publishers"><div><${Names} names=${one.publishers.map((/** @type {any} */ each) => each.node)} /></div></td><td data-label="Subscribers"><div><${Names} names=${one.subscribers} /></div></td>
      <td data-label="Denied"><div><${Names} names=${[...new Set(denials.filter((/** @type {any} */ each) => each.resource === one.name).map((/** @type {any} */ each) => each.caller_id || each.host))]} none="no one" /></div></td>
      <td class="number" data-label="Per second"><div>${rate(sum(one, "messages_per_second"))}</div><div class="muted small nowrap">${bytes(sum(one, "bytes_per_second"))}</div></td></tr>`)}</tbody></table></div>
    ${pages > 1 && html`<div class="panel-body row"><button class="button small" disabled=${at === 0} onClick=${() => setPage(at - 1)}>Back</button>
      <span class="muted small">${at * PAGE + 1} to ${Math.min(topics.length, (at + 1) * PAGE)} of ${counted(topics.length, "topic")}</span>
      <button class="button small" disabled=${at === pages - 1} onClick=${() => setPage(at + 1)}>More</button></div>`}`;
}

function Names(/** @type {{names: string[], none?: string}} */ { names, none = "none" }) {
  if (!names.length) return html`<span class="muted">${none}</span>`;
  return html`${names.slice(0, 3).map((one) => html`<div key=${one}><${Given} value=${one} mono most=${50} /></div>`)}${names.length > 3 && html`<div class="muted small">and ${names.length - 3} more</div>`}`;
}

function sum(/** @type {any} */ topic, /** @type {string} */ field) {
  return topic.publishers.reduce((/** @type {number} */ total, /** @type {any} */ one) => total + one[field], 0);
}
