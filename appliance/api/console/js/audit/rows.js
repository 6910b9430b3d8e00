/**
 * Equal records as one row. The appliance decides which records are equal and how far apart they may be
 * (`appliance/audit/search/equality.py`); this only puts them into rows, as `grouped` does there.
 */

import { html } from "../html.js";
import { Moment } from "../moments.js";
import { counted } from "../numbers.js";
import { Icon } from "../parts/icon.js";

/** @typedef {{records: any[], first: any, last: any, count: number, value: string}} Row `records`: as listed; `value`: of the last record that has one */

const SECOND = 19; // characters of a time, to its second

/** Whether a record is a denial, or would be one if the policy were enforced. @param {Record<string, any>} record */
export function isDenial(record) {
  return record.decision === "deny" || record.decision === "would deny";
}

/** The records of a page, each with its equality. @param {{records: any[], equality: any[]}} page */
export function compared({ records, equality }) {
  return records.map((one, at) => ({ ...one, equality: equality[at] }));
}

/** @param {any[]} records in either order @returns {Row[]} */
export function grouped(records) {
  /** @type {Row[]} */
  const rows = [];
  let open = /** @type {{key: string, reason: string, row: Row}[]} */ ([]);
  for (const record of records) {
    const { key, reason, reach, times, value } = record.equality;
    const known = open.slice(-reach).find((one) => one.key === key && (one.reason === reason || !one.reason || !reason));
    if (!known) {
      const row = { records: [record], first: record, last: record, count: times, value };
      rows.push(row);
      open = [...open, { key, reason, row }].slice(-reach);
      continue;
    }
    const { row } = known;
    known.reason ||= reason;
    row.records.push(record);
    row.count += times;
    if (record.sequence < row.first.sequence) {
      row.first = record;
      row.value ||= value;
    } else {
      row.last = record;
      row.value = value || row.value;
    }
  }
  return rows;
}

/**
 * Denials of a host in one row for each kind (publish, subscribe, …), and a monitor's actions in one row for each kind,
 * host and topic, at the place of the newest: a host that makes several calls in turn is a few rows. All other rows stay.
 * @param {Row[]} rows the newest first
 */
export function byHostAndKind(rows) {
  /** @type {Map<string, Row>} */
  const known = new Map();
  return rows.flatMap((row) => {
    const key = kindOf(row.first);
    if (!key) return [row];
    const newer = known.get(key);
    if (!newer) {
      const own = { ...row };
      known.set(key, own);
      return [own];
    }
    Object.assign(newer, { records: [...newer.records, ...row.records], first: row.first, count: newer.count + row.count, value: newer.value || row.value });
    return [];
  });
}

/** @param {any} record */
function kindOf({ decision, event, host, category, resource, detail, ...record }) {
  if (isDenial({ decision }) && host) return JSON.stringify([decision, host, category]);
  return category === "monitor" && detail.monitor && !detail.who ? JSON.stringify([event, detail.monitor, host, resource, record.severity]) : null;
}

/** Rows in the order of the times that they show, the newest first: a record that counts repetitions is made after them. @param {Row[]} rows */
export function inOrder(rows) {
  return rows.toSorted((one, other) => shownTime(other).localeCompare(shownTime(one)));
}

function shownTime(/** @type {Row} */ { last }) {
  return last.equality.ended;
}

/** How many other resources, or callers, a row's records have than the one that it shows. @param {Row} row @param {"resource" | "caller_id"} [field] */
export function othersOf({ records }, field = "resource") {
  return new Set(records.map((one) => one[field])).size - 1;
}

/** The record that a row shows and opens: the newest that is not just a number of repetitions. @param {Row} row */
export function shownOf({ records, first }) {
  return records.filter((one) => !one.detail.count).reduce((best, one) => (best && best.sequence > one.sequence ? best : one), null) ?? first;
}

/** How often it happened, and a button that shows each record. @param {{row: Row, open: boolean, toggle: () => void}} given */
export function Count({ row, open, toggle }) {
  if (row.count === 1) return null;
  if (row.records.length === 1) return html`<span class="count-badge">${counted(row.count, "time")}</span>`;
  const press = (/** @type {Event} */ event) => {
    event.stopPropagation();
    toggle();
  };
  return html`<button class="count-badge" aria-expanded=${String(open)} title=${open ? "Show one row" : "Show each record"} onClick=${press}>${counted(row.count, "time")}<${Icon} name=${open ? "minus" : "plus"} size=${12} /></button>`;
}

/** The time of the last event, and of the first if it was in another second. @param {{row: Row}} given */
export function Range({ row }) {
  const { began } = row.first.equality;
  const { ended } = row.last.equality;
  return ended.slice(0, SECOND) === began.slice(0, SECOND) ? html`<${Moment} at=${ended} />` : html`<${Moment} at=${ended} /> <span class="muted small nowrap">since <${Moment} at=${began} /></span>`;
}
