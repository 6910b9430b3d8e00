/**
 * Who reads: the token, its role, its end; and the lock of a page that nobody uses.
 *
 * The token is in this page's memory, and in the tab's session storage if the reader wants it to outlive a reload. It
 * is never in a cookie (nothing is sent that a request of another page could carry) and never in an address.
 *
 * A page that was not used for a while is locked: it forgets the token and shows the door, and asks the appliance for
 * nothing. What was being edited stays behind the door for whoever was there before; for anybody else it is dropped.
 */

import { Problem } from "./problem.js";
import { createStore } from "./store.js";

const KEY = "rosrv.token";
const LAST_USE = "rosrv.used"; // beside it: a browser may put a tab away and load it anew hours later
const RANK = { viewer: 1, investigator: 1, operator: 2, admin: 3 };
const USES = ["pointerdown", "pointermove", "keydown", "wheel", "touchstart"];
const LONGEST = 2 ** 31 - 1; // what a browser's timer can wait, in milliseconds
/** After how long without use the page is locked, in milliseconds. */
export const UNUSED = Number(stated("lock-seconds")) * 1000;

/**
 * @typedef {{token: string, name: string, role: "viewer" | "investigator" | "operator" | "admin", expires: number}} Session
 * `current` is null while nobody is signed in; `ended` says why the last one ended. While the page is locked `locked` is
 * who was there. `number` counts those who came, and who only opened the lock again is not another.
 */
export const session = createStore({
  current: /** @type {Session | null} */ (null),
  ended: /** @type {string | null} */ (null),
  checking: false,
  locked: /** @type {{name: string, role: string} | null} */ (null),
  number: 0,
});

let ending = 0;
let locking = 0;
let used = 0; // when, in milliseconds since the epoch

/** What the site has the page say and do, as the appliance wrote it into the page. @param {string} name */
export function stated(name) {
  return document.querySelector(`meta[name="rosrv:${name}"]`)?.getAttribute("content") ?? "";
}

/** @param {Session} opened @param {boolean} keep */
export function open(opened, keep) {
  const { locked } = session.get();
  const same = locked?.name === opened.name && locked.role === opened.role;
  if (locked && !same) end(null);
  if (keep) store(opened.token);
  const { number } = session.get();
  session.set({ current: opened, ended: null, checking: false, locked: null, number: same ? number : number + 1 });
  clearTimeout(ending);
  const left = opened.expires * 1000 - Date.now();
  if (left < LONGEST) ending = setTimeout(() => end("The token has ended. Ask for another one: rosrv token add."), left);
  use();
  watch();
}

/** @param {string | null} why */
export function end(why) {
  clearTimeout(ending);
  clearTimeout(locking);
  forget();
  session.update({ current: null, ended: why, checking: false, locked: null });
}

/** Nobody is here: the token is forgotten, what was being done stays. */
export function lock() {
  const { current } = session.get();
  if (!current) return;
  clearTimeout(locking);
  forget();
  session.update({ current: null, locked: { name: current.name, role: current.role } });
}

/** Requests of the page wait here while it is locked. Throws `Problem` when who was there does not come back. */
export async function unlocked() {
  if (!session.get().locked) return;
  await new Promise((resolve, reject) => {
    const leave = session.subscribe(() => {
      const { current, locked } = session.get();
      if (locked) return;
      leave();
      if (current) resolve(undefined);
      else reject(new Problem(401, { detail: "The page was locked, and who had asked for this did not come back." }));
    });
  });
}

/** The token of an earlier page of this tab, unless nobody used that for so long that it would be locked. */
export function kept() {
  try {
    const last = Number(sessionStorage.getItem(LAST_USE) ?? Date.now());
    if (Date.now() - last >= UNUSED) forget();
    return sessionStorage.getItem(KEY);
  } catch {
    return null;
  }
}

/** Whether who reads may do what this role may; what is for investigators nobody else may. @param {keyof typeof RANK} role */
export function may(role) {
  const held = session.get().current?.role;
  return held !== undefined && (role === "investigator" ? held === role : RANK[held] >= RANK[role]);
}

// A timer may be late (a computer that slept): what is done then is no use of a page that should be locked.
for (const kind of USES) {
  addEventListener(kind, () => {
    if (session.get().current && Date.now() - used >= UNUSED) lock();
    else if (Date.now() - used >= 1000) use();
  }, { capture: true, passive: true });
}

function use() {
  used = Date.now();
  try {
    if (sessionStorage.getItem(KEY)) sessionStorage.setItem(LAST_USE, String(used));
  } catch {
    // no page of this tab will have the token
  }
}

/** Lock the page as soon as it was not used for long enough. */
function watch() {
  clearTimeout(locking);
  const left = used + UNUSED - Date.now();
  if (left > 0) locking = setTimeout(watch, Math.min(left, LONGEST));
  else lock();
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
    for (const name of [KEY, LAST_USE]) sessionStorage.removeItem(name);
  } catch {
    // there was none
  }
}
