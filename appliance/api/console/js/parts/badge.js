/** Coloured words for decisions, severities and states. */

import { html } from "../html.js";
import { Given } from "./given.js";

const TONES = {
  allow: "allow", deny: "deny", "would deny": "warn", ask: "warn",
  alarm: "deny", warning: "warn", notice: "note", info: "", debug: "",
  up: "allow", live: "allow", enabled: "allow", down: "warn", lost: "warn", revoked: "", failing: "deny", held: "deny", broken: "deny", "shadow mode": "note", disabled: "",
};

/** @param {{word: string, tone?: string, title?: string}} given */
export function Badge({ word, tone, title }) {
  const colour = tone ?? TONES[/** @type {keyof typeof TONES} */ (word)] ?? "";
  return html`<span class=${`badge ${colour}`} title=${title}><${Given} value=${word} most=${40} /></span>`;
}

/** A record's outcome in one word: its decision or severity. */
export function Outcome(/** @type {{record: Record<string, any>}} */ { record }) {
  return html`<${Badge} word=${record.decision ?? record.severity} />`;
}

/** The word for a request: its category, the call that gives the resource up, or the event of a record without either. @param {Record<string, any>} record */
export function requested(record) {
  const call = String(record.detail?.call ?? "");
  return record.category !== "command" && /^(unregister|unsubscribe)/.test(call) ? call : record.category || record.event;
}
