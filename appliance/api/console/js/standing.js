/** Shows whether the page is live: a word beside the navigation, and a banner if it is not. */

import { html } from "./html.js";
import { ageOf, live, retry } from "./live.js";
import { lasting, useSeconds } from "./moments.js";
import { notable } from "./notable.js";
import { Given } from "./parts/given.js";
import { Icon } from "./parts/icon.js";
import { useStore } from "./store.js";

/** The age of what is shown, once a second. */
export function useAge() {
  useSeconds();
  return ageOf(live.get());
}

export function Pulse() {
  const standing = useStore(live, (one) => one.standing);
  const away = useStore(live, (one) => one.away);
  const heard = useStore(live, (one) => one.heard !== null);
  const { old } = useAge();
  const [kind, word] =
    standing.state === "live" && away ? ["wait", "RVMaster away"]
    : standing.state === "live" && old ? ["wait", "No news"]
    : standing.state === "live" && heard ? ["live", "Live"]
    : standing.state === "lost" ? ["lost", "Not live"]
    : ["wait", "Connecting"];
  return html`<div class="pulse" role="status" aria-label=${`Connection: ${word}`} data-standing=${kind}><span class=${`dot ${kind}`}></span><span class="pulse-text">${word}</span></div>`;
}

export function NotLive() {
  const { standing, away, heard } = useStore(live);
  const missing = useStore(notable, (one) => one.missing);
  const { age, old } = useAge();
  const since = heard ? `, as of ${lasting(age)} ago` : "";
  if (standing.state === "live" && away)
    return html`<div class="banner" role="status"><${Icon} name="warn" /><span><strong>RVMaster does not answer${since}.</strong> <${Given} value=${away} most=${300} /></span></div>`;
  if (standing.state === "live" && old)
    return html`<div class="banner" role="status"><${Icon} name="warn" /><span><strong>No news from the appliance for ${lasting(age)}.</strong> What is shown may be over.</span></div>`;
  if (standing.state === "live" && missing)
    return html`<div class="banner" role="status"><${Icon} name="warn" /><span><strong>New denials, alarms and actions do not come.</strong> <${Given} value=${missing} most=${300} /> Retrying automatically.</span></div>`;
  if (standing.state === "live" || !standing.reason) return null;
  const wait = standing.again ? Math.max(0, Math.ceil((standing.again - performance.now()) / 1000)) : 0;
  return html`<div class="banner" role="status"><${Icon} name="warn" />
    <span><strong>Not live${since}.</strong> <${Given} value=${standing.reason} most=${300} /> ${wait ? `Next try in ${wait} s.` : "Trying now."}</span>
    <button class="button small" onClick=${retry}>Try now</button></div>`;
}
