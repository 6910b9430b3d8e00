/** The guards from `/v1/guards`, fetched again after each change, and while one of them acts or only records. */

import { ask, get } from "#console/rest.js";
import { attempt } from "#console/parts/attempt.js";
import { useFollowed } from "#console/parts/resource.js";
import { done } from "#console/parts/toast.js";

const PASSING = ["stopping", "withholding", "shadow"]; // states whose counts change without a change of the specifications

/** @param {{presets?: boolean}} [given] `presets`: with the presets, which are large @returns {{body: any, error: unknown, heard: import("#console/elapsed.js").Mark | null, again: () => Promise<void>, order: (said: string, more: string, method: string, path: string, options?: any) => Promise<boolean>}} */
export function useGuards({ presets = true } = {}) {
  const { value: body, error, heard, again } = useFollowed((signal) => get("/v1/guards", { presets: presets ? undefined : 0 }, signal), ({ status, samples }, known) => {
    const passing = known?.guards.some((/** @type {any} */ row) => PASSING.includes(row.state) || row.preset === "withhold");
    return [status?.monitors, samples.at(-1)?.monitors, passing && samples.at(-1)?.time];
  });
  /** Send a change, say that it is done, and fetch the guards again. Returns whether it was done. `undo` gets the tag after it. */
  const order = async (/** @type {string} */ said, /** @type {string} */ more, /** @type {string} */ method, /** @type {string} */ path, /** @type {any} */ { undo, ...options } = {}) => {
    let succeeded = false;
    await attempt(async () => {
      const { body: made } = await ask(method, path, { ...options, match: `"${body.tag}"` });
      done(said, more, undo && (async () => {
        await undo(made.tag);
        await again();
      }));
      succeeded = true;
    }, again);
    return succeeded;
  };
  return { body, error, heard, again, order };
}
