/** A rule of the policy by section and key, with a link to its line. */

import { html } from "../html.js";
import { Link } from "../router.js";
import { Given } from "./given.js";

/** @param {{rule: {section: string, key: string, file: string, line: number} | null, revision?: number | null, keys?: string}} given `keys`: the key that follows the link */
export function Rule({ rule, revision, keys }) {
  if (!rule) return html`<span class="muted">no rule of the policy</span>`;
  const at = `/console/policy?line=${rule.line}${revision ? `&revision=${revision}` : ""}`;
  return html`<span><code>[<${Given} value=${rule.section} />] <${Given} value=${rule.key} most=${80} /></code>${" "}
    <${Link} to=${at} class="nowrap" data-rule-line=${rule.line} aria-keyshortcuts=${keys} title=${`${rule.file}, line ${rule.line}`}>line ${rule.line}</${Link}></span>`;
}
