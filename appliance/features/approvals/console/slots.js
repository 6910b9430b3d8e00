/** The places of waiting calls in the bar, and when their buttons wake. Times are milliseconds of the monotonic clock. */

export const WAKES = 500;
const KEPT = 3000; // that an ended call is shown
const LATER = 5000; // by which another call must end earlier to come before: both times are rounded

/** @typedef {{number: number, call: any, left: number, ended: string, endedAt: number, awake: number}} Slot `left`: the end of its time */

/**
 * Put the waiting calls into slots. New ones come behind, those first that end first. @param {Slot[]} slots @param {any[] | null} rows @param {number} at when the rows came
 * @param {number} now @returns {Slot[]}
 */
export function placed(slots, rows, at, now) {
  const waiting = new Map(waitingOf(rows).map((call) => [call.number, call]));
  const left = (/** @type {any} */ call) => at + call.left_seconds * 1000;
  const known = slots.map((slot) => {
    const call = waiting.get(slot.number);
    waiting.delete(slot.number);
    if (call) return { ...slot, call, left: left(call), ended: "", awake: slot.ended ? now + WAKES : slot.awake };
    return slot.ended ? slot : { ...slot, ended: endOf(rows?.find((one) => one.number === slot.number)), endedAt: now };
  });
  const more = [...waiting.values()].map((call) => ({ number: call.number, call, left: left(call), ended: "", endedAt: 0, awake: now + WAKES }));
  return [...known, ...more.sort((one, other) => one.left - other.left)];
}

/**
 * Drop ended calls, and put a call that was repeated, so that it has a new time, behind those that end earlier: a host that
 * repeats its calls for ever would hide all others. Not while the bar is in use; what moves sleeps. 
 * @param {Slot[]} slots @param {number} now @param {boolean} used @returns {Slot[]}
 */
export function pruned(slots, now, used) {
  if (used) return slots;
  const next = inOrder(slots.filter((slot) => !slot.ended || now - slot.endedAt < KEPT));
  const first = next.findIndex((slot, at) => slot !== slots[at]);
  if (first < 0) return next.length === slots.length ? slots : next;
  return [...next.slice(0, first), ...asleep(next.slice(first), now)];
}

/** Put the first call that ends after a later one behind it. @param {Slot[]} slots */
function inOrder(slots) {
  const behind = (/** @type {Slot} */ slot) => slots.findLastIndex((other) => !other.ended && other.left < slot.left - LATER);
  const at = slots.findIndex((slot, at) => !slot.ended && behind(slot) > at);
  if (at < 0) return slots;
  const to = behind(slots[at]) + 1;
  return [...slots.slice(0, at), ...slots.slice(at + 1, to), slots[at], ...slots.slice(to)];
}

/** Let the buttons sleep. @param {Slot[]} slots @param {number} now */
export function asleep(slots, now) {
  return slots.map((slot) => ({ ...slot, awake: now + WAKES }));
}

function endOf(/** @type {any} */ row) {
  if (!row) return "no longer waits";
  return row.state === "refused" ? `refused by ${row.who}` : `approved by ${row.who}`;
}

/** @param {any[] | null} rows */
export function waitingOf(rows) {
  return (rows ?? []).filter((one) => one.state === "waits");
}
