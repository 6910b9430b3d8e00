/** The current view, from the page's URL; every state worth returning to has a URL. */

import { html } from "./html.js";
import { createStore } from "./store.js";

/** @typedef {{view: string, rest: string, query: URLSearchParams}} Place */

export const place = createStore(read());

addEventListener("popstate", () => place.set(read()));

/** @param {string} path @param {{replace?: boolean}} [options] */
export function go(path, { replace = false } = {}) {
  if (path === location.pathname + location.search) return;
  history[replace ? "replaceState" : "pushState"](null, "", path);
  place.set(read());
}

/** A link within the console. */
export function Link(/** @type {any} */ { to, children, onClick, ...more }) {
  const follow = (/** @type {MouseEvent} */ event) => {
    if (event.metaKey || event.ctrlKey || event.shiftKey || event.button) return;
    event.preventDefault();
    go(to);
    onClick?.();
  };
  return html`<a href=${to} onClick=${follow} ...${more}>${children}</a>`;
}

/** @returns {Place} */
function read() {
  const [, , view, ...rest] = location.pathname.split("/");
  return {
    view: view || "now",
    rest: decoded(rest.join("/")),
    query: new URLSearchParams(location.search),
  };
}

function decoded(/** @type {string} */ text) {
  try {
    return decodeURIComponent(text);
  } catch {
    return text;
  }
}
