/** The tab's title and icon: they call a person back to a page that waits for them. */

import { ROBOT } from "./session.js";

const ICONS = { calm: "/console/static/icon.svg", calls: "/console/static/icon-calls.svg" };

let view = "";
let calls = "";

/** Name the page, first by what waits and by the robot. @param {string} title */
export function entitle(title) {
  view = title;
  show();
}

/** Call for a person with these words; empty: nothing waits any longer. @param {string} words */
export function callFor(words) {
  if (calls === words) return;
  calls = words;
  show();
  document.querySelector('link[rel="icon"]')?.setAttribute("href", calls ? ICONS.calls : ICONS.calm);
}

function show() {
  document.title = [calls, ROBOT, view, "ROSRV"].filter(Boolean).join(" · ");
}
