/** Times in the user's time zone; on hover, the time in UTC, to the nanosecond if known. */

import { html, useEffect, useState } from "./html.js";

const CLOCK = new Intl.DateTimeFormat(undefined, { hour: "2-digit", minute: "2-digit", second: "2-digit", hourCycle: "h23" });
const DAY = new Intl.DateTimeFormat(undefined, { year: "numeric", month: "short", day: "numeric" });
const WITHIN = new Intl.DateTimeFormat(undefined, { month: "short", day: "numeric", hour: "2-digit", minute: "2-digit", second: "2-digit", hourCycle: "h23" });
const MINUTE = new Intl.DateTimeFormat(undefined, { hour: "2-digit", minute: "2-digit", hourCycle: "h23" });

/** @param {string | number} value RFC 3339, or seconds since the epoch */
export function dateOf(value) {
  return new Date(typeof value === "number" ? value * 1000 : value);
}

/** A point in time: for today only the time of day, otherwise also the date. */
export function Moment(/** @type {{at: string | number | null, always?: "day"}} */ { at, always }) {
  if (at === null || at === undefined) return html`<span class="muted">never</span>`;
  const date = dateOf(at);
  if (Number.isNaN(date.getTime())) return html`<span class="muted">unknown</span>`;
  const utc = typeof at === "string" ? at : date.toISOString();
  return html`<time datetime=${date.toISOString()} title=${`${utc.replace("T", " ").replace("Z", "")} UTC`}>${shown(date, always)}</time>`;
}

function shown(/** @type {Date} */ date, /** @type {"day" | undefined} */ always) {
  if (always === "day") return DAY.format(date);
  return date.toDateString() === new Date().toDateString() ? CLOCK.format(date) : WITHIN.format(date);
}

/** RFC 3339, rounded down to a microsecond. @param {number} time nanoseconds since the epoch (a number here: exact to a microsecond) */
export function iso(time) {
  const micro = String(Math.floor(time / 1000) % 1000).padStart(3, "0");
  return new Date(Math.floor(time / 1e6)).toISOString().replace("Z", `${micro}Z`);
}

/** A text of the appliance, its times in the user's zone. @param {string} text */
export function inOwnZone(text) {
  return text.replace(/\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(\.\d+)?(Z|\+00:00)/g, (time) => shown(new Date(time.replace(" ", "T")), undefined));
}

/** Hours and minutes, for the axis of a plot. @param {number} seconds */
export function minute(seconds) {
  return MINUTE.format(new Date(seconds * 1000));
}

/** The time of day, with the decimals that an axis of `span` seconds needs. @param {number} seconds since the epoch @param {number} span */
export function clock(seconds, span) {
  const part = span < 1 ? 3 : span < 20 ? 1 : 0;
  return CLOCK.format(new Date(seconds * 1000)) + (part ? (seconds % 1).toFixed(3).slice(1, part + 2) : "");
}

const NOW = 60; // seconds in which a person may still act on what happened

/** Whether something happened a moment ago, so that it may be red. @param {string | number} at @param {number | null} now the appliance's time in seconds @param {number} [within] seconds */
export function isNow(at, now, within = NOW) {
  return now !== null && now - dateOf(at).getTime() / 1000 < within;
}

/** A duration in its two largest units. @param {number} seconds */
export function lasting(seconds) {
  const units = /** @type {[string, number][]} */ ([["d", 86_400], ["h", 3600], ["min", 60], ["s", 1]]);
  let left = Math.max(0, Math.round(seconds));
  const said = [];
  for (const [name, size] of units) {
    const count = Math.floor(left / size);
    left -= count * size;
    if (count || (said.length && name !== "s")) said.push(`${count} ${name}`);
    if (said.length === 2) break;
  }
  return said.length ? said.join(" ") : "0 s";
}

/** Draw again once a second. */
export function useSeconds() {
  const [, set] = useState(0);
  useEffect(() => {
    const timer = setInterval(() => set((count) => count + 1), 1000);
    return () => clearInterval(timer);
  }, []);
}
