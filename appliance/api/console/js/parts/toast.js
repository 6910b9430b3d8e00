/** Notifications in a corner for a few seconds; errors stay until dismissed. */

import { html } from "../html.js";
import { headline } from "../problem.js";
import { createStore, useStore } from "../store.js";
import { Given } from "./given.js";
import { Icon } from "./icon.js";
import { Notice } from "./notice.js";

const SECONDS = 6;
const toasts = createStore(/** @type {{id: number, tone: any, title: string, text: string}[]} */ ([]));
let number = 0;

/** @param {string} title @param {string} [text] */
export function done(title, text = "") {
  const id = show("allow", title, text);
  setTimeout(() => drop(id), SECONDS * 1000);
}

/** @param {unknown} error */
export function failed(error) {
  show("deny", headline(error), error instanceof Error ? error.message : String(error));
}

export function clearToasts() {
  toasts.set([]);
}

export function Toasts() {
  const shown = useStore(toasts);
  return html`<div class="toasts" role="status" aria-live="polite">${shown.map((one) => html`<${Notice} key=${one.id} tone=${one.tone}
    title=${html`<div class="row"><span>${one.title}</span></div>`}>${one.text && html`<${Given} value=${one.text} most=${500} />`}
    <button class="button small plain" onClick=${() => drop(one.id)}><${Icon} name="close" size=${14} />Dismiss</button></${Notice}>`)}</div>`;
}

function show(/** @type {string} */ tone, /** @type {string} */ title, /** @type {string} */ text) {
  const id = (number += 1);
  toasts.set([...toasts.get().slice(-3), { id, tone, title, text }]);
  return id;
}

function drop(/** @type {number} */ id) {
  toasts.set(toasts.get().filter((one) => one.id !== id));
}
