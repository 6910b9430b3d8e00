/** Words with a colour: decisions, severities, states. The word says it; the colour only helps to find it. */

import { html } from "../html.js";
import { Given } from "./given.js";

const TONES = {
  allow: "allow", deny: "deny", "would deny": "warn",
  alarm: "deny", warning: "warn", notice: "note", info: "", debug: "",
  up: "allow", live: "allow", enabled: "allow", down: "warn", lost: "warn", revoked: "", failing: "deny", held: "warn", "shadow mode": "note", disabled: "",
};

/** @param {{word: string, tone?: string, title?: string}} given */
export function Badge({ word, tone, title }) {
  const colour = tone ?? TONES[/** @type {keyof typeof TONES} */ (word)] ?? "";
  return html`<span class=${`badge ${colour}`} title=${title}><${Given} value=${word} most=${40} /></span>`;
}

/** What a record's outcome is, in one word: its decision, or how grave it is. */
export function Outcome(/** @type {{record: Record<string, any>}} */ { record }) {
  return html`<${Badge} word=${record.decision ?? record.severity} />`;
}
