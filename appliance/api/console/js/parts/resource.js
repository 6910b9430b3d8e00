/** A fetched resource: its value, whether it is loading, its error, and a function to fetch it again. */

import { useCallback, useEffect, useRef, useState } from "../html.js";

/**
 * @template T
 * @param {(signal: AbortSignal) => Promise<T>} fetching
 * @param {any[]} inputs fetched again when one of them changes
 * @returns {{value: T | null, error: unknown, loading: boolean, again: () => void, set: (value: T) => void}}
 */
export function useResource(fetching, inputs) {
  const [state, setState] = useState({ value: /** @type {T | null} */ (null), error: /** @type {unknown} */ (null), loading: true });
  const [round, setRound] = useState(0);
  const newest = useRef(fetching);
  newest.current = fetching;
  useEffect(() => {
    const controller = new AbortController();
    setState((state) => ({ ...state, loading: true }));
    newest.current(controller.signal).then(
      (value) => controller.signal.aborted || setState({ value, error: null, loading: false }),
      (error) => controller.signal.aborted || setState((state) => ({ ...state, error, loading: false })),
    );
    return () => controller.abort();
  }, [...inputs, round]);
  const again = useCallback(() => setRound((n) => n + 1), []);
  const set = useCallback((/** @type {T} */ value) => setState({ value, error: null, loading: false }), []);
  return { ...state, again, set };
}
