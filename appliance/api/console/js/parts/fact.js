/** One fact of the situation: its name, what holds now, and the page about it. While the page gets no news, it has its age. */

import { html } from "../html.js";
import { lasting } from "../moments.js";
import { Link } from "../router.js";
import { useAge } from "../standing.js";

/** @param {{name: string, to: string, show?: string, tone?: "allow" | "warn" | "deny" | "", children?: any}} given `show`: the id of the part of this page that it is about */
export function Fact({ name, to, show = "", tone = "", children }) {
  const { age, old } = useAge();
  return html`<${Link} to=${to} onClick=${() => document.getElementById(show)?.scrollIntoView()} class=${`fact ${old ? "old" : tone}`}><span class="fact-name">${name}${old && html`, <span class="nowrap">${lasting(age)} ago</span>`}</span><span class="fact-text">${children}</span></${Link}>`;
}
