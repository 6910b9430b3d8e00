/** Notifications in a corner for a few seconds; errors stay until dismissed. */

import { html } from "../html.js";
import { headline } from "../problem.js";
import { createStore, useStore } from "../store.js";
import { Given } from "./given.js";
import { Icon } from "./icon.js";
import { Notice } from "./notice.js";

const SECONDS = 6;
const UNDO_SECONDS = 20; // the time to take an order back
const toasts = createStore(/** @type {{id: number, tone: any, title: string, text: string, undo?: () => Promise<any>}[]} */ ([]));
let number = 0;

/** @param {string} title @param {string} [text] @param {() => Promise<any>} [undo] sends the order that takes this one back */
export function done(title, text = "", undo) {
  const id = show("allow", title, text, undo);
  setTimeout(() => drop(id), (undo ? UNDO_SECONDS : SECONDS) * 1000);
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
    ${one.undo && html`<button class="button small" onClick=${() => takeBack(one.id, one.undo)}>Undo</button>`}<button class="button small plain" onClick=${() => drop(one.id)}><${Icon} name="close" size=${14} />Dismiss</button></${Notice}>`)}</div>`;
}

async function takeBack(/** @type {number} */ id, /** @type {any} */ undo) {
  drop(id);
  try {
    await undo();
  } catch (failure) {
    failed(failure);
  }
}

function show(/** @type {string} */ tone, /** @type {string} */ title, /** @type {string} */ text, /** @type {any} */ undo = undefined) {
  const id = (number += 1);
  toasts.set([...toasts.get().slice(-3), { id, tone, title, text, undo }]);
  return id;
}

function drop(/** @type {number} */ id) {
  toasts.set(toasts.get().filter((one) => one.id !== id));
}
