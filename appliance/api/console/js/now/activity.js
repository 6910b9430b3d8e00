/** Warnings while monitors drop messages or the policy denies many requests, from the samples. */

import { counted } from "../numbers.js";

const SPAN = 60; // seconds
const DENIALS = 10; // least number in `SPAN`; fewer may come from one node that lacks a right
const DROPS = 1; // index in the counts of a monitor: verdicts, drops, changes, faults

/** @typedef {import("../live.js").Sample} Sample */

export function droppedByMonitors(/** @type {Sample} */ sample) {
  return Object.values(sample.monitors).reduce((sum, counts) => sum + counts[DROPS], 0);
}

/** The warnings of the last minute. @param {Sample[]} samples @returns {import("../live.js").Alarm[]} */
export function activity(samples) {
  const last = samples.at(-1);
  if (!last) return [];
  const before = samples.find((one) => one.time >= last.time - SPAN);
  if (!before || before === last) return [];
  /** @type {import("../live.js").Alarm[]} */
  const found = [];
  for (const [name, counts] of Object.entries(last.monitors)) {
    const drops = counts[DROPS] - (before.monitors[name]?.[DROPS] ?? 0);
    if (drops > 0) found.push({ kind: `drops:${name}`, severity: "warning", text: `${name} dropped ${counted(drops, "message")} in the last minute`, about: "monitors" });
  }
  const denials = last.denied - before.denied;
  if (denials >= DENIALS) found.push({ kind: "denials", severity: "warning", text: `${counted(denials, "request")} denied in the last minute`, about: "audit", to: "/console/audit?decision=deny&since=1h" });
  return found;
}
