/** The monitors from `/v1/monitors`, fetched again after each change. */

import { useRef } from "../html.js";
import { growth } from "../numbers.js";
import { useFollowed } from "../parts/resource.js";
import { ask } from "../rest.js";

/**
 * `change` sends a change of one monitor. Changes are queued, because each change makes a new ETag: a second click
 * before the first answer applies to the result of the first click.
 * @returns {{body: any, etag: string, error: unknown, heard: import("../elapsed.js").Mark | null, again: () => Promise<void>, change: (name: string, to: any) => Promise<void>}}
 */
export function useMonitors() {
  const shown = useRef({ etag: "", changes: 0, last: /** @type {Promise<unknown>} */ (Promise.resolve()) });
  const { value, error, heard, again } = useFollowed(async (signal) => {
    for (;;) {
      const { changes } = shown.current;
      const { body, etag } = await ask("GET", "/v1/monitors", { signal });
      if (changes !== shown.current.changes) continue; // a later change made this answer outdated
      shown.current.etag = etag ?? "";
      return { body, etag: etag ?? "" };
    }
  }, ({ status, samples }, known) => {
    // Samples lack the counts of shadow mode, which are fetched with each sample.
    const trying = known?.body.monitors.some((/** @type {any} */ row) => row.shadow);
    return [status?.monitors, samples.at(-1)?.monitors, trying && samples.at(-1)?.time];
  });
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
  return { body: value?.body ?? null, etag: value?.etag ?? "", error, heard, again, change };
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
