/** Text from the network. It never becomes markup, is never invisible, and never reorders its surroundings. */

import { html } from "../html.js";
import { pieces, plain } from "../words.js";

const SHORT = 14;
const WORD = 24;

/** @param {{value: unknown, most?: number, mono?: boolean, none?: string}} given */
export function Given({ value, most = 160, mono = false, none = "–" }) {
  if (value === null || value === undefined || value === "") return html`<span class="muted">${none}</span>`;
  const shown = pieces(value, most);
  const cut = String(value).length > most;
  const name = mono || !/\s/.test(String(value));
  return html`<bdi class=${`given${name ? " given-name" : ""}${mono ? " given-mono" : ""}`} title=${cut ? plain(value, 1000) : undefined}>
    ${shown.map((one) => (one.unseen ? html`<span class="unseen">${one.text}</span>` : name ? words(one.text) : one.text))}</bdi>`;
}

const APPLIANCE = ["disk", "not confirmed in time"]; // as in base/actors.py

/** An author as text; one that is not a person is the appliance. @param {string | null | undefined} who */
export function actor(who) {
  return who && APPLIANCE.includes(who) ? `the appliance (${who})` : who;
}

/** The origin of a revision: "by" its author, or "from disk". @param {{who: string, most?: number}} given */
export function By({ who, most = 40 }) {
  return who === "disk" ? "from disk" : html`by <${Given} value=${actor(who)} most=${most} />`;
}

/** A short name does not break; a longer one breaks after slashes and underscores, or anywhere if it must. */
function words(/** @type {string} */ text) {
  if (text.length <= SHORT) return text;
  return (text.match(/[/_]*[^/_]+[/_]*/g) ?? [text]).map((one, at) => [at > 0 && html`<wbr />`, one.length > WORD ? html`<span class="long">${one}</span>` : one]);
}
