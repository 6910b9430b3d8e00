/** A held call in words, and the approvals that its buttons offer. */

import { html } from "#console/html.js";
import { Given } from "#console/parts/given.js";

export const TIMES = [30, 300]; // seconds
const SHOWN = 160; // characters; the number of bytes tells that the arguments have more

/** What a held call does, with its arguments. @param {any} one */
export function wants(one) {
  const size = one.size > SHOWN && html` of ${one.size} bytes`;
  const call = one.sha256 === "withheld" ? `${one.type} with ${one.size} bytes of arguments, which viewers do not see` : one.sha256 ? html`<${Given} value=${`${one.type} ${printable(one.arguments)}`} mono most=${SHOWN} />${size}` : "with any arguments";
  return html`${one.category} <${Given} value=${one.resource} mono most=${80} />${one.category === "call" && html`<div class="muted small">${call}</div>`}`;
}

/** Return the text in the arguments of a call, and a point for every other byte. @param {string} hex */
function printable(hex) {
  const codes = (hex.match(/../g) ?? []).map((byte) => parseInt(byte, 16));
  return codes.length ? String.fromCharCode(...codes.map((code) => (code > 31 && code < 127 ? code : 0xb7))) : "without arguments";
}
