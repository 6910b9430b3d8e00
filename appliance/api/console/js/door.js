/** The sign-in page. The appliance checks the access token; the page keeps it only as long as its holder wants. */

import { html, useEffect, useRef, useState } from "./html.js";
import { lasting } from "./moments.js";
import { Given } from "./parts/given.js";
import { Mark } from "./parts/icon.js";
import { Failure, Notice } from "./parts/notice.js";
import { Check, Field } from "./parts/field.js";
import { ask } from "./rest.js";
import { open, session, stated, UNUSED } from "./session.js";
import { useStore } from "./store.js";

/** Look up a token's holder and start the session. Throws `Problem`. @param {string} token @param {boolean} keep */
export async function enter(token, keep) {
  const { body } = await ask("GET", "/v1/whoami", { token });
  open({ token, ...body }, keep);
}

export function Door() {
  const { ended, checking, locked } = useStore(session);
  const [token, setToken] = useState("");
  const [keep, setKeep] = useState(true);
  const [error, setError] = useState(/** @type {unknown} */ (null));
  const [busy, setBusy] = useState(false);
  const submit = async (/** @type {Event} */ event) => {
    event.preventDefault();
    setBusy(true);
    setError(null);
    try {
      await enter(token.trim(), keep);
    } catch (failure) {
      setError(failure);
    } finally {
      setBusy(false);
    }
  };
  const notice = stated("notice");
  if (checking) return html`<main class="door" id="main"><p class="muted" role="status">Checking the token.</p></main>`;
  return html`<main class="door" id="main"><div class="door-box">
    <div class="brand"><${Mark} size=${40} /><div><h1 class="brand-name">ROSRV</h1><div class="brand-sub">Console of this appliance</div></div></div>
    <form class="panel" onSubmit=${submit}>
      ${notice && html`<div class="site-notice" role="note" aria-label="Site notice">${notice}</div>`}
      ${locked && !error && html`<${Notice} tone="warn" title="Locked" role="status">This page was not used for ${lasting(UNUSED / 1000)}. The work of <${Given} value=${locked.name} most=${40} /> is kept for that token; another token starts a new session.</${Notice}>`}
      ${ended && !error && html`<${Notice} tone="warn" title="Signed out" role="status">${ended}</${Notice}>`}
      <${Failure} error=${error} />
      <${Field} label="Access token" type="password" mono value=${token} set=${setToken} placeholder="rosrv_…" autofocus required
        hint=${html`Create one with <code>rosrv token add NAME --role viewer</code>. The first token is in the file <code>first-token</code> of the state directory.`} />
      <${Check} label="Stay signed in until this tab is closed" on=${keep} set=${setKeep} />
      <button class="button primary" type="submit" disabled=${busy || !token.trim()}>${busy ? "Signing in" : "Sign in"}</button>
    </form>
  </div></main>`;
}

/** The sign-in page of a locked session, above everything else, including dialogs. */
export function Lock() {
  const ref = useRef(/** @type {HTMLDialogElement | null} */ (null));
  useEffect(() => {
    document.title = "Locked · ROSRV";
    ref.current?.showModal();
  }, []);
  const stay = (/** @type {Event} */ event) => event.preventDefault();
  return html`<dialog ref=${ref} class="lock" aria-label="Locked" onCancel=${stay} onClose=${() => ref.current?.showModal()}><${Door} /></dialog>`;
}
