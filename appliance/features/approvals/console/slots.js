/** The places of waiting calls in the bar, and when their buttons wake. Times are milliseconds of the monotonic clock. */

const WAKES = 500;
const KEPT = 3000; // that an ended call is shown

/** @typedef {{number: number, call: any, left: number, ended: string, endedAt: number, awake: number}} Slot `left`: the end of its time */

/**
 * Put the waiting calls into slots, the oldest first. @param {Slot[]} slots @param {any[] | null} rows @param {number} at when the rows came
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
  return [...known, ...[...waiting.values()].map((call) => ({ number: call.number, call, left: left(call), ended: "", endedAt: 0, awake: now + WAKES }))];
}

/** Drop ended calls, unless the bar is in use; what moves into their place sleeps. @param {Slot[]} slots @param {number} now @param {boolean} used @returns {Slot[]} */
export function pruned(slots, now, used) {
  const stays = (/** @type {Slot} */ slot) => !slot.ended || now - slot.endedAt < KEPT;
  const first = slots.findIndex((slot) => !stays(slot));
  if (used || first < 0) return slots;
  return [...slots.slice(0, first), ...asleep(slots.slice(first).filter(stays), now)];
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
