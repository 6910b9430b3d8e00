/** The guards from `/v1/guards`, fetched again after each change, and while one of them acts or only records. */

import { useEffect, useState } from "#console/html.js";
import { live } from "#console/live.js";
import { ask, get } from "#console/rest.js";
import { useStore } from "#console/store.js";
import { attempt } from "#console/parts/attempt.js";
import { done } from "#console/parts/toast.js";

const PASSING = ["stopping", "withholding", "shadow"]; // states whose counts change without a change of the specifications

/** @param {{presets?: boolean}} [given] `presets`: with the presets, which are large @returns {{body: any, error: unknown, again: () => Promise<void>, order: (said: string, more: string, method: string, path: string, options?: any) => Promise<boolean>}} */
export function useGuards({ presets = true } = {}) {
  const [state, setState] = useState({ body: /** @type {any} */ (null), error: /** @type {unknown} */ (null) });
  const passing = state.body?.guards.some((/** @type {any} */ row) => PASSING.includes(row.state) || row.preset === "withhold");
  const mark = useStore(live, (one) => JSON.stringify([one.status?.monitors ?? null, one.samples.at(-1)?.monitors ?? null, passing ? one.samples.at(-1)?.time : null]));
  const again = async () => {
    try {
      setState({ body: await get("/v1/guards", { presets: presets ? undefined : 0 }), error: null });
    } catch (error) {
      setState((state) => ({ ...state, error }));
    }
  };
  useEffect(() => {
    again();
  }, [mark]);
  /** Send a change, say that it is done, and fetch the guards again. Returns whether it was done. `undo` gets the tag after it. */
  const order = async (/** @type {string} */ said, /** @type {string} */ more, /** @type {string} */ method, /** @type {string} */ path, /** @type {any} */ { undo, ...options } = {}) => {
    let made = false;
    await attempt(async () => {
      const { body } = await ask(method, path, { ...options, match: `"${state.body.tag}"` });
      done(said, more, undo && (async () => {
        await undo(body.tag);
        await again();
      }));
      made = true;
    }, again);
    return made;
  };
  return { ...state, again, order };
}
