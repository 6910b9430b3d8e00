/**
 * Sign in at the site's provider (single sign-on), and sign out.
 *
 * The page makes the token of its session before it goes to the provider, and sends only the verifiers of the token's
 * keys. So the code in the URL of the way back is of use to this tab only.
 */

import { idOf, newToken, verifiersOf } from "./keys.js";
import { Problem } from "./problem.js";
import { ask } from "./rest.js";
import { go } from "./router.js";
import { end, leave, LEFT, open, PERSON, session, stated } from "./session.js";
import { store, stored } from "./storage.js";

const BEGUN = "rosrv.sign-on"; // the token, the state and the place of a sign-in that is not finished

/** The provider's name; empty without one. */
export const PROVIDER = stated("sign-on");

/** @typedef {{token: string, state: string, keep: boolean, place: string}} Begun */

/** Go to the provider. Throws `Problem`. @param {boolean} keep whether the session survives a reload */
export async function begin(keep) {
  const token = newToken();
  const verifiers = await verifiersOf(token);
  const { body } = await ask("POST", "/v1/sso/begin", { json: { ...verifiers, again: stored(LEFT) !== null }, anonymous: true });
  const place = location.pathname + location.search;
  try {
    sessionStorage.setItem(BEGUN, JSON.stringify({ token, state: body.state, keep, place }));
  } catch {
    throw new Problem(0, { detail: "This browser stores nothing for this page, so it cannot return here from the provider. Sign in with a token." });
  }
  location.assign(body.url);
}

/** Whether the provider has sent the browser back to this page. */
export function returned() {
  const given = new URLSearchParams(location.search);
  return location.pathname === "/console" && given.has("state") && (given.has("code") || given.has("error"));
}

/** Complete the sign-in with which the provider has sent the browser back. */
export async function complete() {
  const given = new URLSearchParams(location.search);
  const begun = /** @type {Begun | null} */ (JSON.parse(stored(BEGUN, "sessionStorage") ?? "null"));
  store(BEGUN, null, "sessionStorage");
  go(begun?.place ?? "/console", { replace: true }); // the code leaves the URL, and the history
  session.update({ checking: true });
  try {
    if (!begun || given.get("state") !== begun.state) {
      throw new Problem(0, { detail: "This sign-in was not begun in this tab. Sign in again." });
    }
    const error = given.get("error");
    if (error !== null) throw new Problem(0, { detail: `The provider did not sign you in (${/^[a-z_]{1,40}$/.test(error) ? error : "unknown error"}).` });
    const { state, token, keep } = begun;
    await ask("POST", "/v1/sso/complete", { json: { state, code: given.get("code"), iss: given.get("iss") ?? "" }, anonymous: true });
    const { body } = await ask("GET", "/v1/whoami", { token });
    store(LEFT, null);
    open({ token, ...body }, keep);
  } catch (/** @type {any} */ failure) {
    end(failure.message, "Not signed in");
  }
}

/** Sign out. The session of a person also ends at the appliance. */
export async function signOut() {
  const { current } = session.get();
  if (current?.name.startsWith(PERSON)) {
    leave();
    try {
      await ask("DELETE", `/v1/sso/sessions/${idOf(current.token)}`, { token: current.token, match: "*" });
    } catch (/** @type {any} */ failure) {
      return end(`This page has forgotten your session, but the appliance did not end it: ${failure.message}`);
    }
  }
  end(null);
}
