/**
 * The layout: from left to right in the direction of messages; in a narrow frame from top to bottom, in two columns.
 * Items without lines fill the rest of the frame, in rows.
 * While the graph changes only a little, existing items keep their places. New items are placed beside the items that
 * they are connected to; in a narrow frame, below all other items.
 */

import { OUTDATED } from "../outdated.js";

const SOURCE = "/console/static/vendor/dagre.js";
let dagre = /** @type {any} */ (null);

/** Load the library for layouts, before the first use of `arrange` and `afresh`. */
export async function loadLayout() {
  try {
    dagre ??= await import(SOURCE);
  } catch {
    throw new Error(OUTDATED);
  }
}

/** @typedef {{x: number, y: number, w: number, h: number, alone?: boolean, band?: number}} Spot the middle and the size; `alone`: without lines; `band`: of a folded layout */

export const SIZES = {
  node: [180, 50], topic: [206, 50], service: [206, 50], party: [206, 50], missing: [206, 50], master: [158, 50],
};
const GAP = 16;
const COLUMN = 52;
const GROUP = [206, 50];
const ROOM = 80; // for the lines that go back, between the connected items and the others
const MOST_BANDS = 4;
const READABLE = 0.75; // a layout of at least this zoom is not folded
const FOLD = 1.25; // how much larger the drawing must become for a band more
const NARROW_COLUMNS = 3; // of items without lines
const BETWEEN = 76; // distance of the two columns in a narrow frame, for the lines
const TALLEST = 12; // most parts of an opened group in one column
const LITTLE = 0.25; // fraction of new items above which the whole layout is computed again

/** @typedef {{narrow: boolean, w: number, h: number}} Frame the size on the screen */

/**
 * @param {Map<string, any>} items @param {Map<string, any>} lines @param {Map<string, Spot>} before @param {Frame} frame
 * @returns {Map<string, Spot>}
 */
export function arrange(items, lines, before, frame) {
  before = unfolded(items, before);
  const fresh = [...items.keys()].filter((key) => !before.has(key));
  if (before.size && fresh.length && fresh.length <= Math.max(2, items.size * LITTLE)) return added(items, frame.narrow ? new Map() : lines, before, fresh);
  if (before.size && !fresh.length) return new Map([...items.keys()].map((key) => [key, /** @type {Spot} */ (before.get(key))]));
  return afresh(items, lines, frame);
}

/**
 * Replace an opened group by its parts, in columns: nodes, then topics. Items to the right of the group or below it
 * make room, and all other items stay.
 */
function unfolded(/** @type {Map<string, any>} */ items, /** @type {Map<string, Spot>} */ before) {
  let spots = before;
  for (const group of before.keys()) {
    if (items.has(group)) continue;
    const space = group.replace(/^g[a-z]+/, "");
    const parts = [...items.values()].filter((one) => !spots.has(one.key) && one.within?.some((/** @type {string} */ key) => key.replace(/^g[a-z]+/, "") === space));
    if (!parts.length) continue;
    const here = /** @type {Spot} */ (spots.get(group)); // another group may have moved it
    const [left, top] = [here.x - here.w / 2, here.y - here.h / 2];
    const placed = inColumns(parts, left, top);
    const room = extent(placed.values());
    const [right, down] = [Math.max(0, room.w - here.w), Math.max(0, room.h - here.h)];
    spots = new Map([...spots].map(([key, spot]) => [key, { ...spot, x: spot.x + (spot.x > here.x ? right : 0), y: spot.y + (spot.y > here.y ? down : 0) }]));
    for (const [key, spot] of placed) spots.set(key, { ...spot, band: here.band });
  }
  return spots;
}

/** Place parts in columns of one kind each, starting at a corner. @param {any[]} parts @param {number} left @param {number} top */
function inColumns(parts, left, top) {
  /** @type {Map<string, Spot>} */
  const spots = new Map();
  let x = left;
  for (const kind of new Set(parts.map((one) => one.kind))) {
    const column = parts.filter((one) => one.kind === kind);
    for (let first = 0; first < column.length; first += TALLEST) {
      let y = top;
      let widest = 0;
      for (const one of column.slice(first, first + TALLEST)) {
        const [w, h] = sizeOf(one);
        spots.set(one.key, { x: x + w / 2, y: y + h / 2, w, h });
        y += h + GAP;
        widest = Math.max(widest, w);
      }
      x += widest + COLUMN;
    }
  }
  return spots;
}

/** Compute the whole layout again. @param {Map<string, any>} items @param {Map<string, any>} lines @param {Frame} frame */
export function afresh(items, lines, frame) {
  const joined = new Set([...lines.values()].filter((line) => line.from !== line.to).flatMap((line) => [line.from, line.to]));
  const connected = new Map([...items].filter(([key]) => joined.has(key)));
  const alone = [...items].filter(([key]) => !joined.has(key)).sort(([a], [b]) => (a < b ? -1 : 1)).map(([, item]) => item);
  const spots = connected.size ? inRanks(connected, lines) : new Map();
  const placed = frame.narrow ? stacked(spots) : folded(spots, frame);
  return alone.length ? filled(placed, alone, frame) : placed;
}

/** Fold a layout that is much wider than the frame into bands below each other. @param {Map<string, Spot>} spots @param {Frame} frame @returns {Map<string, Spot>} */
function folded(spots, frame) {
  const ranks = [...new Set([...spots.values()].map((one) => one.x))].sort((a, b) => a - b);
  const all = extent(spots.values());
  const whole = Math.min(frame.w / all.w, frame.h / all.h);
  if (whole > READABLE) return spots;
  let best = { zoom: FOLD * whole, bands: /** @type {[string, Spot][][]} */ ([]) };
  for (let count = 2; count <= Math.min(MOST_BANDS, ranks.length); count += 1) {
    const size = Math.ceil(ranks.length / count);
    const bands = Array.from({ length: count }, (_, band) => [...spots].filter(([, { x }]) => Math.floor(ranks.indexOf(x) / size) === band)).filter((band) => band.length);
    const sizes = bands.map((band) => extent(band.map(([, spot]) => spot)));
    const zoom = Math.min(frame.w / Math.max(...sizes.map(({ w }) => w)), frame.h / sizes.reduce((sum, { h }) => sum + h + ROOM, -ROOM));
    if (zoom > best.zoom) best = { zoom, bands };
  }
  if (!best.bands.length) return spots;
  /** @type {Map<string, Spot>} */
  const found = new Map();
  let top = 0;
  best.bands.forEach((some, band) => {
    const { x, y, h } = extent(some.map(([, spot]) => spot));
    for (const [key, spot] of some) found.set(key, { ...spot, x: spot.x - x, y: spot.y - y + top, band });
    top += h + ROOM;
  });
  return found;
}

/** Place items without lines in rows below the others or beside them, so that all is drawn as large as possible. */
function filled(/** @type {Map<string, Spot>} */ spots, /** @type {any[]} */ alone, /** @type {Frame} */ frame) {
  const all = spots.size ? extent(spots.values()) : { x: 0, y: 0, w: 0, h: 0 };
  const [w, h] = [GROUP[0] + GAP, GROUP[1] + GAP];
  const apart = spots.size ? ROOM : 0;
  let best = { zoom: 0, columns: 1, beside: false };
  for (const beside of frame.narrow || !spots.size ? [false] : [false, true]) {
    for (let columns = 1; columns <= Math.min(alone.length, frame.narrow ? NARROW_COLUMNS : Infinity); columns += 1) {
      const [wide, high] = [columns * w - GAP, Math.ceil(alone.length / columns) * h - GAP];
      const whole = beside ? [all.w + apart + wide, Math.max(all.h, high)] : [Math.max(all.w, wide), all.h + apart + high];
      const zoom = Math.min(frame.w / whole[0], frame.h / whole[1]);
      if (zoom > best.zoom + 1e-9) best = { zoom, columns, beside };
    }
  }
  const { columns, beside } = best;
  const left = beside ? all.x + all.w + apart : frame.narrow ? all.x + all.w / 2 - (Math.min(columns, alone.length) * w - GAP) / 2 : all.x;
  const top = beside ? all.y : all.y + all.h + apart;
  alone.forEach((item, at) => {
    const [width, height] = sizeOf(item);
    spots.set(item.key, { x: left + (at % columns) * w + GROUP[0] / 2, y: top + Math.floor(at / columns) * h + GROUP[1] / 2, w: width, h: height, alone: true });
  });
  return spots;
}

/** Place connected items in ranks, from left to right. @param {Map<string, any>} items @param {Map<string, any>} lines @returns {Map<string, Spot>} */
function inRanks(items, lines) {
  const graph = new dagre.Graph({ multigraph: false });
  graph.setGraph({ rankdir: "LR", nodesep: GAP, ranksep: COLUMN, edgesep: 8, ranker: items.size > 150 ? "longest-path" : "tight-tree", acyclicer: "greedy" });
  graph.setDefaultEdgeLabel(() => ({}));
  for (const key of [...items.keys()].sort()) {
    const [width, height] = sizeOf(items.get(key));
    graph.setNode(key, { width, height });
  }
  for (const key of [...lines.keys()].sort()) {
    const line = lines.get(key);
    if (line.from !== line.to) graph.setEdge(line.from, line.to, { weight: line.kind === "denied" ? 1 : 3 });
  }
  const began = performance.now();
  dagre.layout(graph);
  performance.measure("layout of the graph", { start: began });
  /** @type {Map<string, Spot>} */
  const spots = new Map();
  for (const key of items.keys()) {
    const { x, y } = graph.node(key);
    const [w, h] = sizeOf(items.get(key));
    spots.set(key, { x, y, w, h });
  }
  return spots;
}

/** Place each column below the previous column, with two boxes in a row. */
function stacked(/** @type {Map<string, Spot>} */ spots) {
  /** @type {Map<string, Spot>} */
  const placed = new Map();
  let [column, place, top] = [NaN, 0, 0];
  for (const [key, { x, w, h }] of [...spots].sort(([, a], [, b]) => a.x - b.x || a.y - b.y)) {
    if (x !== column) [column, place, top] = [x, 0, top + (placed.size ? GROUP[1] + COLUMN : 0)];
    else if (place % 2 === 0) top += GROUP[1] + GAP;
    placed.set(key, { x: ((GROUP[0] + BETWEEN) / 2) * (place % 2 ? 1 : -1), y: top, w, h });
    place += 1;
  }
  return placed;
}

/** Place new items at the nearest free place beside the items that they are connected to. */
function added(/** @type {Map<string, any>} */ items, /** @type {Map<string, any>} */ lines, /** @type {Map<string, Spot>} */ before, /** @type {string[]} */ fresh) {
  /** @type {Map<string, Spot>} */
  const spots = new Map();
  for (const key of items.keys()) if (before.has(key)) spots.set(key, /** @type {Spot} */ (before.get(key)));
  const all = extent(spots.values());
  for (const key of fresh.sort()) {
    const [w, h] = sizeOf(items.get(key));
    const near = [];
    for (const line of lines.values()) {
      if (line.from === key && spots.has(line.to)) near.push({ spot: /** @type {Spot} */ (spots.get(line.to)), side: -1 });
      if (line.to === key && spots.has(line.from)) near.push({ spot: /** @type {Spot} */ (spots.get(line.from)), side: 1 });
    }
    const beside = near[0];
    const x = beside ? beside.spot.x + beside.side * ((beside.spot.w + w) / 2 + COLUMN) : all.x + w / 2;
    const y = beside ? near.reduce((sum, one) => sum + one.spot.y, 0) / near.length : all.y + all.h + GAP + h / 2;
    spots.set(key, free({ x, y, w, h }, [...spots.values()]));
  }
  return spots;
}

function free(/** @type {Spot} */ wanted, /** @type {Spot[]} */ taken) {
  const step = wanted.h + GAP;
  for (let round = 0; round < 400; round += 1) {
    const y = wanted.y + (round % 2 ? 1 : -1) * Math.ceil(round / 2) * step;
    const spot = { ...wanted, y };
    if (!taken.some((one) => Math.abs(one.x - spot.x) < (one.w + spot.w) / 2 + 6 && Math.abs(one.y - y) < (one.h + spot.h) / 2 + 6)) return spot;
  }
  return wanted;
}

function sizeOf(/** @type {any} */ item) {
  if (item.members) return GROUP;
  return SIZES[/** @type {keyof typeof SIZES} */ (item.kind)];
}

/** The rectangle around all spots. @param {Iterable<Spot>} spots */
export function extent(spots) {
  let [left, top, right, bottom] = [Infinity, Infinity, -Infinity, -Infinity];
  for (const { x, y, w, h } of spots) {
    left = Math.min(left, x - w / 2);
    right = Math.max(right, x + w / 2);
    top = Math.min(top, y - h / 2);
    bottom = Math.max(bottom, y + h / 2);
  }
  return left > right ? { x: 0, y: 0, w: 1, h: 1 } : { x: left, y: top, w: right - left, h: bottom - top };
}
