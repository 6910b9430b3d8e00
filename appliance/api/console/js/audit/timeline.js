/** The times of the shown records: one mark for each record, in the colour of its outcome. */

import { html } from "../html.js";
import { Moment } from "../moments.js";
import { counted } from "../numbers.js";
import { go } from "../router.js";
import { auditPath } from "./filters.js";
import { isDenial } from "./rows.js";

const GRAVE = new Set(["alarm", "warning"]);

/** @param {{records: any[], chosen: string, filter: Record<string, string>}} given `records`: the newest first */
export function Timeline({ records, chosen, filter }) {
  const times = records.map((one) => Date.parse(one.time));
  const [end, start] = [times[0], times[times.length - 1]];
  if (!(end > start)) return null;
  const pick = (/** @type {any} */ event) => {
    const id = event.target.dataset?.record;
    if (id) go(auditPath(filter, id));
  };
  return html`<figure class="timeline"><svg viewBox="0 0 1000 22" preserveAspectRatio="none" role="img" aria-label=${`When: ${counted(records.length, "record")}`} onClick=${pick}>
      ${records.map((one, at) => html`<rect key=${one.id} data-record=${one.id} class=${isDenial(one) ? "deny" : GRAVE.has(one.severity) ? "warn" : ""} x=${((times[at] - start) / (end - start)) * 996} y=${one.id === chosen ? 0 : 4} width="4" height=${one.id === chosen ? 22 : 14} />`)}</svg>
    <figcaption class="small muted"><${Moment} at=${records[records.length - 1].time} /><${Moment} at=${records[0].time} /></figcaption></figure>`;
}
