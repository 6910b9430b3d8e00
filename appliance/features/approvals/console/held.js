/** The calls that wait for an operator, and the approvals: fetched once for all places that show them. */

import { callFor } from "#console/attention.js";
import { mark } from "#console/elapsed.js";
import { useEffect, useRef } from "#console/html.js";
import { live } from "#console/live.js";
import { notable } from "#console/notable.js";
import { counted } from "#console/numbers.js";
import { attempt } from "#console/parts/attempt.js";
import { inTime, inTurn } from "#console/parts/resource.js";
import { done } from "#console/parts/toast.js";
import { ask, get } from "#console/rest.js";
import { session } from "#console/session.js";
import { createStore, useStore } from "#console/store.js";
import { waitingOf } from "./slots.js";
import { ring } from "./sound.js";

/** `heard`: when they came. `rows` is null before they are known. */
export const held = createStore({ rows: /** @type {any[] | null} */ (null), error: /** @type {unknown} */ (null), heard: /** @type {import("#console/elapsed.js").Mark | null} */ (null) });

/** Fetch them. */
export const again = inTurn(async () => {
  try {
    const { approvals } = await inTime((signal) => get("/v1/approvals", undefined, signal));
    held.set({ rows: approvals, error: null, heard: mark() });
  } catch (error) {
    held.update({ error });
  }
});

/**
 * Fetch them when a record or the state says that they changed, and with each state while there are any or the last request failed. The bar, which
 * is on every page, calls this.
 */
export function useHeldCalls() {
  const changed = useStore(live, (one) => {
    const counts = one.status?.approvals;
    if (!counts) return "";
    const some = counts.waiting + counts.leases > 0 || held.get().rows?.length || held.get().error;
    return [one.status.since, counts.waiting, counts.leases, some ? one.heard?.steady : ""].join(" ");
  });
  const record = useStore(notable, (one) => (one.latest?.event.startsWith("approval ") ? one.latest.sequence : 0));
  const signedIn = useStore(session, ({ current }) => current !== null);
  const waiting = waitingOf(useStore(held, (one) => one.rows));
  useEffect(() => {
    if (changed || record) again();
  }, [changed, record]);
  useEffect(() => () => held.set({ rows: null, error: null, heard: null }), []);
  useEffect(() => callFor(signedIn && waiting.length ? counted(waiting.length, "call waits", "calls wait") : ""), [signedIn, waiting.length]);
  useEffect(() => () => callFor(""), []);
  const numbers = waiting.map((one) => one.number);
  const known = useRef(/** @type {number[]} */ ([]));
  useEffect(() => {
    if (signedIn && numbers.some((one) => !known.current.includes(one))) ring();
    known.current = numbers;
  }, [numbers.join()]);
}

/** Approve a call that still waits, or refuse one or end an approval, and say so. @param {number} number @param {"approve" | "refuse"} verb @param {number} [seconds] */
export async function decide(number, verb, seconds) {
  const json = verb === "approve" ? { seconds, waits: true } : undefined;
  await attempt(async () => {
    const { body } = await ask("POST", `/v1/approvals/${number}/${verb}`, { json, match: "*" });
    done(`Approval ${body.number}: ${body.state === "lease" ? "approved" : body.state}`, `${body.host} ${body.resource}`);
  }, again);
}
