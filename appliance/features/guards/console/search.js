/** The guards, for the search. */

import { get } from "#console/rest.js";

export async function guards(/** @type {AbortSignal} */ signal) {
  const found = await get("/v1/guards", { presets: 0 }, signal);
  return found.guards.map((/** @type {any} */ { name, state, topics }) => ({
    name, more: `${state}, on ${topics.command}`, to: "/console/robot", row: `[data-guard="${CSS.escape(name)}"]`,
  }));
}
