/** Completion of the policy: sections, keys and groups from the text, and names and addresses of the live graph. */

import { get } from "../rest.js";

// By section: its words before "=", the live names before "=", and its words after "=".
const SECTIONS = /** @type {Record<string, {keys?: string[], names?: "nodes" | "topics" | "services", values?: string[]}>} */ ({
  Groups: {},
  Hours: { keys: ["zone"] },
  Ports: { keys: ["range"] },
  Monitor: { keys: ["topic", "service"] },
  Nodes: { keys: ["default"], names: "nodes" },
  Publishers: { keys: ["default"], names: "topics", values: ["ask"] },
  Subscribers: { keys: ["default"], names: "topics" },
  Commands: { keys: ["default"] },
  Services: { keys: ["default"], names: "services" },
  Clients: { keys: ["default"], names: "services", values: ["ask"] },
  Parameters: { keys: ["read default", "write default"], values: ["ask"] },
  Limits: { names: "topics", values: ["publisher", "subscriber", "topic"] },
  Authority: {},
  Options: { keys: ["takeover", "audit-only", "tell"] },
});
const OPTIONS = /** @type {Record<string, string[]>} */ ({ takeover: ["same-host", "granted"], tell: ["rule", "full", "id"], "audit-only": ["all"] });
const WRITABLE = /^[\w/.:~-]+$/; // a name that a policy can contain
// The word at the cursor: a section, a key, or a value. While it is such a word, its proposals stay the same.
const HEAD = /^\[[^\]]*$/;
const KEY = /^[^\s=#;[][^=#;]*$/;
const VALUE = /^[^\s,=#;]+$/;
const FRESH = 10_000; // milliseconds for which the fetched names are used

/** @typedef {{word: string, kind: string}} Proposal */
/** @typedef {{nodes: string[], topics: string[], services: string[], hosts: string[]}} Live */

/**
 * Return the proposals at the end of `before`, the number of its last characters that they replace, and the form of
 * words that they are for. Without a word to complete, there are proposals only if they were asked for.
 * @param {string} before @param {string} after @param {boolean} asked
 * @returns {Promise<{length: number, proposals: Proposal[], word: RegExp} | null>}
 */
export async function complete(before, after, asked) {
  const line = before.slice(before.lastIndexOf("\n") + 1);
  if (/[#;]/.test(line)) return null;
  const head = /^\s*(\[[^\]]*)$/.exec(line);
  if (head) return { length: head[1].length, word: HEAD, proposals: Object.keys(SECTIONS).map((name) => ({ word: `[${name}]`, kind: "section" })) };
  const section = sectionOf(before);
  const known = SECTIONS[section];
  const at = line.indexOf("=");
  const word = /** @type {RegExpExecArray} */ (at < 0 ? /\S.*$|$/.exec(line) : /[^\s,=]*$/.exec(line))[0];
  if (!known || (!word && !asked)) return null;
  const proposals = at < 0 ? await keysOf(known) : await valuesOf(section, known, line.slice(0, at).trim(), before + after);
  return { length: word.length, word: at < 0 ? KEY : VALUE, proposals };
}

async function keysOf(/** @type {{keys?: string[], names?: "nodes" | "topics" | "services"}} */ { keys = [], names }) {
  const found = names ? (await live())[names] : [];
  return [...named(keys, "key"), ...named(found, names === "nodes" ? "node" : names === "topics" ? "topic" : "service")];
}

async function valuesOf(/** @type {string} */ section, /** @type {{values?: string[]}} */ { values }, /** @type {string} */ key, /** @type {string} */ text) {
  if (section === "Options") return [...named(OPTIONS[key] ?? [], "option"), ...named(key === "audit-only" ? Object.keys(SECTIONS) : [], "section")];
  if (section === "Monitor") return key === "topic" ? named((await live()).topics, "topic") : named((await live()).services, "service");
  if (section === "Ports" || section === "Hours") return [];
  const times = section === "Limits" ? [] : ["until", "during", ...namesIn(text, "hours").filter((one) => one !== "zone")];
  return [...named(values ?? [], section === "Limits" ? "limit" : "option"), ...named(times, "time"), ...named(["robot", ...namesIn(text, "groups")], "group"), ...named((await live()).hosts, "host")];
}

/** The section at the end of a text, as `SECTIONS` spells it. */
function sectionOf(/** @type {string} */ before) {
  const name = [...before.matchAll(/^[ \t]*\[([^\]\n]*)\]/gm)].at(-1)?.[1].trim().toLowerCase() ?? "";
  return Object.keys(SECTIONS).find((one) => one.toLowerCase() === name) ?? "";
}

/** The names that a section of a text defines. */
function namesIn(/** @type {string} */ text, /** @type {string} */ wanted) {
  const found = new Set();
  let section = "";
  for (const line of text.split("\n")) {
    const head = /^\s*\[([^\]]*)\]/.exec(line);
    const key = /^\s*([^\s=#;[]+)\s*=/.exec(line);
    if (head) section = head[1].trim().toLowerCase();
    else if (key && section === wanted) found.add(key[1]);
  }
  return [...found];
}

function named(/** @type {string[]} */ words, /** @type {string} */ kind) {
  return words.map((word) => ({ word, kind }));
}

let fetched = { at: -Infinity, names: /** @type {Promise<Live>} */ (Promise.resolve({ nodes: [], topics: [], services: [], hosts: [] })) };

/** The names of the live graph. Without an answer there are none: the text alone completes then. @returns {Promise<Live>} */
function live() {
  if (performance.now() - fetched.at > FRESH) {
    fetched = { at: performance.now(), names: get("/v1/graph").then(namesOf, () => ({ nodes: [], topics: [], services: [], hosts: [] })) };
  }
  return fetched.names;
}

function namesOf(/** @type {any} */ { nodes, topics, services }) {
  const words = (/** @type {any[]} */ rows, /** @type {string} */ field) => [...new Set(rows.map((one) => String(one[field] ?? "")))].filter((one) => WRITABLE.test(one)).sort();
  return { nodes: words(nodes, "name"), topics: words(topics, "name"), services: words(services, "name"), hosts: words(nodes, "host") };
}
