/** How long ago something happened, by the appliance's clock: that of the browser may differ. */

import { html } from "../html.js";
import { applianceTime } from "../live.js";
import { dateOf, lasting, useSeconds } from "../moments.js";

/** The appliance's present time in seconds, once a second; null before it is known. */
export function useApplianceTime() {
  useSeconds();
  return applianceTime();
}

/** @param {{at: string | number, lasts?: boolean}} given `at`: RFC 3339, or seconds since the epoch; `lasts`: it goes on */
export function Ago({ at, lasts = false }) {
  const now = useApplianceTime();
  const date = dateOf(at);
  if (now === null) return html`<time datetime=${date.toISOString()}>…</time>`;
  return html`<time class="nowrap" datetime=${date.toISOString()} title=${`${date.toISOString().replace("T", " ").replace("Z", "")} UTC`}>${lasts && "for "}${lasting(now - date.getTime() / 1000)}${!lasts && " ago"}</time>`;
}
