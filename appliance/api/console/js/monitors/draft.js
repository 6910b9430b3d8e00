/** A draft of a specification, with dry run, load and findings. */

import { useState } from "../html.js";
import { ask } from "../rest.js";

/** @param {string} first the text it begins with */
export function useSpecification(first) {
  const [text, setText] = useState(first);
  const [state, setState] = useState({ findings: /** @type {any[]} */ ([]), report: /** @type {any} */ (null), error: /** @type {any} */ (null) });
  const write = (/** @type {string} */ next) => {
    if (next === text) return;
    setText(next);
    setState((state) => ({ ...state, report: null }));
  };
  /** @param {Record<string, string>} files @param {{dry: boolean, note?: string, match?: string, definitions?: Record<string, string>, signatures?: Record<string, string>, hold?: boolean}} how */
  const send = async (files, { dry, note = "", match, definitions = {}, signatures = {}, hold = false }) => {
    try {
      const { body } = await ask("POST", "/v1/monitors", { query: { dry_run: dry ? 1 : null, hold: hold ? 1 : null }, json: { files, definitions, note, signatures }, match });
      setState({ findings: body.warnings, report: body, error: null });
      return body;
    } catch (error) {
      setState({ findings: /** @type {any} */ (error).findings ?? [], report: null, error });
      return null;
    }
  };
  return { text, write, send, ...state };
}
