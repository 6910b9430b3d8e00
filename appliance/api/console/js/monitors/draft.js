/** A draft of a specification, with dry run, load and findings. */

import { useEffect, useState } from "../html.js";
import { ask } from "../rest.js";
import { session } from "../session.js";
import { createStore, useStore } from "../store.js";

/** The edited texts by file, with the text that each started from, which are kept while another view is shown. */
const edited = createStore(/** @type {Record<string, {base: string, text: string} | undefined>} */ ({}));

session.subscribe(() => {
  const { current, locked } = session.get();
  if (!current && !locked) edited.set({});
});

/** `stale`: another text came into force after the edited one was begun. @param {string} first the text in force @param {string} [file] none for a new one */
export function useSpecification(first, file = "") {
  const { base, text } = useStore(edited, (one) => one[file]) ?? { base: first, text: first };
  const [state, setState] = useState({ findings: /** @type {any[]} */ ([]), report: /** @type {any} */ (null), error: /** @type {any} */ (null) });
  const write = (/** @type {string} */ next) => {
    if (next === text) return;
    edited.update({ [file]: next === first ? undefined : { base, text: next } });
    setState((state) => ({ ...state, report: null }));
  };
  useEffect(() => {
    if (text === first) edited.update({ [file]: undefined }); // it was loaded
  }, [text === first]);
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
  return { text, stale: text !== first && base !== first, write, send, ...state };
}
