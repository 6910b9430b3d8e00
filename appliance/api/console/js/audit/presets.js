/** Saved searches: built-in searches, and searches that the user saved in this browser. */

import { html, useState } from "../html.js";
import { plain } from "../words.js";
import { Icon } from "../parts/icon.js";
import { go } from "../router.js";
import { store, stored } from "../storage.js";
import { auditPath, NAMES } from "./filters.js";

const KEY = "rosrv.searches"; // stores only filters: no token, and no content of the log
const MAX = 12;
const PRESETS = /** @type {[string, Record<string, string>][]} */ ([
  ["What matters", {}], ["Denied", { decision: "deny" }], ["Monitors", { category: "monitor" }],
  ["Changes by people", { who: "*", severity: "notice" }], ["All", { severity: "debug" }],
]);

/** @param {{filter: Record<string, string>}} given */
export function Presets({ filter }) {
  const [kept, setKept] = useState(read);
  const keep = (/** @type {Record<string, string>[]} */ next) => {
    setKept(next);
    store(KEY, JSON.stringify(next));
  };
  const known = [...PRESETS.map(([, one]) => one), ...kept].some((one) => same(one, filter));
  return html`<div class="row presets" role="group" aria-label="Searches">
    ${PRESETS.map(([name, one]) => html`<button key=${name} class="button small" aria-pressed=${String(same(one, filter))} onClick=${() => go(auditPath(one))}>${name}</button>`)}
    ${kept.map((one) => html`<span key=${nameOf(one)} class="row kept"><button class="button small" aria-pressed=${String(same(one, filter))} onClick=${() => go(auditPath(one))}>${nameOf(one)}</button><button class="button plain small" aria-label=${`Forget the search ${nameOf(one)}`} onClick=${() => keep(kept.filter((other) => other !== one))}><${Icon} name="close" size=${12} /></button></span>`)}
    ${!known && html`<button class="link small" onClick=${() => keep([...kept, filter].slice(-MAX))}>Save this search</button>`}</div>`;
}

/** Return the stored searches; ignore invalid content. @returns {Record<string, string>[]} */
function read() {
  try {
    const found = JSON.parse(stored(KEY) ?? "[]");
    return found.map((/** @type {any} */ one) => Object.fromEntries(NAMES.filter((name) => typeof one[name] === "string" && one[name]).map((name) => [name, one[name]]))).filter((/** @type {any} */ one) => Object.keys(one).length).slice(-MAX);
  } catch {
    return [];
  }
}

function nameOf(/** @type {Record<string, string>} */ filter) {
  return plain(NAMES.filter((name) => filter[name]).map((name) => (name === "since" ? `last ${filter[name]}` : filter[name])).join(", "), 48);
}

function same(/** @type {Record<string, string>} */ one, /** @type {Record<string, string>} */ other) {
  return NAMES.every((name) => (one[name] ?? "") === (other[name] ?? ""));
}
