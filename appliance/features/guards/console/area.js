/** The polygon of a guard on a map: of a fence with the position that the guard itself has, of a zone in the scanner's frame. */

import { html } from "#console/html.js";
import { ageOf, outdated, positionOf, useBelief } from "./belief.js";
import { corners, depth, short } from "./geometry.js";
import { FenceMap } from "./map.js";
import { constant, trailOf } from "./margins.js";

const SCANNER = { x: 0, y: 0, turned: 0 };
const PRESENT = 0.5; // seconds: the age of a position that needs no word

/**
 * @param {{guard: any, seen: Record<string, any[]>, tried?: any, draft?: import("./geometry.js").Point[] | null,
 *   move?: (index: number, to: import("./geometry.js").Point) => void}} given `tried`: the guard with the values to try
 */
export function Area({ guard, seen, tried = guard, draft = null, move }) {
  const polygon = corners(guard.loads.polygon ?? "");
  if (!polygon) return null;
  const map = { name: guard.name, polygon, margin: constant(tried, "margin") ?? 0, draft, move };
  if (guard.preset === "zone") return html`<${FenceMap} ...${map} robot=${SCANNER} where="The arrow is the scanner: the zone moves with it." trail=${[]} />`;
  return html`<${Fence} guard=${guard} map=${map} trail=${trailOf(guard, seen)} />`;
}

function Fence(/** @type {{guard: any, map: any, trail: any[]}} */ { guard, map, trail }) {
  const { belief, error, heard, may } = useBelief(guard.name);
  const robot = positionOf(belief);
  const age = ageOf(belief);
  const late = age !== null && age > (constant(guard, "silent") ?? PRESENT);
  const why = outdated(belief, error, heard);
  return html`<${FenceMap} ...${map} robot=${robot} old=${late || why !== ""} trail=${trail} where=${place(robot, age, map.polygon, { may, belief, why })} />`;
}

/** @returns {string} */
function place(/** @type {any} */ robot, /** @type {number | null} */ age, /** @type {any} */ polygon, /** @type {any} */ { may, belief, why }) {
  if (!may) return "Operators see the position that the guard has.";
  if (!robot) return why || (belief ? "The guard has no position yet." : "The guard is asked for its position.");
  const edge = depth(robot, polygon);
  const when = age !== null && age > PRESENT ? `, ${short(age)} s ago` : "";
  const at = `The guard has the robot at ${short(robot.x)}, ${short(robot.y)}, ${short(Math.abs(edge))} m ${edge < 0 ? "outside of the fence" : "from the edge"}${when}.`;
  return why ? `${at} ${why}` : at;
}
