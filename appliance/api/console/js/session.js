/**
 * The session: the token, its role, its expiry; and the lock of an unused page.
 *
 * The token is in this page's memory, and in the tab's session storage if the user wants it to survive a reload. It
 * is never in a cookie, which a request of another page could carry, and never in a URL.
 *
 * An unused page is locked: it forgets the token, shows the sign-in page, and requests
 * nothing. Unsaved work is kept for the same token; another token discards it.
 */

import { mark, since } from "./elapsed.js";
import { Problem } from "./problem.js";
import { store, stored } from "./storage.js";
import { createStore } from "./store.js";

const KEY = "rosrv.token";
const TAB = "sessionStorage";
/** Names of people who signed in at the provider start with this. */
export const PERSON = "sso:";
/** Of all tabs: a person left without another signing in, so the provider must ask who signs in next. */
export const LEFT = "rosrv.signed-out";
const LAST_USE = "rosrv.used"; // time of the last use: a browser may unload a tab and reload it hours later
const RANK = { viewer: 1, investigator: 1, operator: 2, admin: 3 };
const USES = ["pointerdown", "pointermove", "keydown", "wheel", "touchstart"];
const LOOKED = 5000; // milliseconds between two looks at the time without use: a timer stands still while the computer sleeps
const LONGEST = 2 ** 31 - 1; // longest delay of a browser's timer, in milliseconds
/** Time without use after which the page is locked, in milliseconds. */
export const UNUSED = Number(stated("lock-seconds")) * 1000;

/**
 * @typedef {{token: string, name: string, role: "viewer" | "investigator" | "operator" | "admin", expires: number, left_seconds: number}} Session `left_seconds`: until it ends, when it was opened
 * `current` is null while signed out; `ended` is the reason why the last session ended, under `heading`. `checking`: the token of an
 * earlier page is being checked; `waiting` is the problem that delays the check. While the page is locked, `locked` is
 * the locked session. `number` counts sessions; unlocking does not start a new session.
 */
export const session = createStore({
  current: /** @type {Session | null} */ (null),
  ended: /** @type {string | null} */ (null),
  heading: "Signed out",
  checking: false,
  waiting: /** @type {Problem | null} */ (null),
  locked: /** @type {{name: string, role: string} | null} */ (null),
  number: 0,
});

let ending = 0;
let locking = 0;
let used = mark(); // the last use

/** Return a setting of the site, which the appliance wrote into the page's `meta` element. @param {string} name */
export function stated(name) {
  return document.querySelector(`meta[name="rosrv:${name}"]`)?.getAttribute("content") ?? "";
}

/** The robot's name; empty without one. */
export const ROBOT = stated("robot");

/** The name of a downloaded file, which has the robot's. @param {string} what @param {string} rest */
export function fileName(what, rest) {
  return ["rosrv", ROBOT, what, rest].filter(Boolean).join("-");
}

/** @param {Session} opened @param {boolean} keep */
export function open(opened, keep) {
  const { locked } = session.get();
  const same = locked?.name === opened.name && locked.role === opened.role;
  if (locked && !same) end(null);
  if (keep) store(KEY, opened.token, TAB);
  const { number } = session.get();
  session.set({ current: opened, ended: null, heading: "Signed out", checking: false, waiting: null, locked: null, number: same ? number : number + 1 });
  clearTimeout(ending);
  const left = opened.left_seconds * 1000; // not from `expires`: the clock of this browser may differ
  if (left < LONGEST) ending = setTimeout(() => end(opened.name.startsWith(PERSON) ? "The session has expired. Sign in again." : "The token has expired. Create another: rosrv token add."), left);
  use();
  watch();
}

/** @param {string | null} why @param {string} [heading] */
export function end(why, heading = "Signed out") {
  clearTimeout(ending);
  clearTimeout(locking);
  forget();
  session.update({ current: null, ended: why, heading, checking: false, waiting: null, locked: null });
}

/** Note that the person left: the provider asks who signs in next, in each tab. */
export function leave() {
  if (stated("sign-on")) store(LEFT, "yes"); // without storage, the provider may sign the same person in without a question
}

/** Lock the unused page: forget the token, but keep unsaved work. */
export function lock() {
  leave();
  const { current } = session.get();
  if (!current) return;
  clearTimeout(locking);
  forget();
  session.update({ current: null, locked: { name: current.name, role: current.role } });
}

/** Hold requests while the page is locked. Throws `Problem` when another user signs in. */
export async function unlocked() {
  if (!session.get().locked) return;
  await new Promise((resolve, reject) => {
    const leave = session.subscribe(() => {
      const { current, locked } = session.get();
      if (locked) return;
      leave();
      if (current) resolve(undefined);
      else reject(new Problem(401, { detail: "The page was locked and another user signed in." }));
    });
  });
}

/** Return the token of an earlier page of this tab, unless that page was unused for so long that it would be locked. */
export function kept() {
  const last = Number(stored(LAST_USE, TAB) ?? Date.now());
  if (Date.now() - last >= UNUSED) {
    forget();
    leave();
  }
  return stored(KEY, TAB);
}

/** Whether the user has the rights of this role; only investigators have the rights of investigators. @param {keyof typeof RANK} role */
export function may(role) {
  const held = session.get().current?.role;
  return held !== undefined && (role === "investigator" ? held === role : RANK[held] >= RANK[role]);
}

// A timer may be late (a suspended computer): input after the deadline does not extend the session.
for (const kind of USES) {
  addEventListener(kind, () => {
    if (since(used) >= UNUSED) lock();
    else if (since(used) >= 1000) use();
  }, { capture: true, passive: true });
}

function use() {
  used = mark();
  if (stored(KEY, TAB)) store(LAST_USE, String(used.wall), TAB);
}

/** Start the timer that locks the page after `UNUSED` milliseconds without use. */
function watch() {
  clearTimeout(locking);
  const left = UNUSED - since(used);
  if (left > 0) locking = setTimeout(watch, Math.min(left, LOOKED));
  else lock();
}

function forget() {
  for (const name of [KEY, LAST_USE]) store(name, null, TAB);
}
