/** A form field with its label above, and the hint or error below. */

import { html, useId } from "../html.js";

/** @param {{label: string, hint?: any, type?: string, value: any, set: (value: string) => void, options?: [string, string, ...string[]][], rows?: number, mono?: boolean, [more: string]: any}} given */
export function Field({ label, hint, type = "text", value, set, options, rows, mono = false, ...more }) {
  const id = useId();
  const common = {
    id, value, class: `input${mono ? " mono" : ""}`, "aria-describedby": hint ? `${id}-hint` : undefined,
    onInput: (/** @type {any} */ event) => set(event.target.value), ...more,
  };
  let control;
  if (options) control = html`<select ...${common}>${options.map(([word, shown]) => html`<option value=${word} selected=${word === value}>${shown}</option>`)}</select>`;
  else if (rows) control = html`<textarea rows=${rows} spellcheck="false" ...${common}></textarea>`;
  else control = html`<input type=${type} autocomplete="off" spellcheck="false" ...${common} />`;
  return html`<div class="field"><label for=${id}>${label}</label>${control}${hint && html`<span class="hint" id=${`${id}-hint`}>${hint}</span>`}</div>`;
}

/** @param {{label: string, on: boolean, set: (on: boolean) => void}} given */
export function Check({ label, on, set }) {
  const id = useId();
  return html`<div class="check"><input id=${id} type="checkbox" checked=${on} onChange=${(/** @type {any} */ event) => set(event.target.checked)} />
    <label for=${id}>${label}</label></div>`;
}
