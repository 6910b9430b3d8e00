/** Syntax highlighting of policies and specifications. */

const PLAIN_KEY = /^(default|read|write|range|topic|service|takeover|audit-only|tell)\b/;

/** The access policy (INI): sections, keys, values. */
export const policyLanguage = {
  name: "policy",
  startState: () => ({ value: false }),
  token(/** @type {any} */ stream, /** @type {any} */ state) {
    if (stream.sol()) state.value = false;
    if (stream.eatSpace()) return null;
    if (stream.match(/^[#;].*/)) return "comment";
    if (!state.value) {
      if (stream.match(/^\[[^\]]*\]?/)) return "heading";
      if (stream.match("=")) {
        state.value = true;
        return "operator";
      }
      if (stream.match(PLAIN_KEY)) return "keyword";
      if (stream.match(/^[^\s=#;]+/)) return "propertyName";
    }
    if (stream.match(/^\*+/)) return "keyword";
    if (stream.match(/^host:[^\s,#;]+/)) return "string";
    if (stream.match(/^[0-9a-fA-F:.]+(\/[0-9]+)?(?=[\s,#;]|$)/)) return "number";
    if (stream.match(/^[^\s,#;]+/)) return "variableName";
    stream.next();
    return null;
  },
};

const KEYWORDS = new Set("event when every service request response init return if else for while do switch case default break continue const true false MESSAGE PUBLISH DROP STOP safe withhold on given topic preset as role in order hold unsynchronized fsm ere ltl ptltl cfg tfsm mtl pattern alias ptcaret srs new sizeof".split(" "));
const TYPES = /^(bool|u?int(8|16|32|64)?(_t)?|float|double|char|string|void|auto|std::\w+|ros::\w+|\w+(::|\/)\w+)$/;

/** Specifications of monitors (.rv). */
export const rvLanguage = {
  name: "rv",
  startState: () => ({ comment: false }),
  token(/** @type {any} */ stream, /** @type {any} */ state) {
    if (state.comment) {
      state.comment = !stream.match(/.*?\*\//);
      if (state.comment) stream.skipToEnd();
      return "comment";
    }
    if (stream.eatSpace()) return null;
    if (stream.match("//") || (stream.sol() && stream.match("#"))) {
      stream.skipToEnd();
      return "comment";
    }
    if (stream.match("/*")) {
      state.comment = true;
      return "comment";
    }
    if (stream.match(/^"([^"\\]|\\.)*"?/)) return "string";
    if (stream.match(/^@\s*\w+/)) return "heading";
    if (stream.match(/^__RESET\b/)) return "keyword";
    if (stream.match(/^\d[\d.]*(e[+-]?\d+)?(ms|us|s|m|h)?\b/)) return "number";
    if (stream.match(/^\/[A-Za-z][\w/]*/)) return "propertyName";
    if (stream.match(/^[A-Za-z_]\w*((::|\/)[A-Za-z_]\w*)?/)) {
      const word = stream.current();
      return KEYWORDS.has(word) ? "keyword" : TYPES.test(word) ? "typeName" : "variableName";
    }
    stream.next();
    return null;
  },
};
