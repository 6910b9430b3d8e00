/**
 * How old the shown picture is, for the pad.
 *
 * 1. Its age counts from its arrival, by the browser's monotonic clock: a stamp in a message may be wrong.
 * 2. Bytes that repeat the last ones are not a new picture: a camera that hangs, or its driver, may send the same frame for ever.
 * 3. A picture that is not drawn, because it cannot be decoded or is still being decoded, does not count.
 */

/** Milliseconds after which a picture is too old to drive by. */
export const OLD = 500;

export class Freshness {
  #shown = false;
  #bytes = "";
  #arrived = -Infinity;

  /** A picture of a topic is shown from now on, or none. @param {boolean} shown */
  begin(shown) {
    this.#shown = shown;
    this.#bytes = "";
    this.#arrived = -Infinity;
  }

  /** A picture that came at `arrived` is drawn. @param {string} bytes @param {number} arrived */
  drawn(bytes, arrived) {
    if (bytes === this.#bytes) return;
    this.#bytes = bytes;
    this.#arrived = arrived;
  }

  /** Milliseconds since the shown picture came; 0 where no picture is shown. @param {number} now */
  age(now) {
    return this.#shown ? now - this.#arrived : 0;
  }
}
