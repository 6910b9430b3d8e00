/** The monitors as `/v1/monitors` has them, fetched anew when the appliance says that something changed. */

import { useEffect, useState } from "../html.js";
import { live } from "../live.js";
import { ask } from "../rest.js";
import { useStore } from "../store.js";

/** @returns {{body: any, etag: string, error: unknown, again: () => Promise<void>}} */
export function useMonitors() {
  const [state, setState] = useState({ body: /** @type {any} */ (null), etag: "", error: /** @type {unknown} */ (null) });
  const mark = useStore(live, (one) => JSON.stringify(one.status?.monitors ?? null));
  const counted = useStore(live, (one) => JSON.stringify(one.samples.at(-1)?.monitors ?? null));
  const again = async () => {
    try {
      const { body, etag } = await ask("GET", "/v1/monitors");
      setState({ body, etag: etag ?? "", error: null });
    } catch (error) {
      setState((state) => ({ ...state, error }));
    }
  };
  useEffect(() => {
    again();
  }, [mark, counted]);
  return { ...state, again };
}

/** In one word. @param {any} row */
export function stateOf(row) {
  return row.held ? "held" : row.failing ? "failing" : row.enabled ? "enabled" : "disabled";
}

/** How a monitor's counter grew, out of the samples. @param {any[]} samples @param {string} name @param {number} place */
export function counters(samples, name, place) {
  const found = [];
  for (let index = 1; index < samples.length; index += 1) {
    const [before, after] = [samples[index - 1], samples[index]];
    const more = (after.monitors[name]?.[place] ?? 0) - (before.monitors[name]?.[place] ?? 0);
    found.push({ time: after.time, value: more < 0 || after.time <= before.time ? null : more / (after.time - before.time) });
  }
  return found;
}
