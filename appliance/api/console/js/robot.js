/** Robot: what moves it, from the features that guard and drive it. */

import { html } from "./html.js";
import { FeatureParts } from "./parts/features.js";

export function RobotView() {
  return html`<div class="head"><h1>Robot</h1></div><div class="stack"><${FeatureParts} place="robot" /></div>`;
}
