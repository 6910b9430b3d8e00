/** A value that several parts of the page show: whoever uses it is drawn again when it changes. */

import { useEffect, useState } from "./html.js";

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
 * The store's value, or a part of it; drawn again only when that part changes.
 * @template T, S
 * @param {Store<T>} store
 * @param {(value: T) => S} [select]
 * @returns {S}
 */
export function useStore(store, select = (value) => /** @type {any} */ (value)) {
  const [, again] = useState(0);
  const part = select(store.get());
  useEffect(() => {
    let known = select(store.get());
    if (!Object.is(known, part)) again((n) => n + 1);
    return store.subscribe(() => {
      const now = select(store.get());
      if (!Object.is(now, known)) {
        known = now;
        again((n) => n + 1);
      }
    });
  }, [store]);
  return part;
}
