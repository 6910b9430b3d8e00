/**
 * How long something has taken in this browser. Its wall clock may be set, and its monotonic clock may stand still while the
 * computer sleeps: the longer of both counts, so what is old is never taken for new. Times of the appliance are compared with
 * the appliance's own clock (`applianceTime`), because that of the browser may differ.
 */

/** @typedef {{wall: number, steady: number}} Mark */

/** @returns {Mark} */
export function mark() {
  return { wall: Date.now(), steady: performance.now() };
}

/** Milliseconds since a mark. @param {Mark} from */
export function since(from) {
  return Math.max(Date.now() - from.wall, performance.now() - from.steady);
}
