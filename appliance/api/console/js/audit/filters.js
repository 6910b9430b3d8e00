/** The filters of `/v1/audit`, kept in the URL so that a search can be shared. */

import { html, useState } from "../html.js";
import { Field } from "../parts/field.js";
import { Given } from "../parts/given.js";
import { Icon } from "../parts/icon.js";
import { go } from "../router.js";

export const NAMES = ["text", "decision", "since", "until", "host", "caller_id", "resource", "category", "event", "severity", "rule", "who", "looks"];
const FEW = ["text", "decision", "since"];
const SINCE = /** @type {[string, string][]} */ ([["", "Any time"], ["15m", "Last 15 minutes"], ["1h", "Last hour"], ["1d", "Last day"], ["1w", "Last week"]]);
const DECISIONS = /** @type {[string, string][]} */ ([["", "Any decision"], ["deny", "Deny"], ["would deny", "Would deny"], ["ask", "Waits for an approval"], ["allow", "Allow"]]);
const SEVERITIES = /** @type {[string, string][]} */ ([["", "Any"], ["debug", "Debug and up"], ["info", "Info and up"], ["notice", "Notice and up"], ["warning", "Warning and up"], ["alarm", "Alarm"]]);
const LOOKS = /** @type {[string, string][]} */ ([["", "Hidden"], ["1", "Shown"]]);
const LABELS = { text: "Text", decision: "Decision", since: "Since", until: "Until", host: "Host", caller_id: "Node", resource: "Resource", category: "Category", event: "Event", severity: "Severity", rule: "Rule", who: "Who", looks: "REST queries" };

/** @param {URLSearchParams} query @returns {Record<string, string>} those that are set */
export function filterOf(query) {
  return Object.fromEntries(NAMES.map((name) => [name, query.get(name) ?? ""]).filter(([, value]) => value));
}

/** @param {Record<string, string>} filter @param {string} [record] */
export function auditPath(filter, record = "") {
  const words = new URLSearchParams(filter).toString();
  return `/console/audit${record ? `/${record}` : ""}${words ? `?${words}` : ""}`;
}

/** A time as an input of the browser has it, in its own zone; empty for a span or no time. Without a zone it is UTC, as in the log. */
function local(/** @type {string} */ time = "") {
  const zone = /[T ]\d\d:\d\d[\d:.]*$/.test(time) ? "Z" : "";
  const at = /^\d{4}-/.test(time) ? new Date(time.replace(" ", "T") + zone).getTime() : NaN;
  return Number.isNaN(at) ? "" : new Date(at - new Date(at).getTimezoneOffset() * 60_000).toISOString().slice(0, 16);
}

/** @param {{filter: Record<string, string>, record: string}} given */
export function Filters({ filter, record }) {
  const [more, setMore] = useState(NAMES.some((name) => filter[name] && !FEW.includes(name)));
  const set = (/** @type {string} */ name) => (/** @type {string} */ value) => {
    const next = { ...filter, [name]: value };
    if (!value) delete next[name];
    go(auditPath(next, record), { replace: true });
  };
  const field = (/** @type {string} */ name, /** @type {any} */ extra) => html`<${Field} label=${LABELS[/** @type {keyof typeof LABELS} */ (name)]} value=${filter[name] ?? ""} set=${set(name)} ...${extra} />`;
  const custom = filter.since && !SINCE.some(([word]) => word === filter.since) ? /** @type {[string, string][]} */ ([[filter.since, local(filter.since).replace("T", " ") || filter.since]]) : [];
  const time = (/** @type {string} */ label, /** @type {string} */ name) => html`<${Field} label=${label} type="datetime-local" value=${local(filter[name])} set=${(/** @type {string} */ value) => set(name)(value && new Date(value).toISOString())} />`;
  return html`<div class=${`filters${more ? " all" : ""}`} role="search" aria-label="Audit log">
    <div class="filters-few">
      <div class="filters-text"><${Icon} name="search" size=${16} /><input class="input" type="search" data-search placeholder="Search in names, reasons and details" aria-label="Text" value=${filter.text ?? ""} onInput=${(/** @type {any} */ event) => set("text")(event.target.value)} /></div>
      <select class=${`input${filter.decision ? " set" : ""}`} aria-label="Decision" value=${filter.decision ?? ""} onInput=${(/** @type {any} */ event) => set("decision")(event.target.value)}>${DECISIONS.map(([word, shown]) => html`<option value=${word} selected=${word === (filter.decision ?? "")}>${shown}</option>`)}</select>
      <select class=${`input${filter.since ? " set" : ""}`} aria-label="Since" value=${filter.since ?? ""} onInput=${(/** @type {any} */ event) => set("since")(event.target.value)}>${[...SINCE, ...custom].map(([word, shown]) => html`<option value=${word} selected=${word === (filter.since ?? "")}>${shown}</option>`)}</select>
      <button class="button" aria-expanded=${String(more)} onClick=${() => setMore(!more)}><${Icon} name="filter" size=${16} />Filters</button>
    </div>
    ${more && html`<div class="form-grid">
      ${time("From", "since")}${field("host", { placeholder: "10.0.0.*, or a name", mono: true })}${field("caller_id", { placeholder: "/node", mono: true })}${field("resource", { placeholder: "/cmd_*", mono: true })}
      ${field("rule", { placeholder: "Publishers, or a key", mono: true })}${field("category", { placeholder: "publish, command, monitor" })}${field("event", { placeholder: "decision, message dropped" })}${field("who", { placeholder: "name of a token, or operator" })}
      ${field("looks", { options: LOOKS })}${field("severity", { options: SEVERITIES })}${time("Until", "until")}
    </div>`}
    ${Object.keys(filter).some((name) => !FEW.includes(name)) && html`<div class="row">${Object.entries(filter).filter(([name]) => !FEW.includes(name)).map(([name, value]) => html`<button key=${name} class="chip" onClick=${() => set(name)("")} aria-label=${`Remove the filter ${name}`}>
      <span class="muted">${LABELS[/** @type {keyof typeof LABELS} */ (name)]}</span> <${Given} value=${(name === "until" && local(value).replace("T", " ")) || value} most=${40} /><${Icon} name="close" size=${12} /></button>`)}
      <button class="link small" onClick=${() => go(auditPath({}, record), { replace: true })}>Clear all</button></div>`}
  </div>`;
}
