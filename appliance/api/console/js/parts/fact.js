/** One fact of the situation: its name, what holds now, and the page about it. While the page gets no news, it has its age. */

import { since } from "../elapsed.js";
import { html } from "../html.js";
import { lasting } from "../moments.js";
import { Link } from "../router.js";
import { useAge } from "../standing.js";

/** @param {{name: string, to: string, show?: string, tone?: "allow" | "warn" | "deny" | "", failed?: import("../elapsed.js").Mark | null | false, children?: any}} given `show`: the id of the part of this page that it is about; `failed`: when its value came, if a later request for it failed */
export function Fact({ name, to, show = "", tone = "", failed, children }) {
  const live = useAge();
  const old = live.old || Boolean(failed);
  const age = failed ? Math.max(live.old ? live.age : 0, since(failed) / 1000) : live.age;
  return html`<${Link} to=${to} onClick=${() => document.getElementById(show)?.scrollIntoView()} class=${`fact ${old ? "old" : tone}`}><span class="fact-name">${name}${old && html`, <span class="nowrap">${lasting(age)} ago</span>`}</span><span class="fact-text">${children}</span></${Link}>`;
}
