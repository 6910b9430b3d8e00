/**
 * Make text from the network (names, headers, values) safe to display. Invisible characters, and characters that would
 * reorder their surroundings, become code points. Text that is too long is cut, with its length.
 */

// Controls, invisible and joining characters, directions (bidi), line separators, lone surrogates, tags, private use.
const UNSEEN = new RegExp(
  "[\\u0000-\\u001f\\u007f-\\u009f\\u00ad\\u034f\\u061c\\u115f\\u1160\\u17b4\\u17b5\\u180b-\\u180f\\u200b-\\u200f" +
  "\\u2028-\\u202f\\u205f-\\u206f\\u2800\\u3000\\u3164\\ufe00-\\ufe0f\\ufeff\\uffa0\\ufff0-\\uffff\\ue000-\\uf8ff" +
  "\\u{1d173}-\\u{1d17a}\\u{e0000}-\\u{e0fff}\\u{f0000}-\\u{10ffff}\\ud800-\\udfff]", "gu",
);

const TOLD = 600; // from this length on, a cut text shows its full length

/** @typedef {{text: string, unseen: boolean}} Piece */

/**
 * Return a text in pieces; an `unseen` piece replaces a character that cannot be displayed safely.
 * @param {unknown} value @param {number} [most] characters that are shown
 * @returns {Piece[]}
 */
export function pieces(value, most = 200) {
  const whole = String(value ?? "");
  const points = whole.length > most ? [...whole.slice(0, most * 2)] : null;
  const cut = points !== null && (points.length > most || whole.length > most * 2);
  const text = cut ? points.slice(0, most).join("") : whole;
  /** @type {Piece[]} */
  const found = [];
  let at = 0;
  for (const match of text.matchAll(UNSEEN)) {
    if (match.index > at) found.push({ text: text.slice(at, match.index), unseen: false });
    found.push({ text: codePoint(match[0]), unseen: true });
    at = match.index + match[0].length;
  }
  if (at < text.length) found.push({ text: text.slice(at), unseen: false });
  if (cut && whole.length < TOLD) found.push({ text: "…", unseen: false });
  else if (cut) found.push({ text: `… ${whole.length.toLocaleString("en")} characters`, unseen: true });
  return found;
}

/** Return the safe text as one plain string, for titles, labels and drawings. @param {unknown} value @param {number} [most] */
export function plain(value, most = 200) {
  return pieces(value, most).map((one) => (one.unseen ? `⟨${one.text}⟩` : one.text)).join("");
}

function codePoint(/** @type {string} */ character) {
  const names = { "\n": "LF", "\r": "CR", "\t": "TAB", "\0": "NUL", "\u001b": "ESC", "\u202e": "RLO", "\u200b": "ZWSP" };
  const code = /** @type {number} */ (character.codePointAt(0)).toString(16).toUpperCase().padStart(4, "0");
  return names[/** @type {keyof typeof names} */ (character)] ?? `U+${code}`;
}
