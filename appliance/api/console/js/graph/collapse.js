/**
 * Makes a large graph small enough to read: items of one namespace are drawn as one group until it is opened.
 *
 * The names of each kind form a tree; what is shown is a cut through it. The cut begins at the namespaces of the first
 * level and opens the smallest groups first, as long as not more than `most` things of the kind are shown. What the
 * reader opened is open. A level with very many names is divided into ranges, so that no step shows too much at once.
 * The result depends on the names alone: rates and the order of an answer move nothing.
 */

const RANGE = 40;

/** @typedef {import("./model.js").Item & {members?: import("./model.js").Item[]}} Shown */
/** @typedef {{key: string, label: string, items: import("./model.js").Item[], parts: Branch[]}} Branch */

/**
 * @param {import("./model.js").Model} model @param {Set<string>} opened keys of groups
 * @param {number} most things of each kind
 * @returns {{items: Map<string, Shown>, lines: Map<string, any>}}
 */
export function collapse(model, opened, most) {
  /** @type {Map<string, Shown>} */
  const items = new Map();
  const place = new Map();
  for (const kind of ["node", "topic", "service", "missing"]) {
    const all = [...model.items.values()].filter((one) => one.kind === kind);
    for (const branch of cut(all, kind, opened, most)) {
      const shown = branch.items.length === 1 && !branch.parts.length ? branch.items[0] : groupOf(branch, kind);
      items.set(shown.key, shown);
      for (const one of branch.items) place.set(one.key, shown.key);
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

function groupOf(/** @type {Branch} */ branch, /** @type {string} */ kind) {
  const word = kind === "node" ? "node" : kind === "topic" ? "topic" : kind === "service" ? "service" : "thing";
  return /** @type {Shown} */ ({
    key: branch.key, kind, name: branch.label, sub: `${branch.items.length} ${word}s`, members: branch.items,
    mediated: branch.items.every((one) => one.mediated), lost: branch.items.every((one) => one.lost),
  });
}

/** Lines between what is shown; those between the same two things are one. */
function joined(/** @type {import("./model.js").Model} */ model, /** @type {Map<string, string>} */ place) {
  const lines = new Map();
  for (const line of model.lines.values()) {
    const from = place.get(line.from);
    const to = place.get(line.to);
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

/** The branches that are shown for one kind. */
function cut(/** @type {import("./model.js").Item[]} */ all, /** @type {string} */ kind, /** @type {Set<string>} */ opened, /** @type {number} */ most) {
  if (all.length <= most) return all.map((one) => ({ key: one.key, label: one.name, items: [one], parts: [] }));
  const root = grow(all, `g${kind}`, "", 1);
  let frontier = root.parts;
  for (;;) {
    const wanted = frontier.filter((one) => one.parts.length && opened.has(one.key));
    const room = most - frontier.length;
    const next = wanted[0] ?? frontier.filter((one) => one.parts.length && one.parts.length - 1 <= room).sort(bySize)[0];
    if (!next) return frontier;
    frontier = frontier.flatMap((one) => (one === next ? one.parts : [one]));
  }
}

function bySize(/** @type {Branch} */ a, /** @type {Branch} */ b) {
  return a.parts.length - b.parts.length || (a.key < b.key ? -1 : 1);
}

/** The tree of names below a namespace. @returns {Branch} */
function grow(/** @type {import("./model.js").Item[]} */ items, /** @type {string} */ kind, /** @type {string} */ prefix, /** @type {number} */ depth) {
  const families = new Map();
  for (const one of items) {
    const words = one.name.split("/");
    const leaf = words.length <= depth + 1;
    const name = leaf ? one.name : `${words.slice(0, depth + 1).join("/")}/*`;
    if (!families.has(name)) families.set(name, []);
    families.get(name).push(one);
  }
  const names = [...families.keys()].sort();
  const parts = names.map((name) => {
    const members = families.get(name);
    if (members.length === 1) return { key: members[0].key, label: members[0].name, items: members, parts: [] };
    return name.endsWith("/*") ? grow(members, kind, name, depth + 1) : { key: `${kind}:${name}`, label: name, items: members, parts: [] };
  });
  // A namespace whose only child is a namespace is that child.
  if (parts.length === 1 && parts[0].parts.length) return parts[0];
  return { key: `${kind}:${prefix}`, label: prefix, items, parts: parts.length > RANGE ? ranges(parts, `${kind}:${prefix}`) : parts };
}

/** So many neighbours in the alphabet as one. @returns {Branch[]} */
function ranges(/** @type {Branch[]} */ parts, /** @type {string} */ key) {
  const size = Math.max(RANGE, Math.ceil(parts.length / RANGE));
  const found = [];
  for (let at = 0; at < parts.length; at += size) {
    const some = parts.slice(at, at + size);
    const label = `${some[0].label} … ${tail(some[some.length - 1].label)}`;
    found.push({ key: `${key}#${some[0].label}`, label, items: some.flatMap((one) => one.items), parts: some });
  }
  return found;
}

function tail(/** @type {string} */ name) {
  return name.slice(name.replace(/\/\*$/, "").lastIndexOf("/") + 1);
}
