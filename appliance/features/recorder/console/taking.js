/** Actions on a recording: download its messages, export evidence, remove it. */

import { html, useEffect, useState } from "#console/html.js";
import { take } from "#console/audit/proof.js";
import { isDenial } from "#console/audit/rows.js";
import { iso, Moment } from "#console/moments.js";
import { attempt } from "#console/parts/attempt.js";
import { Button } from "#console/parts/button.js";
import { Dialog } from "#console/parts/dialog.js";
import { Icon } from "#console/parts/icon.js";
import { done } from "#console/parts/toast.js";
import { ask, get, queryText } from "#console/rest.js";
import { Link } from "#console/router.js";
import { fileName, may } from "#console/session.js";

/** @param {{row: any, small?: boolean}} given `row`: as `/v1/recordings` has it */
export function Taking({ row, small = false }) {
  const path = `/v1/recordings/${encodeURIComponent(row.id)}`;
  const icon = !small && html`<${Icon} name="down" size=${16} />`;
  const reads = may("investigator");
  const evidence = reads ? `${path}/evidence` : `/v1/evidence${queryText({ since: iso(row.began), until: iso(row.ended) })}`;
  return html`<${Button} small=${small} role="investigator" title="For rosbag, rqt_bag, PlotJuggler; the audit log records the download" onClick=${() => take(`${path}/bag`, fileName("", `${row.id}.bag`))}>${icon}Bag</${Button}>
    <${Button} small=${small} role="investigator" title="For Foxglove; the audit log records the download" onClick=${() => take(`${path}/bag?format=mcap`, fileName("", `${row.id}.mcap`))}>${icon}MCAP</${Button}>
    <${Button} small=${small} role=${reads ? "investigator" : "operator"} aria-keyshortcuts=${small ? undefined : "e"} title=${`Everything in its period, with the policy and specifications in force, as a signed bundle${reads ? "" : "; without the messages, which are for investigators"}`} onClick=${() => take(evidence, fileName("evidence", `${row.id}.zip`))}>${icon}Evidence</${Button}>`;
}

/** @param {{row: any, small?: boolean, gone: () => void}} given `gone`: what follows when it is removed */
export function Remove({ row, small = false, gone }) {
  const [asking, setAsking] = useState(false);
  const remove = () => attempt(async () => {
    await ask("DELETE", `/v1/recordings/${encodeURIComponent(row.id)}`, { match: "*" });
    done("The recording is removed", "The audit log records it.");
    gone();
  }, () => setAsking(false));
  return html`<${Button} small=${small} role="admin" tone="danger" onClick=${() => setAsking(true)}>Remove</${Button}>
    ${asking && html`<${Dialog} title="Remove this recording?" close=${() => setAsking(false)} foot=${html`<button class="button" onClick=${() => setAsking(false)}>Keep it</button><${Button} role="admin" tone="danger" onClick=${remove}>Remove</${Button}>`}>
      <p>Its messages are deleted. The audit log keeps its hash and the events.</p></${Dialog}>`}`;
}

/** A link from an audit record to its place on a recording's time line, if there is one. @param {{record: any}} given */
export function OnTimeline({ record }) {
  const [found, setFound] = useState(/** @type {any} */ (null));
  const closed = record.event === "recording closed" ? String(record.detail.recording) : "";
  const asked = closed || isDenial(record) || record.category === "monitor" || ["warning", "alarm"].includes(record.severity);
  useEffect(() => {
    if (!asked) return undefined;
    const controller = new AbortController();
    const at = Date.parse(record.time) * 1e6;
    // While the recorder is off or does not answer, there is no time line to link to.
    get("/v1/recordings", {}, controller.signal).then(({ recordings, in_progress }) => setFound(recordings.find((/** @type {any} */ one) => (closed ? one.id === closed : one.began <= at && at <= one.ended)) ?? in_progress.find((/** @type {any} */ one) => one.id === record.detail.recording) ?? null), () => setFound(null));
    return () => controller.abort();
  }, [record.id, asked]);
  if (!found) return null;
  if (found.ends) return html`<p class="muted small">The messages around it are being recorded: the time line is there at <${Moment} at=${found.ends / 1e9} />, or later if more happens.</p>`;
  return html`<div class="row"><${Link} class="button" aria-keyshortcuts="r" to=${`/console/recordings/${found.id}${closed ? "" : `?record=${record.id}`}`}><${Icon} name="recordings" size=${16} />Time line</${Link}>${closed && html`<${Taking} row=${found} />`}
    <span class="muted small">The messages around it were recorded.</span></div>`;
}
