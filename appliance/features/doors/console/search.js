/** The doors, for the search. */

import { get } from "#console/rest.js";

export async function doors(/** @type {AbortSignal} */ signal) {
  const found = await get("/v1/doors", {}, signal);
  return found.doors.map((/** @type {any} */ { name, address, node }) => ({
    name, more: `${address}, ${node}`, to: "/console/robot", row: `[data-door="${CSS.escape(name)}"]`,
  }));
}
