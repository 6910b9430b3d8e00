/** Pages of records, newest first; new records while following. */

import { useCallback, useEffect, useRef, useState } from "../html.js";
import { follow } from "../events.js";
import { get, queryText } from "../rest.js";
import { byHostAndKind, compared, grouped, inOrder } from "./rows.js";

const PAGE = 100;
const FEW_ROWS = 20; // with fewer rows of a page, older pages follow at once
const MOST_PAGES = 5;
const KEPT = 2000; // records kept while following; pages that the user fetched come on top
const PAUSE = 250; // milliseconds after the last key of a search

/**
 * Return the query for a filter. REST calls that only read (mostly this page's own) are included only on request.
 * Without a filter, or with a filter of time only, records start at severity notice: denials, actions of monitors,
 * changes, faults.
 */
export function askedOf(/** @type {Record<string, string>} */ { looks, ...filter }) {
  const matters = !looks && Object.keys(filter).every((name) => name === "since" || name === "until");
  if (matters) return { ...filter, severity: "notice", looks: "0" };
  return looks || filter.event || filter.category ? filter : { ...filter, looks: "0" };
}

/** Whether a filter asks for all hosts' denials: then they are rows by host and kind. @param {Record<string, string>} filter */
export function asksForAll(filter) {
  return Object.entries(filter).every(([name, value]) => name === "since" || name === "until" || (name === "decision" && value !== "allow"));
}

/** @param {Record<string, string>} filter @param {any[]} records */
export function rowsOf(filter, records) {
  const rows = grouped(records);
  return inOrder(asksForAll(filter) ? byHostAndKind(rows) : rows);
}

/** @param {Record<string, string>} filter @param {boolean} following */
export function useRecords(filter, following) {
  const key = JSON.stringify(filter);
  const [state, setState] = useState({ records: /** @type {any[] | null} */ (null), cursor: /** @type {string | null} */ (null), notes: /** @type {string[]} */ ([]), most: KEPT, error: /** @type {unknown} */ (null), loading: true });
  const [standing, setStanding] = useState(/** @type {import("../events.js").Standing | null} */ (null));
  const [round, setRound] = useState(0);
  const first = useRef(true);

  useEffect(() => {
    const controller = new AbortController();
    setState((state) => ({ ...state, loading: true }));
    const timer = setTimeout(async () => {
      try {
        const page = await get("/v1/audit", { ...askedOf(filter), limit: PAGE, equality: 1 }, controller.signal);
        const { notes = [] } = page;
        let { cursor } = page;
        const records = compared(page);
        for (let pages = 1; pages < MOST_PAGES && cursor && rowsOf(filter, records).length < FEW_ROWS; pages += 1) {
          const older = await get("/v1/audit", { ...askedOf(filter), limit: PAGE, cursor, equality: 1 }, controller.signal);
          records.push(...compared(older));
          cursor = older.cursor;
        }
        setState({ records, cursor, notes, most: KEPT, error: null, loading: false });
      } catch (error) {
        if (!controller.signal.aborted) setState((state) => ({ ...state, error, loading: false }));
      }
    }, first.current ? 0 : PAUSE);
    first.current = false;
    return () => {
      clearTimeout(timer);
      controller.abort();
    };
  }, [key, round]);

  const ready = state.records !== null && !state.loading;
  useEffect(() => {
    if (!following || !ready) return undefined;
    const { until, ...rest } = askedOf(filter);
    const newest = state.records?.[0]?.sequence ?? 0; // the stream starts there, so no record since the list is missed
    const running = follow(() => `/v1/audit/stream${queryText({ ...rest, equality: 1 })}`, (event, record) => {
      if (event === "record") setState((state) => ({ ...state, ...added(state, record) }));
    }, setStanding, String(newest));
    return () => {
      running.stop();
      setStanding(null);
    };
  }, [following, ready, key]);

  const older = useCallback(async () => {
    if (!state.cursor) return;
    try {
      const page = await get("/v1/audit", { ...askedOf(filter), limit: PAGE, cursor: state.cursor, equality: 1 });
      const more = compared(page);
      setState((state) => ({ ...state, records: [...(state.records ?? []), ...more], cursor: page.cursor, most: state.most + more.length, error: null }));
    } catch (error) {
      setState((state) => ({ ...state, error }));
    }
  }, [key, state.cursor]);
  return { ...state, standing, older, again: () => setRound(round + 1) };
}

/**
 * Return the list with one more record. Records that fall off its end are fetched again from `cursor` on.
 * @param {{records: any[] | null, cursor: string | null, most: number}} state @param {any} record
 */
export function added({ records, cursor, most }, record) {
  const before = records ?? [];
  if (before.length && record.sequence <= before[0].sequence) return { records: before, cursor };
  if (before.length < most) return { records: [record, ...before], cursor };
  const kept = [record, ...before].slice(0, most);
  return { records: kept, cursor: String(kept[kept.length - 1].sequence) };
}
