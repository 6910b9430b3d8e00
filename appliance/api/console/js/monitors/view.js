/** Monitors: topics, actions and state; a single monitor with its specification. */

import { html, useState } from "../html.js";
import { live } from "../live.js";
import { Moment } from "../moments.js";
import { count, counted } from "../numbers.js";
import { attempt } from "../parts/attempt.js";
import { Badge } from "../parts/badge.js";
import { Button } from "../parts/button.js";
import { By, Given } from "../parts/given.js";
import { Icon } from "../parts/icon.js";
import { Empty, Failure, Loading, Notice } from "../parts/notice.js";
import { Sparkline } from "../parts/plot.js";
import { done } from "../parts/toast.js";
import { ask } from "../rest.js";
import { Link, place } from "../router.js";
import { useStore } from "../store.js";
import { MonitorPage } from "./monitor.js";
import { LoadSpecification } from "./load.js";
import { counters, stateOf, useMonitors } from "./state.js";
import { Enforce, MonitorSwitch, Resume } from "./switches.js";

export function Monitors() {
  const { rest: chosen } = useStore(place);
  const monitors = useMonitors();
  const [loading, setLoading] = useState(false);
  const { body, error, heard, again } = monitors;
  if (!body) return html`<div class="head"><h1>Monitors</h1></div>${error ? html`<${Failure} error=${error} retry=${again} />` : html`<section class="panel"><${Loading} rows=${8} /></section>`}`;
  const row = body.monitors.find((/** @type {any} */ one) => one.name === chosen);
  const late = error ? html`<${Failure} error=${error} retry=${again} heard=${heard} />` : null;
  if (chosen) return html`${late}<${MonitorPage} key=${chosen} name=${chosen} row=${row} monitors=${monitors} />`;
  const reload = () => attempt(async () => {
    const { body: now } = await ask("POST", "/v1/monitors/reload", { match: monitors.etag });
    done(`Revision ${now.revision} of the specifications is in force`, "They are the folder's.");
    await again();
  });
  return html`<div class="head"><h1>Monitors</h1><span class="head-sub">revision ${body.revision}, loaded <${Moment} at=${body.loaded} /> <${By} who=${body.who} />${body.note && html`: <${Given} value=${body.note} most=${80} />`}</span>
      <div class="head-actions"><${Button} role="admin" tone="primary" onClick=${() => setLoading(true)}><${Icon} name="up" size=${16} />Load a specification</${Button}></div></div>
    <div class="standing">${late}
      ${body.refused.length > 0 && html`<${Notice} tone="deny" title="The relay rejected the specifications: all topics are blocked">${body.refused.map((/** @type {string} */ one) => html`<div key=${one}><${Given} value=${one} most=${400} /></div>`)}</${Notice}>`}
      ${body.differs_from_folder && html`<${Notice} title="The specifications in force differ from the folder"><div class="row"><span><${Given} value=${body.folder} mono most=${120} /></span><${Button} small role="operator" onClick=${reload}><${Icon} name="again" size=${14} />Load the folder's</${Button}></div></${Notice}>`}
      ${body.warnings.length > 0 && html`<details class="notice warn"><summary>${counted(body.warnings.length, "warning")} about the specifications</summary><ul class="plain-list">${body.warnings.map((/** @type {string} */ one) => html`<li key=${one}><${Given} value=${one} most=${400} /></li>`)}</ul></details>`}</div>
    <section class="panel" aria-label="Monitors">${body.monitors.length === 0
      ? html`<${Empty} icon="monitors" title="No monitor is loaded">Load a specification (.rv), or start the appliance with <code>--monitors FOLDER</code>. See docs/monitors-tutorial.md for an example.</${Empty}>`
      : html`<${MonitorTable} monitors=${monitors} />`}</section>
    ${loading && html`<${LoadSpecification} etag=${monitors.etag} files=${body.monitors.map((/** @type {any} */ one) => one.file)} signed=${body.site_keys.length > 0} close=${() => setLoading(false)} loaded=${again} />`}`;
}

function MonitorTable(/** @type {{monitors: any}} */ { monitors }) {
  const samples = useStore(live, (one) => one.samples);
  return html`<div class="table-wrap"><table class="table stacked monitors"><thead><tr><th>On</th><th>Monitor</th><th>State</th><th>Watches</th><th class="number">Events</th><th class="number">Verdicts</th><th class="number">Dropped</th><th class="number">Changed</th><th class="number">Faults</th><th>Actions, last hour</th></tr></thead>
    <tbody>${monitors.body.monitors.map((/** @type {any} */ one) => html`<tr key=${one.name} data-monitor=${one.name}>
      <td data-label="On"><${MonitorSwitch} row=${one} monitors=${monitors} /></td>
      <td class="first"><${Link} to=${`/console/monitors/${encodeURIComponent(one.name)}`}><strong><${Given} value=${one.name} most=${60} /></strong></${Link}><div class="muted small"><${Given} value=${one.file} most=${60} /></div></td>
      <td data-label="State"><${Badge} word=${stateOf(one)} />${one.off_until && html`<div class="small muted">until <${Moment} at=${one.off_until} /></div>`}${one.shadow && html`<div class="held"><${Enforce} row=${one} monitors=${monitors} /></div>`}${one.held && !one.error && html`<div class="held"><${Resume} row=${one} monitors=${monitors} /></div>`}</td>
      <td data-label="Watches"><div>${[...one.topics, ...one.services].slice(0, 3).map((/** @type {string} */ name) => html`<div key=${name}><${Given} value=${name} mono most=${60} /></div>`)}${one.topics.length + one.services.length > 3 && html`<div class="muted small">and ${one.topics.length + one.services.length - 3} more</div>`}</div></td>
      <td class="number" data-label="Events">${count(one.events)}</td><td class="number" data-label="Verdicts">${count(one.verdicts)}</td><td class="number" data-label="Dropped">${one.shadow ? html`<span class="muted" title="would have dropped">(${count(one.would_drop)})</span>` : count(one.drops)}</td><td class="number" data-label="Changed">${one.shadow ? html`<span class="muted" title="would have changed">(${count(one.would_change)})</span>` : count(one.changes)}</td>
      <td class="number" data-label="Faults">${one.faults ? html`<${Badge} word=${count(one.faults)} tone="deny" />` : "0"}</td>
      <td data-label="Actions"><${Sparkline} label=${`Actions of ${one.name} in the last hour`} colour="c3" points=${summed(samples, one.name)} /></td></tr>`)}</tbody></table></div>`;
}

/** The sum of verdicts, drops and changes. */
function summed(/** @type {any[]} */ samples, /** @type {string} */ name) {
  const [first, ...rest] = [0, 1, 2].map((place) => counters(samples, name, place));
  return first.map((point, index) => ({ time: point.time, value: point.value === null ? null : rest.reduce((sum, one) => sum + (one[index].value ?? 0), point.value) }));
}
