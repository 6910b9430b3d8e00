/** The situation: who drives, what stops the robot, what waits, what was denied. Each fact is one line. */

import { byHostAndKind, grouped, othersOf, shownOf } from "../audit/rows.js";
import { html } from "../html.js";
import { isHeld, isSelftest } from "../graph/model.js";
import { isNow } from "../moments.js";
import { notable } from "../notable.js";
import { Ago, useApplianceTime } from "../parts/ago.js";
import { requested } from "../parts/badge.js";
import { Fact } from "../parts/fact.js";
import { FeatureParts } from "../parts/features.js";
import { Given } from "../parts/given.js";
import { Host } from "../parts/host.js";
import { useStore } from "../store.js";

export function Situation() {
  return html`<section class="situation" aria-label="Situation"><${FeatureParts} place="situation" /><${Denied} /></section>`;
}

function Denied() {
  const { denials, missing, heard } = useStore(notable);
  const now = useApplianceTime();
  const [row] = byHostAndKind(grouped((denials ?? []).filter((one) => !isSelftest(one) && !isHeld(one))));
  if (!row) return html`<${Fact} name="Denied" failed=${heard} to="/console/audit?decision=deny&since=1d">${denials ? "nothing in the last day" : missing ? "not known" : "…"}</${Fact}>`;
  const one = shownOf(row);
  const others = othersOf(row);
  return html`<${Fact} name="Denied" failed=${heard} to=${`/console/audit/${one.id}`} tone=${isNow(row.last.time, now) ? "deny" : ""}><${Host} value=${one.host} none="no address" /> <span class="muted">${requested(one)}</span> <${Given} value=${one.resource || one.event} most=${60} mono />${others > 0 && html` <span class="muted">and ${others} more</span>`}, <${Ago} at=${row.last.time} /></${Fact}>`;
}
