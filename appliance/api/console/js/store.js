/** A shared value; components that use it render again when it changes. */

import { useEffect, useRef, useState } from "./html.js";

/**
 * @template T
 * @typedef {{get: () => T, set: (value: T) => void, update: (change: Partial<T>) => void, subscribe: (heard: () => void) => () => void}} Store
 */

/**
 * @template T
 * @param {T} value
 * @returns {Store<T>}
 */
export function createStore(value) {
  const listeners = new Set();
  const set = (/** @type {T} */ next) => {
    if (Object.is(next, value)) return;
    value = next;
    for (const heard of [...listeners]) heard();
  };
  return {
    get: () => value,
    set,
    update: (change) => set({ ...value, ...change }),
    subscribe: (heard) => {
      listeners.add(heard);
      return () => listeners.delete(heard);
    },
  };
}

/**
 * Return the store's value, or a part of it; the component renders again only when that part changes.
 * @template T, S
 * @param {Store<T>} store
 * @param {(value: T) => S} [select]
 * @returns {S}
 */
export function useStore(store, select = (value) => /** @type {any} */ (value)) {
  const [, again] = useState(0);
  const part = select(store.get());
  // Each render may pass a new `select`, so compare with the part that the last `select` returned.
  const drawn = useRef({ select, part });
  drawn.current = { select, part };
  useEffect(() => {
    const look = () => {
      const { select, part } = drawn.current;
      if (!Object.is(select(store.get()), part)) again((n) => n + 1);
    };
    look();
    return store.subscribe(look);
  }, [store]);
  return part;
}
