/** How close a guard came to acting: the worst value in the seen messages, and the bound that it has. */

import { corners, depth, positionIn } from "./geometry.js";

/** @typedef {{name: string, value: number, bound: number, unit: string, used: number, least?: boolean}} Margin `used`: 1 at the bound, more beyond; `least`: the bound is the least value */

/** @param {any} guard as `/v1/guards` has it @param {Record<string, any[]>} seen messages by topic @returns {Margin[]} */
export function margins(guard, seen) {
  return [...edge(guard, seen), ...silences(guard, seen), ...speeds(guard, seen)];
}

/** The value of a constant that is given to a guard. @param {any} guard @param {string} name @returns {number | null} */
export function constant(guard, name) {
  const value = guard.given.find((/** @type {any} */ one) => one.name === name && one.kind !== "topic")?.value;
  return typeof value === "number" ? value : null;
}

/** The positions of a fence's robot, oldest first. @param {any} guard @param {Record<string, any[]>} seen */
export function trailOf(guard, seen) {
  const origin = { lat0: constant(guard, "lat0") ?? 0, lon0: constant(guard, "lon0") ?? 0 };
  return (seen[guard.topics.by] ?? []).map((one) => positionIn(one.fields, origin)).filter((one) => one !== null);
}

function edge(/** @type {any} */ guard, /** @type {Record<string, any[]>} */ seen) {
  const polygon = corners(guard.loads.polygon ?? "");
  const trail = polygon ? trailOf(guard, seen) : [];
  const bound = constant(guard, "margin");
  if (!polygon || !trail.length || bound === null) return [];
  const value = Math.min(...trail.map((one) => depth(one, polygon)));
  return [{ name: "distance to the edge", value, bound, unit: "m", least: true, used: value > 0 ? bound / value : 1 + Math.abs(value) }];
}

function silences(/** @type {any} */ guard, /** @type {Record<string, any[]>} */ seen) {
  const bound = constant(guard, "silent");
  const topic = guard.topics.by ?? guard.topics.command;
  const times = (seen[topic] ?? []).map((one) => one.time / 1e9);
  if (!bound || times.length < 2) return [];
  const value = Math.max(...times.slice(1).map((time, index) => (seen[topic][index + 1].first ? 0 : time - times[index])));
  return [{ name: "longest silence", value, bound, unit: "s", used: value / bound }];
}

function speeds(/** @type {any} */ guard, /** @type {Record<string, any[]>} */ seen) {
  if (guard.preset !== "speed") return [];
  const twists = (seen[guard.topics.command] ?? []).map(({ fields }) => fields?.twist ?? fields);
  const fastest = (/** @type {any[]} */ values) => Math.max(...values.flatMap((one) => Object.values(one ?? {})).filter((one) => typeof one === "number").map(Math.abs));
  const linear = fastest(twists.map((twist) => twist?.linear ?? { x: twist?.drive?.speed ?? twist?.speed }));
  const angular = fastest(twists.map((one) => one?.angular));
  return /** @type {[string, string, number, string][]} */ ([["fastest", "vMax", linear, "m/s"], ["fastest turn", "wMax", angular, "rad/s"]]).flatMap(([name, of, value, unit]) => {
    const bound = constant(guard, of);
    return bound && Number.isFinite(value) ? [{ name, value, bound, unit, used: value / bound }] : [];
  });
}
