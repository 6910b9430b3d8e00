/** Guards that fit the running robot, each with a button that makes it in shadow mode. */

import { html, useState } from "#console/html.js";
import { Button } from "#console/parts/button.js";
import { Dialog } from "#console/parts/dialog.js";
import { Given } from "#console/parts/given.js";
import { Empty, Failure, Loading, Notice } from "#console/parts/notice.js";
import { useResource } from "#console/parts/resource.js";
import { get } from "#console/rest.js";

/** @param {{guards: ReturnType<typeof import("./state.js").useGuards>, close: () => void}} given */
export function Suggest({ guards, close }) {
  const { value, error, again } = useResource((signal) => get("/v1/guards/suggestions", {}, signal), []);
  const found = value?.suggestions ?? [];
  const loaded = (value?.loaded ?? []).map((/** @type {any} */ one) => one.name).join(", ");
  return html`<${Dialog} wide title="Suggested guards" close=${close} foot=${html`<button class="button" onClick=${close}>Close</button>`}>
    <p class="muted">From the present graph. A new guard begins in shadow mode: it only records what it would have done, until you enforce it.</p>
    ${error ? html`<${Failure} error=${error} retry=${again} />` : !value ? html`<${Loading} rows=${4} />`
      : !found.length && !loaded ? html`<${Empty} icon="robot" title="No topic now commands a base or an arm">Start the robot's nodes, or name a topic: <code>rosrv guard new --help</code></${Empty}>`
      : html`<ul class="stack">${found.map((/** @type {any} */ one) => html`<${Proposed} key=${one.name} one=${one} guards=${guards} />`)}</ul>
        ${loaded && html`<p class="muted small">Already loaded: <${Given} value=${loaded} most=${400} /></p>`}
        ${value.left_out.map((/** @type {string} */ one) => html`<${Notice} key=${one} tone="warn"><${Given} value=${one} most=${600} /></${Notice}>`)}`}
    ${value?.not_protected.length && html`<h3>Not protected</h3><ul class="stack small">${value.not_protected.map((/** @type {string} */ one) => html`<li key=${one}><${Given} value=${one} most=${600} /></li>`)}</ul>`}</${Dialog}>`;
}

function Proposed(/** @type {{one: any, guards: ReturnType<typeof import("./state.js").useGuards>}} */ { one, guards }) {
  const [making, setMaking] = useState(false);
  const loaded = guards.body.guards.some((/** @type {any} */ row) => row.name === one.name);
  const values = { ...one.measured, ...one.values };
  const set = Object.entries(values).map(([name, value]) => `${name}=${value}`).join(" ");
  const others = Object.values(one.others).flat().join(", ");
  const make = async () => {
    setMaking(true);
    await guards.order(`${one.name} is in shadow mode`, one.what, "POST", "/v1/guards", { json: { preset: one.preset, name: one.name, topics: one.topics, values, shadow: true } });
    setMaking(false);
  };
  return html`<li class="proposed"><div><strong><${Given} value=${one.name} most=${60} /></strong> <span class="small"><${Given} value=${Object.values(one.topics).join(" ")} mono most=${120} /></span>
      <div class="small">${one.what}</div>${set && html`<div class="muted small">From the present rate: <${Given} value=${set} mono most=${120} />. Check all other values.</div>`}
      ${others && html`<div class="muted small">Or by <${Given} value=${others} mono most=${120} />: name it on the command line.</div>`}</div>
    <${Button} small role="admin" disabled=${loaded || making} why="It is loaded" onClick=${make}>${loaded ? "Loaded" : "Make in shadow mode"}</${Button}></li>`;
}
