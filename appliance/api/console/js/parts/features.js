/** The components that features add to a place of a page, in their order. */

import { PARTS } from "../features.js";
import { html } from "../html.js";

/** @param {{place: "banner" | "situation" | "now" | "record" | "robot" | "standby", [given: string]: any}} given what else is given goes to each component */
export function FeatureParts({ place, ...given }) {
  return PARTS.filter((one) => one.place === place).map(({ Part }, index) => html`<${Part} key=${index} ...${given} />`);
}
