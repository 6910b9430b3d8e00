/** What a text finds: names of the robot, rules of the policy, records, and what features add. All from REST, with the reader's role. */

import { auditPath } from "../audit/filters.js";
import { PARTS } from "../features.js";
import { html, useEffect, useMemo, useState } from "../html.js";
import { useShown } from "../parts/host.js";
import { Given } from "../parts/given.js";
import { Failure, Loading } from "../parts/notice.js";
import { useResource } from "../parts/resource.js";
import { Problem } from "../problem.js";
import { get } from "../rest.js";
import { go } from "../router.js";

/** @typedef {{name: string, more?: string, to: string, row?: string}} Found `to`: its page; `row`: the selector of its row there */

const SHOWN = 6; // of each kind
const RECORDS = { since: "30d", limit: SHOWN };
const PAUSE = 250; // milliseconds after the last key
const WAIT = 3000; // milliseconds for a row to appear on its page

export function Results(/** @type {{text: string, close: () => void}} */ { text, close }) {
  const shown = useShown();
  const { value, error, again } = useResource((signal) => everything(signal), []);
  const asked = useSettled(text);
  const records = useResource((signal) => recordsOf(asked, signal), [asked]);
  const kinds = useMemo(() => (value && text ? [...value, hostsOf(value, shown)].map(({ kind, found }) => ({ kind, found: matching(found, text) })) : []), [value, text, shown]);
  if (error) return html`<${Failure} error=${error} retry=${again} />`;
  if (!value) return html`<${Loading} rows=${2} />`;
  if (!text) return html`<p class="muted">Part of a name, of a rule, or of a record's reason; or the number of a record.</p>`;
  const waits = asked !== text || records.loading;
  const all = [...kinds, { kind: "Records", found: asked === text ? records.value ?? [] : [] }].filter(({ found }) => found.length);
  return html`${records.error && html`<${Failure} error=${records.error} retry=${records.again} />`}
    <p class="sr-only" role="status">${waits ? "Searching" : `${all.reduce((sum, { found }) => sum + found.length, 0)} results`}</p>
    ${all.map(({ kind, found }) => html`<section key=${kind} class="found" aria-label=${kind}><h3>${kind}</h3>
      <ul>${found.slice(0, SHOWN).map((one) => html`<li key=${one.to + one.name}><${Result} one=${one} close=${close} /></li>`)}</ul>
      ${found.length > SHOWN && html`<p class="muted small">${found.length - SHOWN} more: type more of the name</p>`}</section>`)}
    ${!all.length && html`<p class="muted">${waits ? "Searching…" : "Nothing found that your role may read."}</p>`}`;
}

function Result(/** @type {{one: Found, close: () => void}} */ { one, close }) {
  const open = (/** @type {MouseEvent} */ event) => {
    if (event.metaKey || event.ctrlKey || event.shiftKey || event.button) return;
    event.preventDefault();
    close();
    go(one.to);
    if (one.row) reveal(one.row);
  };
  return html`<a href=${one.to} onClick=${open}><${Given} value=${one.name} most=${120} mono />${one.more && html` <span class="muted small"><${Given} value=${one.more} most=${160} /></span>`}</a>`;
}

/** @param {AbortSignal} signal @returns {Promise<{kind: string, found: Found[]}[]>} */
async function everything(signal) {
  const features = PARTS.filter(({ place }) => place === "search").map(async ({ title, Part }) => ({ kind: title, found: await (await Part())(signal) }));
  const kinds = await Promise.all([namesOf(signal), rulesOf(signal), ...features].map((one) => readable(one)));
  return kinds.flat();
}

/** Nothing of what the reader's role may not read, or what this appliance does not have. @param {Promise<any>} kind */
async function readable(kind) {
  try {
    return await kind;
  } catch (failure) {
    if (failure instanceof Problem && (failure.status === 403 || failure.status === 404)) return [];
    throw failure;
  }
}

async function namesOf(/** @type {AbortSignal} */ signal) {
  const { nodes, topics, services } = await get("/v1/graph", {}, signal);
  const at = (/** @type {string} */ letter, /** @type {any} */ one) => ({ name: one.name, to: `/console/graph?item=${encodeURIComponent(letter + one.name)}` });
  return [
    { kind: "Nodes", found: nodes.map((/** @type {any} */ one) => ({ ...at("n", one), more: one.host, host: one.host })) },
    { kind: "Topics", found: topics.map((/** @type {any} */ one) => ({ ...at("t", one), more: one.type })) },
    { kind: "Services", found: services.map((/** @type {any} */ one) => at("s", one)) },
  ];
}

/** The hosts of the nodes; their records, because a host of nodes has no page. @param {any[]} kinds @param {(address: string) => string} shown */
function hostsOf(kinds, shown) {
  const nodes = kinds.find(({ kind }) => kind === "Nodes")?.found ?? [];
  const hosts = [...new Set(nodes.map((/** @type {any} */ one) => one.host))].filter(Boolean);
  return { kind: "Hosts of nodes", found: hosts.map((host) => ({ name: shown(host), more: "its records", to: auditPath({ host }) })) };
}

/** Each line of the policy in force with something on it. */
async function rulesOf(/** @type {AbortSignal} */ signal) {
  const { text } = await get("/v1/policy", {}, signal);
  let section = "";
  const found = String(text).split("\n").flatMap((line, at) => {
    const words = line.trim();
    section = /^\[\w+\]/.test(words) ? words : section;
    return words && words !== section ? [{ name: words, more: `${section} line ${at + 1}`, to: `/console/policy?line=${at + 1}` }] : [];
  });
  return [{ kind: "Rules", found }];
}

/** @param {string} text @param {AbortSignal} signal @returns {Promise<Found[]>} */
async function recordsOf(text, signal) {
  if (!text) return [];
  const [numbered, { records }] = await Promise.all([
    /^\d{1,15}$/.test(text) ? readable(get(`/v1/audit/${text}`, {}, signal).then(({ record }) => [record])) : [],
    get("/v1/audit", { text, ...RECORDS }, signal),
  ]);
  return [...numbered, ...records].map((one) => ({
    name: [one.event === "decision" ? `${one.decision} ${one.category}` : one.event, one.resource].filter(Boolean).join(" "),
    more: [`record ${one.sequence}`, one.reason].filter(Boolean).join(": "),
    to: `/console/audit/${one.sequence}`,
  }));
}

/** Those with the text, names that begin with it first. @param {Found[]} found @param {string} text */
function matching(found, text) {
  const wanted = text.toLowerCase();
  const begins = (/** @type {Found} */ one) => one.name.toLowerCase().replace(/^\//, "").startsWith(wanted.replace(/^\//, ""));
  const matches = found.filter((one) => `${one.name} ${one.more ?? ""}`.toLowerCase().includes(wanted));
  return [...matches.filter(begins), ...matches.filter((one) => !begins(one))];
}

/** The text once it has not changed for a moment. */
function useSettled(/** @type {string} */ text) {
  const [settled, setSettled] = useState(text);
  useEffect(() => {
    const timer = setTimeout(() => setSettled(text), PAUSE);
    return () => clearTimeout(timer);
  }, [text]);
  return settled;
}

/** Show the row when its page has it. */
function reveal(/** @type {string} */ row) {
  const began = performance.now();
  const look = () => {
    const found = /** @type {HTMLElement | null} */ (document.querySelector(row));
    if (!found && performance.now() - began < WAIT) requestAnimationFrame(look);
    if (!found) return;
    found.tabIndex = -1;
    found.scrollIntoView({ block: "center" });
    found.focus({ preventScroll: true });
  };
  requestAnimationFrame(look);
}
