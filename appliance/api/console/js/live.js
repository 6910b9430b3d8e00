/** The appliance's live state: status, present alarms, samples and, on request, the graph. */

import { mark, since } from "./elapsed.js";
import { follow } from "./events.js";
import { get } from "./rest.js";
import { createStore } from "./store.js";

const HOUR = 3600;
const EXPECTED = 8; // seconds within which a state comes; the appliance sends one every two

/**
 * @typedef {{time: number, allowed: number, denied: number, messages: number, bytes: number, dropped: number,
 *   nodes: number, monitors: Record<string, number[]>}} Sample
 * @typedef {{kind: string, severity: "alarm" | "warning" | "notice", text: string, about: string}} Alarm
 */

export const live = createStore({
  standing: /** @type {import("./events.js").Standing} */ ({ state: "connecting", reason: null, again: null }),
  away: /** @type {string | null} */ (null),
  heard: /** @type {import("./elapsed.js").Mark | null} */ (null),
  status: /** @type {any} */ (null),
  alarms: /** @type {Alarm[]} */ ([]),
  samples: /** @type {Sample[]} */ ([]),
  graph: /** @type {any} */ (null),
});

let running = /** @type {ReturnType<typeof follow> | null} */ (null);
let withGraph = false;

/** Start following, with or without the graph. */
export function start({ graph = false } = {}) {
  if (running && withGraph === graph) return;
  const first = !running;
  running?.stop();
  withGraph = graph;
  if (first) recall();
  running = follow(() => `/v1/live${withGraph ? "?graph=1" : ""}`, heard, (standing) => live.update({ standing }));
}

export function stop() {
  running?.stop();
  running = null;
  live.update({ status: null, alarms: [], samples: [], graph: null, heard: null, away: null });
}

export function retry() {
  running?.retry();
}

/** The appliance's present time in seconds since the epoch, by its last sample; null before the first one. */
export function applianceTime() {
  const { samples, heard } = live.get();
  const last = samples.at(-1);
  return last && heard !== null ? last.time + since(heard) / 1000 : null;
}

/** The same, and the browser's time before it is known. */
export function applianceNow() {
  return applianceTime() ?? Date.now() / 1000;
}

/** The age of what the page shows in seconds, and whether it is too old to be the present state. */
export function ageOf(/** @type {{heard: import("./elapsed.js").Mark | null, away: string | null, standing: import("./events.js").Standing}} */ { heard, away, standing }) {
  const age = heard === null ? 0 : since(heard) / 1000;
  return { age, old: heard !== null && (standing.reason !== null || away !== null || age > EXPECTED) };
}

async function recall() {
  try {
    const { samples } = await get("/v1/history", { points: 600 });
    const newest = samples.at(-1)?.time ?? 0;
    live.update({ samples: [...samples, ...live.get().samples.filter((one) => one.time > newest)] });
  } catch {
    // the curves begin now, and the state of the stream shows the error
  }
}

function heard(/** @type {string} */ event, /** @type {any} */ data) {
  const heard = mark();
  if (event === "now") {
    const { time } = data.sample;
    const samples = [...live.get().samples.filter((one) => one.time > time - HOUR && one.time < time), data.sample];
    live.update({ status: data.status, alarms: data.alarms, samples, away: null, heard });
  } else if (event === "graph") live.update({ graph: data });
  else if (event === "away") live.update({ away: data.reason });
}
