/** Kinds of triggers and events of recordings. */

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
