/** The differences between two texts, line by line with context. */

import { html } from "../html.js";
import { plain } from "../words.js";

const AROUND = 3;
const MAX = 4000; // lines between the first and the last difference in which equal lines are looked for
const WIDE = 400; // characters of a line; of a longer one that differs, what differs is shown
const BESIDE = 40; // characters around what differs

/** @typedef {{kind: "same" | "added" | "removed", text: string, old: number | null, now: number | null}} DiffLine */

/** @param {{old: string, now: string, same: string}} given `same`: the text for equal texts */
export function Difference({ old, now, same }) {
  const lines = cut(difference(old, now));
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
  return html`<div class=${`diff-line ${line.kind}`}><span class="n">${line.old ?? ""}</span><span class="n">${line.now ?? ""}</span><span class="sign" aria-hidden="true">${sign}</span><span>${word && html`<span class="sr-only">${word}</span>`}${plain(line.text, line.kind === "same" ? WIDE : Infinity)}</span></div>`;
}

/** @param {string} old @param {string} now @returns {DiffLine[]} */
export function difference(old, now) {
  const a = old.split("\n");
  const b = now.split("\n");
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

/** Cut long lines to what differs from the line that they replace. @param {DiffLine[]} lines @returns {DiffLine[]} */
function cut(lines) {
  /** @type {DiffLine[]} */
  const found = [];
  for (let at = 0; at < lines.length; ) {
    const first = at;
    while (at < lines.length && lines[at].kind !== "same") at += 1;
    const texts = { removed: /** @type {string[]} */ ([]), added: /** @type {string[]} */ ([]) };
    for (const { kind, text } of lines.slice(first, at)) texts[/** @type {"removed" | "added"} */ (kind)].push(text);
    const next = { removed: 0, added: 0 };
    for (const line of lines.slice(first, at)) {
      const kind = /** @type {"removed" | "added"} */ (line.kind);
      const other = texts[kind === "added" ? "removed" : "added"][next[kind]++];
      found.push({ ...line, text: line.text.length > WIDE && other !== undefined ? differing(line.text, other) : line.text });
    }
    if (at < lines.length) found.push(lines[at++]);
  }
  return found;
}

function differing(/** @type {string} */ text, /** @type {string} */ other) {
  const least = Math.min(text.length, other.length);
  let head = 0;
  while (head < least && text[head] === other[head]) head += 1;
  let tail = 0;
  while (tail < least - head && text[text.length - 1 - tail] === other[other.length - 1 - tail]) tail += 1;
  const from = Math.max(0, head - BESIDE);
  const to = Math.min(text.length, text.length - tail + BESIDE);
  return `${from ? "… " : ""}${text.slice(from, to)}${to < text.length ? " …" : ""}`;
}

/** The difference by longest common subsequence; if the texts are too long for it, all of both. */
function walked(/** @type {string[]} */ a, /** @type {string[]} */ b, /** @type {number} */ head) {
  if (a.length > MAX || b.length > MAX) {
    return [
      ...a.map((text, i) => /** @type {DiffLine} */ ({ kind: "removed", text, old: head + i + 1, now: null })),
      ...b.map((text, j) => /** @type {DiffLine} */ ({ kind: "added", text, old: null, now: head + j + 1 })),
    ];
  }
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
