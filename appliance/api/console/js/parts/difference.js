/** The differences between two texts, line by line with context. */

import { html } from "../html.js";
import { plain } from "../words.js";

const AROUND = 3;
const MAX = 4000; // lines of a text to compare

/** @typedef {{kind: "same" | "added" | "removed", text: string, old: number | null, now: number | null}} DiffLine */

/** @param {{old: string, now: string, same: string}} given `same`: the text for equal texts */
export function Difference({ old, now, same }) {
  const lines = difference(old, now);
  if (lines.every((one) => one.kind === "same")) return html`<p class="muted">${same}</p>`;
  const near = lines.map((_, index) => lines.slice(Math.max(0, index - AROUND), index + AROUND + 1).some((one) => one.kind !== "same"));
  const shown = [];
  for (let index = 0; index < lines.length; index += 1) {
    if (near[index]) shown.push(html`<${Line} key=${index} line=${lines[index]} />`);
    else if (index === 0 || near[index - 1]) {
      const next = near.indexOf(true, index);
      const left = (next < 0 ? lines.length : next) - index;
      shown.push(html`<div key=${index} class="diff-skip">${left} ${left === 1 ? "line" : "lines"} the same</div>`);
    }
  }
  return html`<div class="diff" tabindex="0" role="region" aria-label="Differences">${shown}</div>`;
}

/** The lines of a unified diff. @param {{lines: string[]}} given */
export function UnifiedDiff({ lines }) {
  const kinds = /** @type {Record<string, DiffLine["kind"]>} */ ({ "+": "added", "-": "removed", " ": "same" });
  const shown = lines.filter((one) => one[0] in kinds && !/^(\+\+\+|---) /.test(one));
  return html`<div class="diff" tabindex="0" role="region" aria-label="Differences">${shown.map((one, index) => html`<${Line} key=${index} line=${{ kind: kinds[one[0]], text: one.slice(1), old: null, now: null }} />`)}</div>`;
}

function Line(/** @type {{line: DiffLine}} */ { line }) {
  const sign = { same: " ", added: "+", removed: "−" }[line.kind];
  const word = { same: "", added: "added: ", removed: "removed: " }[line.kind];
  return html`<div class=${`diff-line ${line.kind}`}><span class="n">${line.old ?? ""}</span><span class="n">${line.now ?? ""}</span><span class="sign" aria-hidden="true">${sign}</span><span>${word && html`<span class="sr-only">${word}</span>`}${plain(line.text, 400)}</span></div>`;
}

/** @param {string} old @param {string} now @returns {DiffLine[]} */
export function difference(old, now) {
  const a = old.split("\n").slice(0, MAX);
  const b = now.split("\n").slice(0, MAX);
  let head = 0;
  while (head < a.length && head < b.length && a[head] === b[head]) head += 1;
  let tail = 0;
  while (tail < a.length - head && tail < b.length - head && a[a.length - 1 - tail] === b[b.length - 1 - tail]) tail += 1;
  const middle = walked(a.slice(head, a.length - tail), b.slice(head, b.length - tail), head);
  const same = (/** @type {number} */ i, /** @type {number} */ j) => /** @type {DiffLine} */ ({ kind: "same", text: a[i], old: i + 1, now: j + 1 });
  return [
    ...a.slice(0, head).map((_, i) => same(i, i)), ...middle,
    ...a.slice(a.length - tail).map((_, i) => same(a.length - tail + i, b.length - tail + i)),
  ];
}

/** The difference by longest common subsequence. */
function walked(/** @type {string[]} */ a, /** @type {string[]} */ b, /** @type {number} */ head) {
  const width = b.length + 1;
  const best = new Uint16Array((a.length + 1) * width);
  for (let i = a.length - 1; i >= 0; i -= 1)
    for (let j = b.length - 1; j >= 0; j -= 1) best[i * width + j] = a[i] === b[j] ? best[(i + 1) * width + j + 1] + 1 : Math.max(best[(i + 1) * width + j], best[i * width + j + 1]);
  /** @type {DiffLine[]} */
  const found = [];
  let [i, j] = [0, 0];
  while (i < a.length || j < b.length) {
    if (i < a.length && j < b.length && a[i] === b[j]) found.push({ kind: "same", text: a[i], old: head + (i += 1), now: head + (j += 1) });
    else if (i < a.length && (j >= b.length || best[(i + 1) * width + j] >= best[i * width + j + 1])) found.push({ kind: "removed", text: a[i], old: head + (i += 1), now: null });
    else found.push({ kind: "added", text: b[j], old: null, now: head + (j += 1) });
  }
  return found;
}
