/** Present alarms, and the last day's alarms that were not reviewed in this browser. */

import { html, useState } from "../html.js";
import { inOwnZone, isNow, Moment } from "../moments.js";
import { notable } from "../notable.js";
import { useApplianceTime } from "../parts/ago.js";
import { Badge } from "../parts/badge.js";
import { CopyCommand } from "../parts/copy.js";
import { Given } from "../parts/given.js";
import { Sentence } from "../parts/host.js";
import { Loading } from "../parts/notice.js";
import { Link } from "../router.js";
import { store, stored } from "../storage.js";
import { useStore } from "../store.js";

const PLACES = { policy: "/console/policy", monitors: "/console/monitors", hosts: "/console/hosts", audit: "/console/audit", system: "/console/audit?severity=warning", denials: "/console/audit?decision=deny&since=1h" };
const SEEN = "rosrv.reviewed";
const KEPT = 1000; // reviewed alarms, also those of another robot at this address
const MAX = 8;
const ORDER = ["alarm", "warning", "notice"];

/** The page about an alarm, by its kind or subject. @param {import("../live.js").Alarm} alarm */
export function placeOf(alarm) {
  const places = /** @type {Record<string, string>} */ (PLACES);
  return places[alarm.kind] ?? places[alarm.about];
}

export function Alarms(/** @type {{alarms: any[]}} */ { alarms }) {
  const { incidents, missing } = useStore(notable);
  const [seen, setSeen] = useState(reviewed);
  const now = useApplianceTime();
  const open = (incidents ?? []).filter((one) => !seen.has(one.id));
  const review = () => {
    const ids = [...open.map((one) => one.id), ...seen].slice(0, KEPT);
    store(SEEN, JSON.stringify(ids));
    setSeen(new Set(ids));
  };
  return html`<section class="panel spaced" aria-labelledby="alarms"><div class="panel-head"><h2 id="alarms">Open alarms</h2>${!alarms.length && !open.length && (missing || incidents) && html`<span class="muted small">${missing ? "Not known at present" : "No open alarms"}</span>`}
      ${open.length > 0 && html`<span class="end"><button class="button small" onClick=${review} title="Hide the alarms below in this browser; conditions stay until they end">Mark as reviewed</button></span>`}</div>
    ${incidents === null && !missing ? html`<${Loading} rows=${2} />` : null}
    ${!alarms.length && !open.length ? null : html`<ul class="alarm-list">${alarms.toSorted((one, other) => ORDER.indexOf(one.severity) - ORDER.indexOf(other.severity)).map((one, /** @type {number} */ at) => html`<li key=${`${one.kind} ${at}`} class="alarm"><${Badge} word=${one.severity} />
          <${Link} to=${placeOf(one)} class="alarm-text"><${Told} text=${inOwnZone(one.text)} /></${Link}><${CopyCommand} text=${one.text} /></li>`)}
        ${open.slice(0, MAX).map((one) => html`<li key=${one.id} class="alarm"><${Badge} word=${one.severity} tone=${isNow(one.time, now) ? "deny" : ""} />
          <${Link} to=${`/console/audit/${one.id}`} class="alarm-text"><${Given} value=${one.event} />: <${Given} value=${one.reason || one.resource} most=${160} /></${Link}><span class="muted small nowrap"><${Moment} at=${one.time} /></span></li>`)}
        ${open.length > MAX && html`<li class="alarm"><${Link} to="/console/audit?severity=alarm&since=1d">${open.length - MAX} more in the last day</${Link}></li>`}</ul>`}</section>`;
}

/** An alarm's text with the names of its hosts; a command at its end stays as it can be typed. */
function Told(/** @type {{text: string}} */ { text }) {
  const at = text.indexOf(": rosrv ");
  return html`<${Sentence} value=${at < 0 ? text : text.slice(0, at)} most=${300} />${at >= 0 && html`<${Given} value=${text.slice(at)} most=${200} />`}`;
}

/** The ids, and no sequence number: another log at this address, such as that of a new state, begins again at 1. */
function reviewed() {
  try {
    const ids = JSON.parse(stored(SEEN) ?? "[]");
    return new Set(Array.isArray(ids) ? ids : []);
  } catch {
    return new Set();
  }
}
