/**
 * Make a large graph readable: items of one namespace are drawn as one group until it is opened.
 *
 * The names of each kind form a tree; grouped by host, the hosts are its first level. The page shows the groups of the
 * first level, and the parts of groups that the user opened. A level with very many names is divided into ranges, so
 * that no step shows too much at once. The result depends only on the names, not on rates or on the order of an answer.
 * While a namespace is closed, its nodes and topics are one group.
 */

import { counted } from "../numbers.js";

const RANGE = 64;

/** @typedef {import("./model.js").Item & {members?: import("./model.js").Item[], within?: string[]}} Shown `within`: the opened groups around it */
/** @typedef {{key: string, label: string, items: import("./model.js").Item[], parts: Branch[]}} Branch */

/**
 * @param {import("./model.js").Model} model @param {Set<string>} opened keys of groups
 * @param {"namespace" | "host"} by what a group has in common @param {number} most things of a kind that are drawn without groups
 * @param {(address: string) => string} [shown] the text of a host
 * @returns {{items: Map<string, Shown>, lines: Map<string, any>}}
 */
export function collapse(model, opened, by, most, shown = (address) => address) {
  /** @type {Map<string, Shown>} */
  const items = new Map();
  const place = new Map();
  const path = (/** @type {import("./model.js").Item} */ one) => (by === "host" ? `/${one.host ?? "no host"}${one.name}` : one.name);
  for (const kind of ["node", "topic", "service", "missing"]) {
    const all = [...model.items.values()].filter((one) => one.kind === kind);
    const whole = by === "namespace" && all.length <= most;
    const root = whole ? { key: "", label: "", items: all, parts: all.map(leaf) } : grow(all.map((one) => ({ one, path: path(one) })), `g${kind}`, "", 1);
    for (const { branch, within } of cut(root, opened)) {
      const group = branch.parts.length ? groupOf(branch, kind, by === "host" ? branch.label.slice(1).replace(/^[^/ ]+/, shown) : branch.label) : null;
      const twin = group && items.get(group.key.replace(/^g[a-z]+/, "gnode"));
      const item = twin ? together(twin, group) : group ?? branch.items[0];
      items.set(item.key, { ...item, within });
      for (const one of branch.items) place.set(one.key, item.key);
    }
  }
  for (const one of model.items.values()) {
    if (!place.has(one.key)) {
      items.set(one.key, one);
      place.set(one.key, one.key);
    }
  }
  return { items, lines: joined(model, place) };
}

function groupOf(/** @type {Branch} */ branch, /** @type {string} */ kind, /** @type {string} */ name) {
  const rate = branch.items.reduce((sum, one) => sum + (one.rate ?? 0), 0);
  return /** @type {Shown} */ ({
    key: branch.key, kind, name, sub: counted(branch.items.length, kind === "missing" ? "thing" : kind), brief: counted(branch.items.length, kind === "missing" ? "thing" : kind), members: branch.items, rate,
    mediated: branch.items.every((one) => one.mediated), lost: branch.items.every((one) => one.lost),
  });
}

/** Merge nodes with the topics of their namespace or host; lines inside a group are not drawn. @param {Shown} nodes @param {Shown} more */
function together(nodes, more) {
  return { ...nodes, sub: `${nodes.sub}, ${more.sub}`, members: [...(nodes.members ?? []), ...(more.members ?? [])], rate: (nodes.rate ?? 0) + (more.rate ?? 0), mediated: more.mediated };
}

/** Merge the lines between the same two items. */
function joined(/** @type {import("./model.js").Model} */ model, /** @type {Map<string, string>} */ place) {
  const lines = new Map();
  for (const line of model.lines.values()) {
    const from = place.get(line.from);
    const to = place.get(line.to);
    if (from === to && line.from !== line.to && line.kind === "flow") continue;
    const key = line.kind === "denied" ? `!${from}>${to}` : `${from}>${to}`;
    const known = lines.get(key);
    if (!known) lines.set(key, { ...line, key, from, to });
    else {
      known.rate += line.rate;
      known.mediated = known.mediated && line.mediated;
      if (line.denials) known.denials = [...(known.denials ?? []), ...line.denials];
      if (!line.would) known.would = false;
    }
  }
  return lines;
}

/** The shown branches: the largest unopened branches, each with the opened branches around it, outermost first. */
function cut(/** @type {Branch} */ branch, /** @type {Set<string>} */ opened, /** @type {string[]} */ within = []) {
  /** @type {{branch: Branch, within: string[]}[]} */
  const found = [];
  for (const one of branch.parts) {
    if (one.parts.length && opened.has(one.key)) found.push(...cut(one, opened, [...within, one.key]));
    else found.push({ branch: one, within });
  }
  return found;
}

/** @returns {Branch} */
function leaf(/** @type {import("./model.js").Item} */ item) {
  return { key: item.key, label: item.name, items: [item], parts: [] };
}

/** @typedef {{one: import("./model.js").Item, path: string}} Placed */

/** Return the tree of paths below a prefix. @returns {Branch} */
function grow(/** @type {Placed[]} */ items, /** @type {string} */ kind, /** @type {string} */ prefix, /** @type {number} */ depth) {
  /** @type {Map<string, Placed[]>} */
  const families = new Map();
  for (const one of items) {
    const words = one.path.split("/");
    const name = words.length <= depth + 1 ? one.path : `${words.slice(0, depth + 1).join("/")}/*`;
    families.set(name, [...(families.get(name) ?? []), one]);
  }
  const parts = [...families.keys()].sort().map((name) => {
    const members = /** @type {Placed[]} */ (families.get(name));
    if (members.length === 1) return leaf(members[0].one);
    const deeper = members.some((one) => one.path.split("/").length > depth + 1);
    return deeper ? grow(members, kind, name, depth + 1) : { key: `${kind}:${name}`, label: name, items: members.map(({ one }) => one), parts: members.map(({ one }) => leaf(one)) };
  });
  // A namespace whose only child is a namespace is replaced by that child.
  if (parts.length === 1 && parts[0].parts.length) return parts[0];
  const key = `${kind}:${prefix}`;
  return { key, label: prefix.replace(/\/\*$/, ""), items: items.map(({ one }) => one), parts: parts.length > RANGE ? ranges(parts, key) : parts };
}

/** Merge neighbours in alphabetical order. @returns {Branch[]} */
function ranges(/** @type {Branch[]} */ parts, /** @type {string} */ key) {
  const size = Math.ceil(parts.length / Math.ceil(parts.length / RANGE));
  const found = [];
  for (let at = 0; at < parts.length; at += size) {
    const some = parts.slice(at, at + size);
    const label = `${some[0].label} … ${some[some.length - 1].label.replace(/^.*\//, "")}`;
    found.push({ key: `${key}#${some[0].label}`, label, items: some.flatMap((one) => one.items), parts: some });
  }
  return found;
}
