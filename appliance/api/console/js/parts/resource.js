/** A fetched resource: its value, whether it is loading, its error, and a function to fetch it again. */

import { mark } from "../elapsed.js";
import { useCallback, useEffect, useMemo, useRef, useState } from "../html.js";
import { live } from "../live.js";
import { Problem } from "../problem.js";
import { unlocked } from "../session.js";
import { useStore } from "../store.js";

const PATIENCE = 8000; // milliseconds without an answer, after which a repeated request has failed
const GAP = 200; // milliseconds between two requests: a storm of changes needs no request for each

/**
 * The answer to a request that is repeated. Without one in 8 s the request fails, and is cut off; a locked page asks nothing.
 * @template T @param {(signal: AbortSignal) => Promise<T>} fetching @returns {Promise<T>}
 */
export async function inTime(fetching, controller = new AbortController()) {
  let late = 0;
  const lateness = new Promise((_, fail) => {
    const wait = () => {
      late = setTimeout(() => {
        fail(new Problem(0, { detail: `No answer in ${PATIENCE / 1000} s.` }));
        controller.abort();
      }, PATIENCE);
    };
    unlocked().then(wait, () => {});
  });
  try {
    return await Promise.race([fetching(controller.signal), /** @type {Promise<never>} */ (lateness)]);
  } finally {
    clearTimeout(late);
  }
}

/**
 * @template T
 * @param {(signal: AbortSignal) => Promise<T>} fetching
 * @param {any[]} inputs fetched again when one of them changes
 * @param {number | ((value: T | null) => number)} [every] milliseconds after each answer or failure until it is fetched again; 0: not
 * @returns {{value: T | null, error: unknown, heard: import("../elapsed.js").Mark | null, loading: boolean, again: () => void, set: (value: T) => void}}
 * `heard`: when the value came. After an `error`, the value is an earlier one, and is shown with its age.
 */
export function useResource(fetching, inputs, every = 0) {
  const [state, setState] = useState({ value: /** @type {T | null} */ (null), error: /** @type {unknown} */ (null), heard: /** @type {import("../elapsed.js").Mark | null} */ (null), loading: true });
  const [round, setRound] = useState(0);
  const newest = useRef(fetching);
  newest.current = fetching;
  useEffect(() => {
    const controller = new AbortController();
    let left = false;
    setState((state) => ({ ...state, loading: true }));
    const failed = (/** @type {unknown} */ error) => left || setState((state) => ({ ...state, error, loading: false }));
    const asked = every ? inTime(newest.current, controller) : newest.current(controller.signal);
    asked.then((value) => left || set(value), failed);
    return () => {
      left = true;
      controller.abort();
    };
  }, [...inputs, round]);
  const again = useCallback(() => setRound((n) => n + 1), []);
  const set = useCallback((/** @type {T} */ value) => setState({ value, error: null, heard: mark(), loading: false }), []);
  // Counted from the answer: a request that takes longer than the pause is not cut off by the next one.
  const pause = typeof every === "number" ? every : every(state.value);
  useEffect(() => {
    if (state.loading || !pause) return undefined;
    const timer = setTimeout(again, pause);
    return () => clearTimeout(timer);
  }, [state, pause]);
  return { ...state, again, set };
}

/**
 * A function that fetches, one request at a time: no older answer follows a newer one. What changes during a request is fetched
 * once more before the promise ends. @param {() => Promise<void>} fetching never fails @returns {() => Promise<void>}
 */
export function inTurn(fetching) {
  let running = /** @type {Promise<void> | null} */ (null);
  let stale = false;
  const fetchAll = async () => {
    for (let first = true; stale; first = false) {
      if (!first) await new Promise((done) => setTimeout(done, GAP));
      stale = false;
      await fetching();
    }
    running = null;
  };
  return () => {
    stale = true;
    return (running ??= fetchAll());
  };
}

/**
 * A resource that follows the appliance's state: fetched again when a part of the state is another, and with each state while the
 * last request has failed. `value`, `error` and `heard` as in `useResource`.
 * @template T
 * @param {(signal: AbortSignal) => Promise<T>} fetching
 * @param {(state: any, value: T | null) => any[]} part of the state in `live`
 * @returns {{value: T | null, error: unknown, heard: import("../elapsed.js").Mark | null, again: () => Promise<void>}}
 */
export function useFollowed(fetching, part) {
  const [state, setState] = useState({ value: /** @type {T | null} */ (null), error: /** @type {unknown} */ (null), heard: /** @type {import("../elapsed.js").Mark | null} */ (null) });
  const newest = useRef(fetching);
  newest.current = fetching;
  const again = useMemo(() => inTurn(async () => {
    try {
      setState({ value: await inTime((signal) => newest.current(signal)), error: null, heard: mark() });
    } catch (error) {
      setState((state) => ({ ...state, error }));
    }
  }), []);
  const changed = useStore(live, (one) => JSON.stringify([part(one, state.value), state.error ? one.heard?.steady : null]));
  useEffect(() => {
    again();
  }, [changed]);
  return { ...state, again };
}
