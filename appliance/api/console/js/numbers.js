/** Numbers for display. */

const WHOLE = new Intl.NumberFormat("en", { maximumFractionDigits: 0 });
const SHORT = new Intl.NumberFormat("en", { notation: "compact", maximumFractionDigits: 1 });

/** @param {number | null | undefined} value */
export function count(value) {
  if (value === null || value === undefined) return "–";
  return Math.abs(value) < 100_000 ? WHOLE.format(value) : SHORT.format(value);
}

/** All digits, for a record's sequence number. @param {number} value */
export function whole(value) {
  return WHOLE.format(value);
}

/** A rate per second, to three digits. @param {number | null | undefined} value */
export function rate(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  if (value < 0.1) return "<0.1";
  if (value < 100) return value.toFixed(1);
  return count(Math.round(value));
}

/** @param {number | null | undefined} value */
export function bytes(value) {
  if (value === null || value === undefined) return "–";
  const units = ["B", "kB", "MB", "GB", "TB"];
  let size = value;
  let unit = 0;
  while (size >= 1000 && unit < units.length - 1) {
    size /= 1000;
    unit += 1;
  }
  return `${size >= 100 || unit === 0 ? Math.round(size) : size.toFixed(1)} ${units[unit]}`;
}

/** `1 host`, `2 hosts`. @param {number} value @param {string} one @param {string} [many] */
export function counted(value, one, many = `${one}s`) {
  return `${count(value)} ${value === 1 ? one : many}`;
}

const LEAST = 10; // shortest interval of a rate in seconds: the relay reports its counters once a second
const MINUTE = 60;

/**
 * The growth of a counter per second at each sample, since the newest sample that is at least `LEAST` older. It is null
 * after a restart.
 * @template {{time: number}} S
 * @param {S[]} samples @param {(sample: S) => number} read
 * @returns {{time: number, value: number | null}[]}
 */
export function growth(samples, read) {
  const found = [];
  let before = 0;
  for (const after of samples) {
    while ((samples[before + 1]?.time ?? Infinity) <= after.time - LEAST) before += 1;
    const seconds = after.time - samples[before].time;
    if (seconds < LEAST) continue;
    const more = read(after) - read(samples[before]);
    found.push({ time: after.time, value: more < 0 ? null : more / seconds });
  }
  return found;
}

/** The growth of a counter per second in the last minute; null if that is not known. @template {{time: number}} S @param {S[]} samples @param {(sample: S) => number} read */
export function lately(samples, read) {
  const after = samples.at(-1);
  const before = after && (samples.findLast((one) => one.time <= after.time - MINUTE) ?? samples[0]);
  if (!before || after.time - before.time < LEAST || read(after) < read(before)) return null;
  return (read(after) - read(before)) / (after.time - before.time);
}
