/**
 * The graph's items and lines, from `/v1/graph` and the denials of the audit log.
 *
 * A key is a letter and a name (`n/talker`, `t/chatter`, `s/set_mode`). The key of a denied caller that is not in the
 * graph is `x@` and its host: a denied host is one item, under however many names. If a name is that of another host's
 * node, a line leads to this node. The model has no layout.
 */

/**
 * @typedef {{key: string, kind: "node" | "topic" | "service" | "party" | "missing" | "master", name: string, sub: string,
 *   host?: string, rate?: number, mediated?: boolean, lost?: boolean, row?: any, brief?: string, callers?: string[], denied?: number, found?: number, owners?: string[]}} Item
 *   `brief`: in few words what `sub` is; of a denied host: the `callers` that it gave, `owners`: the hosts whose nodes' names it used, how often it was `denied`, and how often it was `found` in the records
 * @typedef {{key: string, from: string, to: string, kind: "flow" | "denied", mediated: boolean, rate: number,
 *   denials?: any[], would?: boolean}} Line
 * @typedef {{items: Map<string, Item>, lines: Map<string, Line>}} Model
 */

import { letterOf } from "../categories.js";
import { counted } from "../numbers.js";

export const MASTER = "m/";
const QUIET = new Set(["/rosout", "/rosout_agg", "/clock", "/statistics", "/diagnostics"]);
const ATTEMPTS = 60;

/**
 * @param {any} graph @param {any[]} denials @param {{services: boolean, quiet: boolean, denied: boolean}} wanted
 * @param {(address: string) => string} [shown] the text of a host
 * @param {Map<string, number>} [counts] the denials of hosts, where more than in `denials` are known @returns {Model}
 */
export function modelOf(graph, denials, wanted, shown = (address) => address, counts = new Map()) {
  /** @type {Model} */
  const model = { items: new Map(), lines: new Map() };
  for (const node of graph.nodes) put(model, { key: `n${node.name}`, kind: "node", name: node.name, sub: shown(node.host), host: node.host, lost: node.state === "lost", row: node });
  for (const topic of graph.topics) if (!(wanted.quiet && QUIET.has(topic.name))) topicOf(model, topic);
  if (wanted.services) for (const service of graph.services) if (!(wanted.quiet && /\/(get_loggers|set_logger_level)$/.test(service.name))) serviceOf(model, service);
  if (wanted.denied) for (const attempt of attempts(denials)) attemptOf(model, attempt, shown, counts);
  return model;
}

/** Merge denials of the same host for the same resource, newest first. @param {any[]} denials */
export function attempts(denials) {
  const found = new Map();
  for (const record of denials) {
    if (!record.resource || record.category === "rest" || !(record.caller_id || record.host) || isLateWithdrawal(record) || isSelftest(record) || isHeld(record)) continue;
    const command = record.category === "command" || record.category === "parameters";
    const key = JSON.stringify([record.host, record.caller_id, record.category, command ? "" : record.resource]);
    const one = found.get(key);
    if (one) one.records.push(record);
    else if (found.size < ATTEMPTS) found.set(key, { key, command, records: [record] });
  }
  return [...found.values()];
}

/** Whether `rosrv selftest` was denied its own topic, which no other node uses. @param {any} record */
export function isSelftest(record) {
  return record.resource === "/rosrv_selftest" && /^\/rosrv_selftest_(publisher|subscriber)$/.test(record.caller_id ?? "");
}

/** Whether a denial only says that the call waits for a person; it is shown as waiting. @param {any} record */
export function isHeld(record) {
  return String(record.reason ?? "").startsWith("held for approval ");
}

/** Whether a denial is the late withdrawal of a replaced node's registration, which is not an attempt to show. */
function isLateWithdrawal(/** @type {any} */ record) {
  return record.rule === null && String(record.detail?.call ?? "").startsWith("unregister");
}

function topicOf(/** @type {Model} */ model, /** @type {any} */ topic) {
  const key = `t${topic.name}`;
  const item = { key, kind: /** @type {const} */ ("topic"), name: topic.name, sub: topic.type, host: hostOf(model, topic.publishers.map((/** @type {any} */ one) => one.node)), rate: 0, mediated: topic.mediated, row: topic };
  put(model, item);
  for (const one of topic.publishers) {
    item.rate += one.messages_per_second;
    flow(model, `n${one.node}`, key, topic.mediated, one.messages_per_second);
  }
  for (const name of topic.subscribers) flow(model, key, `n${name}`, topic.mediated, item.rate);
}

/** The common host of a topic's publishers, if any. */
function hostOf(/** @type {Model} */ model, /** @type {string[]} */ names) {
  const hosts = [...new Set(names.map((name) => model.items.get(`n${name}`)?.host ?? ""))];
  return hosts.length === 1 ? hosts[0] : hosts.length ? "several hosts" : "no host";
}

function serviceOf(/** @type {Model} */ model, /** @type {any} */ service) {
  const key = `s${service.name}`;
  put(model, { key, kind: "service", name: service.name, sub: "service", host: hostOf(model, [service.node]), rate: service.messages_per_second, mediated: service.mediated, row: service });
  flow(model, key, `n${service.node}`, service.mediated, service.messages_per_second);
  for (const one of service.connections) flow(model, `n${one.to}`, key, service.mediated, service.messages_per_second);
}

function attemptOf(/** @type {Model} */ model, /** @type {{key: string, command: boolean, records: any[]}} */ attempt, /** @type {(address: string) => string} */ shown, /** @type {Map<string, number>} */ counts) {
  const { host, caller_id: caller, category, event, resource } = attempt.records[0];
  const known = model.items.get(`n${caller}`);
  const owner = known && known.host !== undefined && known.host !== host ? known.host : null;
  const from = known && known.host === host ? known.key : `x@${host}`;
  const target = attempt.command ? MASTER : `${letterOf(category)}${resource}`;
  const to = owner !== null && !model.items.has(target) && known ? known.key : target;
  // If the host now has the resource, the denial was brief (a late call) and not an attempt to show.
  if (model.lines.has(`${from}>${to}`) || model.lines.has(`${to}>${from}`)) return;
  const times = attempt.records.reduce((sum, one) => sum + (one.equality?.times ?? 1), 0);
  if (from.startsWith("x")) partyOf(model, from, { host: host ?? "", caller, owner, more: times }, shown, counts);
  if (!model.items.has(to)) {
    const kind = attempt.command ? "master" : "missing";
    put(model, { key: to, kind, name: attempt.command ? "RVMaster" : resource, sub: attempt.command ? "calls" : `denied ${category ?? event}` });
  }
  const key = `!${attempt.key}`;
  const line = { key, from, to }; // always towards the resource, regardless of the direction of messages
  const would = attempt.records.every((one) => one.decision === "would deny");
  model.lines.set(key, { ...line, kind: "denied", mediated: false, rate: 0, denials: attempt.records, would });
}

/** Add a denied host, or one more of its attempts. */
function partyOf(/** @type {Model} */ model, /** @type {string} */ key, /** @type {{host: string, caller: string | null, owner: string | null, more: number}} */ { host, caller, owner, more }, /** @type {(address: string) => string} */ shown, /** @type {Map<string, number>} */ counts) {
  const before = model.items.get(key);
  const found = (before?.found ?? 0) + more;
  const denied = Math.max(found, counts.get(host) ?? 0);
  const callers = [...new Set([...(before?.callers ?? []), ...(caller ? [caller] : [])])];
  const owners = [...new Set([...(before?.owners ?? []), ...(owner === null ? [] : [owner])])];
  const times = counted(denied, "denial");
  const item = { key, kind: /** @type {const} */ ("party"), host, callers, denied, found, owners: owners.length ? owners : undefined };
  if (owners.length) put(model, { ...item, name: shown(host) || "no address", sub: `uses names of ${owners.length > 1 ? counted(owners.length, "host") : shown(owners[0])}`, brief: "uses others' names" });
  else if (callers.length > 1) put(model, { ...item, name: shown(host) || "no address", sub: `${counted(callers.length, "name")} · ${times}`, brief: times });
  else put(model, { ...item, name: callers[0] ?? "no name", sub: `${shown(host)} · ${times}`, brief: times });
}

function put(/** @type {Model} */ model, /** @type {Item} */ item) {
  model.items.set(item.key, item);
}

function flow(/** @type {Model} */ model, /** @type {string} */ from, /** @type {string} */ to, /** @type {boolean} */ mediated, /** @type {number} */ rate) {
  for (const key of [from, to]) if (!model.items.has(key)) put(model, { key, kind: "node", name: key.slice(1), sub: "not registered" });
  const key = `${from}>${to}`;
  const known = model.lines.get(key);
  model.lines.set(key, { key, from, to, kind: "flow", mediated, rate: rate + (known?.rate ?? 0) });
}
