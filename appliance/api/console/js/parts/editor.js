/**
 * An editor with line numbers, colours and errors in place (CodeMirror).
 *
 * The editor lives in a shadow root. There its style sheets are constructed objects, which the page's content security
 * policy allows; style elements would be blocked. The editor is loaded on first use.
 */

import { html, useEffect, useRef, useState } from "../html.js";
import { OUTDATED } from "../outdated.js";
import { plain } from "../words.js";
import { policyLanguage, rvLanguage } from "./languages.js";
import { Failure } from "./notice.js";

const SOURCE = "/console/static/vendor/codemirror.js";

/**
 * The proposals at the end of `before`, the number of its characters that they replace, and the form of words that they are for.
 * @typedef {(before: string, after: string, asked: boolean) => Promise<{length: number, proposals: {word: string, kind: string}[], word: RegExp} | null>} Complete
 */

/**
 * @param {{label: string, value: string, change?: (text: string) => void, language: "policy" | "rv", findings?: any[],
 *   line?: {number: number, column?: number, count: number} | null, dry?: () => void, keys?: string, complete?: Complete, height?: string}} given
 * `keys`: the key that moves into the editor; Escape leaves it. Without `change`, the editor is read-only. A new `line.count` moves to that line.
 */
export function Editor({ label, value, change, language, findings = [], line = null, dry, keys, complete, height = "60vh" }) {
  const host = useRef(/** @type {HTMLElement | null} */ (null));
  const held = useRef(/** @type {any} */ (null));
  const newest = useRef({ change, dry, told: /** @type {Set<string>} */ (new Set()) });
  Object.assign(newest.current, { change, dry });
  const [ready, setReady] = useState(false);
  const [failed, setFailed] = useState(false);

  useEffect(() => {
    let gone = false;
    import(SOURCE).then((mirror) => {
      if (gone || !host.current) return;
      newest.current.told.add(value); // it is no news to the editor, even if the user types before the next effect
      const root = host.current.shadowRoot ?? host.current.attachShadow({ mode: "open" });
      held.current = { mirror, view: build(mirror, root, { label, value, language, height, writable: Boolean(change), complete, newest }) };
      setReady(true);
    }, () => setFailed(true));
    return () => {
      gone = true;
      held.current?.view.destroy();
      held.current = null;
    };
  }, [language, Boolean(change)]);

  useEffect(() => {
    const view = held.current?.view;
    if (!view) return;
    const { told } = newest.current;
    if (view.state.doc.toString() === value) told.clear();
    else if (!told.has(value)) {
      // Ignore the echo of an older edit that arrives while the user types.
      view.dispatch({ changes: { from: 0, to: view.state.doc.length, insert: value } });
      told.clear();
    }
  }, [value, ready]);

  useEffect(() => {
    if (!held.current) return;
    const { mirror, view } = held.current;
    view.dispatch(mirror.setDiagnostics(view.state, findings.map((one) => diagnostic(view.state, one))));
  }, [JSON.stringify(findings), ready]);

  useEffect(() => {
    if (!held.current || !line) return;
    const { mirror, view } = held.current;
    const row = view.state.doc.line(Math.min(Math.max(1, line.number), view.state.doc.lines));
    const at = Math.min(row.to, row.from + Math.max(0, (line.column ?? 1) - 1));
    view.dispatch({ selection: { anchor: at }, effects: mirror.EditorView.scrollIntoView(at, { y: "center" }) });
    if (line.count > 0) view.focus();
  }, [line?.number, line?.count, ready]);

  if (failed) return html`<${Failure} error=${OUTDATED} retry=${() => location.reload()} />`;
  return html`<div class="editor" ref=${host} data-editor=${language} aria-keyshortcuts=${keys} data-ready=${String(ready)}></div>`;
}

function build(/** @type {any} */ mirror, /** @type {ShadowRoot} */ root, /** @type {any} */ { label, value, language, height, writable, complete, newest }) {
  const { EditorView, EditorState, keymap } = mirror;
  const dry = () => (newest.current.dry?.(), true);
  return new EditorView({
    parent: root, root,
    state: EditorState.create({
      doc: value,
      extensions: [
        ...(complete ? completion(mirror, complete) : []),
        mirror.lineNumbers(), mirror.lintGutter(), mirror.highlightActiveLine(), mirror.highlightActiveLineGutter(),
        mirror.history(), mirror.highlightSpecialChars(), mirror.search({ top: true }), mirror.highlightSelectionMatches(),
        keymap.of([{ key: "Mod-s", run: dry, preventDefault: true }, ...mirror.searchKeymap, ...mirror.historyKeymap, ...mirror.defaultKeymap, { key: "Escape", run: leave }]),
        mirror.StreamLanguage.define(language === "policy" ? policyLanguage : rvLanguage),
        mirror.syntaxHighlighting(colours(mirror)), look(EditorView, height),
        EditorState.readOnly.of(!writable), EditorView.contentAttributes.of({ "aria-label": label, "aria-readonly": String(!writable), tabindex: "0" }),
        EditorView.domEventHandlers({ beforeinput: typedOver }),
        EditorView.updateListener.of((/** @type {any} */ update) => update.docChanged && tell(newest.current, update.state.doc.toString())),
      ],
    }),
  });
}

/**
 * Complete while typing, or on Ctrl Space. No proposal is selected at first: Enter ends the line, and only a proposal
 * that was chosen with the arrows changes the text. Escape closes the list; without a list it leaves the editor, also
 * while proposals are awaited. A longer word narrows the list at once: a list that is fetched again would lose the choice
 * and the keys of that time.
 */
function completion(/** @type {any} */ mirror, /** @type {Complete} */ complete) {
  const source = async (/** @type {any} */ { pos, state, explicit }) => {
    const found = await complete(state.sliceDoc(0, pos), state.sliceDoc(pos), explicit);
    return found && { from: pos - found.length, options: found.proposals.map(({ word, kind }) => ({ label: word, detail: kind })), validFor: found.word };
  };
  const escape = (/** @type {any} */ view) => {
    const listed = mirror.currentCompletions(view.state).length > 0;
    mirror.closeCompletion(view);
    return listed;
  };
  const keys = mirror.completionKeymap.map((/** @type {any} */ one) => (one.key === "Escape" ? { ...one, run: escape } : one));
  return [mirror.autocompletion({ override: [source], defaultKeymap: false, selectOnOpen: false, interactionDelay: 0, icons: false }), mirror.keymap.of(keys)];
}

/** Leave the editor, so that Tab and the keys of the view work again. */
function leave(/** @type {any} */ view) {
  view.contentDOM.blur();
  return true;
}

function tell(/** @type {any} */ reader, /** @type {string} */ text) {
  reader.told.add(text);
  reader.change?.(text);
}

/**
 * Insert text over a selection here. The browser would first merge the lines in the page and add style attributes,
 * which the content security policy forbids.
 */
function typedOver(/** @type {InputEvent} */ event, /** @type {any} */ view) {
  if (event.inputType !== "insertText" || event.data === null || view.state.selection.main.empty || view.state.readOnly) return false;
  event.preventDefault();
  view.dispatch(view.state.update(view.state.replaceSelection(event.data), { userEvent: "input.type", scrollIntoView: true }));
  return true;
}

function diagnostic(/** @type {any} */ state, /** @type {any} */ finding) {
  const row = state.doc.line(Math.min(Math.max(1, finding.line), state.doc.lines));
  const from = Math.min(row.to, row.from + Math.max(0, finding.column - 1));
  const word = /^[^\s=,]+/.exec(state.sliceDoc(from, row.to));
  return { from, to: Math.max(from, from + (word?.[0].length ?? 0)), severity: finding.severity === "error" ? "error" : "warning", message: plain(finding.text, 600) };
}

function colours(/** @type {any} */ { HighlightStyle, tags }) {
  return HighlightStyle.define([
    { tag: tags.comment, color: "var(--code-comment)" },
    { tag: tags.heading, color: "var(--code-section)", fontWeight: "600" },
    { tag: tags.propertyName, color: "var(--code-key)" },
    { tag: tags.keyword, color: "var(--code-section)" },
    { tag: tags.string, color: "var(--code-string)" },
    { tag: tags.number, color: "var(--code-number)" },
    { tag: tags.typeName, color: "var(--code-string)" },
  ]);
}

function look(/** @type {any} */ EditorView, /** @type {string} */ height) {
  return EditorView.theme({
    "&": { height, fontSize: "12.5px", color: "var(--text)", backgroundColor: "var(--surface)" },
    "&.cm-focused": { outline: "none" },
    ".cm-scroller": { fontFamily: "var(--mono)", fontVariantLigatures: "none", lineHeight: "1.6", overflow: "auto" },
    ".cm-content": { caretColor: "var(--text)", padding: "8px 0" },
    ".cm-gutters": { backgroundColor: "var(--sunken)", color: "var(--muted)", border: "none", borderRight: "1px solid var(--line)" },
    ".cm-activeLine": { backgroundColor: "color-mix(in srgb, var(--chosen) 55%, transparent)" },
    ".cm-activeLineGutter": { backgroundColor: "var(--chosen)", color: "var(--text)" },
    ".cm-selectionBackground, &.cm-focused .cm-selectionBackground, ::selection": { backgroundColor: "var(--chosen) !important" },
    ".cm-cursor": { borderLeftColor: "var(--text)" },
    ".cm-tooltip": { backgroundColor: "var(--surface)", border: "1px solid var(--line-strong)", borderRadius: "5px", color: "var(--text)", maxWidth: "560px" },
    ".cm-tooltip-autocomplete ul": { fontFamily: "var(--mono) !important", maxHeight: "15em" },
    ".cm-tooltip-autocomplete ul li": { display: "flex", gap: "16px", justifyContent: "space-between", padding: "3px 10px !important" },
    ".cm-tooltip-autocomplete ul li[aria-selected]": { background: "var(--accent-fill) !important", color: "var(--on-accent) !important" },
    ".cm-completionMatchedText": { textDecoration: "none", fontWeight: "700" },
    ".cm-completionDetail": { fontFamily: "var(--sans)", fontStyle: "normal", color: "var(--muted)", margin: "0" },
    "li[aria-selected] .cm-completionDetail": { color: "inherit" },
    ".cm-diagnostic": { fontFamily: "var(--sans)", fontSize: "13px", padding: "6px 10px", whiteSpace: "pre-wrap" },
    ".cm-diagnostic-error": { borderLeft: "3px solid var(--deny)" },
    ".cm-diagnostic-warning": { borderLeft: "3px solid var(--warn)" },
    ".cm-lintRange-error": { backgroundImage: "none", textDecoration: "underline wavy var(--deny)", textUnderlineOffset: "3px" },
    ".cm-lintRange-warning": { backgroundImage: "none", textDecoration: "underline wavy var(--warn)", textUnderlineOffset: "3px" },
    ".cm-lint-marker": { width: "10px", height: "10px", content: "none", borderRadius: "50%", margin: "5px 0 0 2px" },
    ".cm-lint-marker-error": { backgroundColor: "var(--deny)" },
    ".cm-lint-marker-warning": { backgroundColor: "var(--warn)" },
    ".cm-panels": { backgroundColor: "var(--sunken)", color: "var(--text)", borderBottom: "1px solid var(--line)" },
    ".cm-textfield": { backgroundColor: "var(--surface)", border: "1px solid var(--line-strong)", color: "var(--text)" },
    ".cm-button": { backgroundImage: "none", backgroundColor: "var(--surface)", border: "1px solid var(--line-strong)", color: "var(--text)" },
    ".cm-searchMatch": { backgroundColor: "var(--warn-soft)" },
    ".cm-specialChar": { color: "var(--deny)" },
  });
}
