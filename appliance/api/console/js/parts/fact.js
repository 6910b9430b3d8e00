/** One fact of the situation: its name, what holds now, and the page about it. While the page gets no news, it has its age. */

import { html } from "../html.js";
import { lasting } from "../moments.js";
import { Link } from "../router.js";
import { useAge } from "../standing.js";

/** @param {{name: string, to: string, tone?: "allow" | "warn" | "deny" | "", children?: any}} given */
export function Fact({ name, to, tone = "", children }) {
  const { age, old } = useAge();
  return html`<${Link} to=${to} class=${`fact ${old ? "old" : tone}`}><span class="fact-name">${name}${old && `, ${lasting(age)} ago`}</span><span class="fact-text">${children}</span></${Link}>`;
}
