/** The door: a token is shown, recognised by the appliance, and kept no longer than its holder wants. */

import { html, useEffect, useRef, useState } from "./html.js";
import { lasting } from "./moments.js";
import { Given } from "./parts/given.js";
import { Mark } from "./parts/icon.js";
import { Failure, Notice } from "./parts/notice.js";
import { Check, Field } from "./parts/field.js";
import { ask } from "./rest.js";
import { open, session, stated, UNUSED } from "./session.js";
import { useStore } from "./store.js";

/** Ask who holds this token, and open the console to them. Throws `Problem`. @param {string} token @param {boolean} keep */
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
  if (checking) return html`<main class="door" id="main"><p class="muted" role="status">Asking the appliance who holds this token.</p></main>`;
  return html`<main class="door" id="main"><div class="door-box">
    <div class="brand"><${Mark} size=${40} /><div><h1 class="brand-name">ROSRV</h1><div class="brand-sub">Console of this appliance</div></div></div>
    <form class="panel" onSubmit=${submit}>
      ${notice && html`<div class="site-notice" role="note" aria-label="Notice of the site">${notice}</div>`}
      ${locked && !error && html`<${Notice} tone="warn" title="Locked" role="status">Nobody used this page for ${lasting(UNUSED / 1000)}. What <${Given} value=${locked.name} most=${40} /> was doing is still here for that token; another one begins anew.</${Notice}>`}
      ${ended && !error && html`<${Notice} tone="warn" title="Signed out" role="status">${ended}</${Notice}>`}
      <${Failure} error=${error} />
      <${Field} label="Access token" type="password" mono value=${token} set=${setToken} placeholder="rosrv_…" autofocus required
        hint=${html`Made by <code>rosrv token add NAME --role viewer</code>. The first one is in <code>first-token</code> in the state directory.`} />
      <${Check} label="Stay signed in until this tab is closed" on=${keep} set=${setKeep} />
      <button class="button primary" type="submit" disabled=${busy || !token.trim()}>${busy ? "Asking the appliance" : "Sign in"}</button>
    </form>
  </div></main>`;
}

/** The door before a page that nobody used for a while: above all that is open there, also a dialog. */
export function Lock() {
  const ref = useRef(/** @type {HTMLDialogElement | null} */ (null));
  useEffect(() => {
    document.title = "Locked · ROSRV";
    ref.current?.showModal();
  }, []);
  const stay = (/** @type {Event} */ event) => event.preventDefault();
  return html`<dialog ref=${ref} class="lock" aria-label="Locked" onCancel=${stay} onClose=${() => ref.current?.showModal()}><${Door} /></dialog>`;
}
