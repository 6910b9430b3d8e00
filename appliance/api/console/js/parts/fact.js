/** One fact of the situation: its name, what holds now, and the page about it. */

import { html } from "../html.js";
import { Link } from "../router.js";

/** @param {{name: string, to: string, tone?: "allow" | "warn" | "deny" | "", children?: any}} given */
export function Fact({ name, to, tone = "", children }) {
  return html`<${Link} to=${to} class=${`fact ${tone}`}><span class="fact-name">${name}</span><span class="fact-text">${children}</span></${Link}>`;
}
