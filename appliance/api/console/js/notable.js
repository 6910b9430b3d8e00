/**
 * Records to show as they happen (severity notice and above): denials, actions of monitors, changes.
 * One stream serves all views; it keeps the last records, newest first.
 */

import { compared, isDenial } from "./audit/rows.js";
import { mark } from "./elapsed.js";
import { follow } from "./events.js";
import { get } from "./rest.js";
import { createStore } from "./store.js";

const KEPT = 400;
const NEAR = "1d";
const AGAIN = 5000; // milliseconds after a failure

/** @typedef {Record<string, any>} AuditRecord as docs/reference/audit-log.md describes it */

export const notable = createStore({
  denials: /** @type {AuditRecord[] | null} */ (null),
  doings: /** @type {AuditRecord[] | null} */ (null), // actions of monitors
  incidents: /** @type {AuditRecord[] | null} */ (null), // records of severity alarm
  latest: /** @type {AuditRecord | null} */ (null), // the newest record since the page follows
  missing: /** @type {string | null} */ (null), // why records do not come at present
  heard: /** @type {import("./elapsed.js").Mark | null} */ (null), // until when they came, while they do not
});

let running = /** @type {ReturnType<typeof follow> | null} */ (null);
let generation = 0;

export async function startNotable() {
  if (running) return;
  const mine = (generation += 1);
  running = { stop: () => {}, retry: () => {} };
  const past = (/** @type {Record<string, any>} */ query) =>
    get("/v1/audit", { since: NEAR, limit: 100, equality: 1, ...query }).then(compared);
  const all = () => Promise.all([
    past({ decision: ["deny", "would deny"] }).then((records) => records.filter(isDeniedCall)), past({ category: "monitor", severity: "notice" }).then((records) => records.filter(isDoing)), past({ severity: "alarm" }),
  ]).catch((error) => {
    if (mine === generation) notable.update({ missing: String(error.message) });
    return null;
  });
  let lists = await all();
  while (!lists && mine === generation) {
    await new Promise((done) => setTimeout(done, AGAIN)); // until they come they are not known, and never empty
    if (mine === generation) lists = await all();
  }
  if (!lists || mine !== generation) return;
  const [denials, doings, incidents] = lists;
  notable.update({ denials, doings, incidents, missing: null });
  const last = Math.max(0, ...[...denials, ...doings, ...incidents].map((one) => one.sequence));
  running = follow(() => `/v1/audit/stream?severity=notice&equality=1&since=${NEAR}`, heard, stands, String(last));
}

export function stopNotable() {
  generation += 1;
  running?.stop();
  running = null;
  notable.set({ denials: null, doings: null, incidents: null, latest: null, missing: null, heard: null });
}

function stands(/** @type {import("./events.js").Standing} */ { state, reason }) {
  if (state === "live") notable.update({ missing: null, heard: null });
  else if (reason) notable.update({ missing: reason, heard: notable.get().heard ?? mark() });
}

function heard(/** @type {string} */ event, /** @type {AuditRecord} */ record) {
  if (event !== "record") return;
  const change = /** @type {any} */ ({ latest: record });
  if (isDeniedCall(record)) change.denials = added(notable.get().denials, record);
  if (isDoing(record)) change.doings = added(notable.get().doings, record);
  if (record.severity === "alarm") change.incidents = added(notable.get().incidents, record);
  notable.update(change);
}

/** Whether a host was denied a call: the end of its right is not one, as in `rosrv audit summary`. @param {AuditRecord} record */
function isDeniedCall(record) {
  return isDenial(record) && (record.detail?.of ?? record.event) !== "revoked";
}

/** Whether a record is an action of a monitor, and not an operator's change of a monitor. @param {AuditRecord} record */
function isDoing(record) {
  return record.category === "monitor" && record.detail?.monitor !== undefined && !["monitor log", "shadow observed"].includes(record.event);
}

function added(/** @type {AuditRecord[] | null} */ list, /** @type {AuditRecord} */ record) {
  if (list?.some((one) => one.sequence === record.sequence)) return list;
  return [record, ...(list ?? [])].slice(0, KEPT);
}
