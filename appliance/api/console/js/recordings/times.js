/** Times of recordings, which are nanoseconds since the epoch (a number here: exact to a microsecond). */

/** RFC 3339, rounded down to a microsecond. @param {number} time */
export function iso(time) {
  const micro = String(Math.floor(time / 1000) % 1000).padStart(3, "0");
  return new Date(Math.floor(time / 1e6)).toISOString().replace("Z", `${micro}Z`);
}

/** The name and colour of a trigger or event. */
export const KINDS = {
  alarm: { name: "Alarms", tone: "deny" },
  denial: { name: "Denied", tone: "deny" },
  drop: { name: "Dropped", tone: "warn" },
  change: { name: "Changed", tone: "note" },
  verdict: { name: "Verdicts", tone: "note" },
  fault: { name: "Faults", tone: "deny" },
  notice: { name: "Else", tone: "" },
  service: { name: "By a node", tone: "" },
  order: { name: "By hand", tone: "" },
};

/** @param {string} kind @returns {{name: string, tone: string}} */
export function kindOf(kind) {
  return KINDS[/** @type {keyof typeof KINDS} */ (kind)] ?? { name: kind, tone: "" };
}
