/** The monitors from `/v1/monitors`, fetched again after each change. */

import { useEffect, useRef, useState } from "../html.js";
import { live } from "../live.js";
import { growth } from "../numbers.js";
import { ask } from "../rest.js";
import { useStore } from "../store.js";

/**
 * `change` sends a change of one monitor. Changes are queued, because each change makes a new ETag: a second click
 * before the first answer applies to the result of the first click.
 * @returns {{body: any, etag: string, error: unknown, again: () => Promise<void>, change: (name: string, to: any) => Promise<void>}}
 */
export function useMonitors() {
  const [state, setState] = useState({ body: /** @type {any} */ (null), etag: "", error: /** @type {unknown} */ (null) });
  const mark = useStore(live, (one) => JSON.stringify(one.status?.monitors ?? null));
  // Samples lack the counts of shadow mode, which are fetched with each sample.
  const trying = state.body?.monitors.some((/** @type {any} */ row) => row.shadow);
  const counted = useStore(live, (one) => JSON.stringify([one.samples.at(-1)?.monitors ?? null, trying && one.samples.at(-1)?.time]));
  const shown = useRef({ etag: "", changes: 0, last: /** @type {Promise<unknown>} */ (Promise.resolve()) });
  const again = async () => {
    const { changes } = shown.current;
    try {
      const { body, etag } = await ask("GET", "/v1/monitors");
      if (changes !== shown.current.changes) return; // a later change makes this answer outdated, and fetches again
      shown.current.etag = etag ?? "";
      setState({ body, etag: etag ?? "", error: null });
    } catch (error) {
      setState((state) => ({ ...state, error }));
    }
  };
  const change = (/** @type {string} */ name, /** @type {any} */ to) => {
    const made = shown.current.last.then(async () => {
      try {
        const { etag } = await ask("PATCH", `/v1/monitors/${encodeURIComponent(name)}`, { json: to, match: shown.current.etag });
        shown.current.etag = etag ?? "";
      } finally {
        shown.current.changes += 1;
      }
    });
    shown.current.last = made.catch(() => {});
    return made;
  };
  useEffect(() => {
    again();
  }, [mark, counted]);
  return { ...state, again, change };
}

/** A monitor's state in one word. @param {any} row */
export function stateOf(row) {
  return row.error ? "broken" : row.shadow ? "shadow mode" : row.held ? "held" : row.failing ? "failing" : row.enabled ? "enabled" : "disabled";
}

/** The growth of a monitor's counter over the samples. @param {any[]} samples @param {string} name @param {number} place */
export function counters(samples, name, place) {
  return growth(samples, countOf(name, place));
}

/** Read a monitor's counter from a sample. @param {string} name @param {number} place */
export function countOf(name, place) {
  return (/** @type {any} */ sample) => sample.monitors[name]?.[place] ?? 0;
}
