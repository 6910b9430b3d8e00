/** The enrolled hosts, for the search. */

import { get } from "#console/rest.js";

export async function hosts(/** @type {AbortSignal} */ signal) {
  const found = await get("/v1/hosts", {}, signal);
  return found.hosts.map((/** @type {any} */ { name, address }) => ({
    name, more: address, to: "/console/hosts", row: `[data-host="${CSS.escape(name)}"]`,
  }));
}
