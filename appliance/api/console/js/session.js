/**
 * Who reads: the token, its role, its end.
 *
 * The token is in this page's memory, and in the tab's session storage if the reader wants it to outlive a reload. It
 * is never in a cookie (nothing is sent that a request of another page could carry) and never in an address.
 */

import { createStore } from "./store.js";

const KEY = "rosrv.token";
const RANK = { viewer: 1, operator: 2, admin: 3 };

/**
 * @typedef {{token: string, name: string, role: "viewer" | "operator" | "admin", expires: number}} Session
 * `session` is null while nobody is signed in; `ended` says why the last one ended.
 */
export const session = createStore({
  current: /** @type {Session | null} */ (null),
  ended: /** @type {string | null} */ (null),
  checking: false,
});

let timer = 0;

/** @param {Session} opened @param {boolean} keep */
export function open(opened, keep) {
  if (keep) store(opened.token);
  session.set({ current: opened, ended: null, checking: false });
  clearTimeout(timer);
  const left = opened.expires * 1000 - Date.now();
  if (left < 2 ** 31) timer = setTimeout(() => end("The token has ended. Ask for another one: rosrv token add."), left);
}

/** @param {string | null} why */
export function end(why) {
  clearTimeout(timer);
  forget();
  session.set({ current: null, ended: why, checking: false });
}

/** The token of an earlier page of this tab. */
export function kept() {
  try {
    return sessionStorage.getItem(KEY);
  } catch {
    return null;
  }
}

/** Whether who reads may do what this role may. @param {"viewer" | "operator" | "admin"} role */
export function may(role) {
  const held = session.get().current?.role;
  return held !== undefined && RANK[held] >= RANK[role];
}

function store(/** @type {string} */ token) {
  try {
    sessionStorage.setItem(KEY, token);
  } catch {
    // kept in memory only
  }
}

function forget() {
  try {
    sessionStorage.removeItem(KEY);
  } catch {
    // there was none
  }
}
