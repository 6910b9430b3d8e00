/** The page of a standby: its state, and the way to the active appliance's console. */

import { html, useEffect } from "#console/html.js";
import { Given } from "#console/parts/given.js";
import { Mark } from "#console/parts/icon.js";
import { Failure, Loading } from "#console/parts/notice.js";
import { useResource } from "#console/parts/resource.js";
import { get } from "#console/rest.js";
import { entitle } from "#console/attention.js";
import { signOut } from "#console/sign-on.js";
import { useStore } from "#console/store.js";
import { Banner, Pair } from "./pair.js";
import { passive } from "#console/passive.js";

const EVERY = 3000; // milliseconds

export function StandbyPage() {
  const { active } = useStore(passive);
  const { value, error, heard } = useResource((signal) => get("/v1/standby", {}, signal), [], EVERY);
  useEffect(() => entitle("Standby"), []);
  useEffect(() => {
    if (value?.role === "active") passive.update({ active: "" });
  }, [value]);
  const there = `${location.protocol}//${active}${location.port && `:${location.port}`}/console/now`;
  return html`<main class="door" id="main"><div class="door-box standby">
    <div class="brand"><${Mark} size=${40} /><div><h1 class="brand-name">Standby</h1><div class="brand-sub">${value && !value.other.connected ? "The other appliance is away." : "The robot's nodes use the other appliance."}</div></div></div>
    <a class="button primary" href=${there} rel="noreferrer"><span>Open the console of ${value ? html`<${Given} value=${value.other.name} most=${40} />` : "the active appliance"}</span></a>
    ${value?.not_serving && html`<${Banner} text=${`${value.other.name} is active and does not serve the robot: ${value.not_serving}`} />`}
    ${value?.troubles.map((/** @type {string} */ text) => html`<${Banner} key=${text} text=${text} />`)}
    <${Failure} error=${error} heard=${heard} />
    ${value ? html`<${Pair} state=${value} />` : !error && html`<section class="panel"><${Loading} rows=${3} /></section>`}
    <div class="row row-apart"><span class="muted small"><${Given} value=${there} mono /></span><button class="button small" onClick=${signOut}>Sign out</button></div>
  </div></main>`;
}
