/** The sign-in page. The appliance checks the access token; the page keeps it only as long as its holder wants. */

import { html, useEffect, useRef, useState } from "./html.js";
import { lasting } from "./moments.js";
import { Given } from "./parts/given.js";
import { Mark } from "./parts/icon.js";
import { Failure, Notice } from "./parts/notice.js";
import { Check, Field } from "./parts/field.js";
import { Problem } from "./problem.js";
import { ask } from "./rest.js";
import { entitle } from "./attention.js";
import { end, kept, open, ROBOT, session, stated, UNUSED } from "./session.js";
import { begin, PROVIDER } from "./sign-on.js";
import { useStore } from "./store.js";

const FIRST_PAUSE = 1000; // milliseconds
const LONGEST_PAUSE = 10_000;

/** Return the session of a token. Throws `Problem`. @param {string} token */
async function sessionOf(token) {
  const { body } = await ask("GET", "/v1/whoami", { token });
  return { token, ...body };
}

/**
 * Sign in with the token of an earlier page of this tab. While the appliance cannot check it, try again with a growing
 * pause, until the token is forgotten.
 */
export async function resume() {
  session.update({ checking: true });
  for (let pause = FIRST_PAUSE; session.get().checking; pause = Math.min(2 * pause, LONGEST_PAUSE)) {
    const token = kept();
    if (!token) return end(null);
    try {
      const found = await sessionOf(token);
      if (session.get().checking) open(found, true);
    } catch (/** @type {any} */ error) {
      if (!session.get().checking) return;
      if (!(error instanceof Problem && error.passing)) return session.update({ ended: error.message, checking: false, waiting: null });
      session.update({ waiting: error });
      await new Promise((resolve) => setTimeout(resolve, Math.max(pause, (error.retryAfter ?? 0) * 1000)));
    }
  }
}

export function Door() {
  const { ended, heading, checking, waiting, locked } = useStore(session);
  const [token, setToken] = useState("");
  const [keep, setKeep] = useState(true);
  const [error, setError] = useState(/** @type {unknown} */ (null));
  const [busy, setBusy] = useState(false);
  const submit = async (/** @type {Event} */ event) => {
    event.preventDefault();
    setBusy(true);
    setError(null);
    try {
      open(await sessionOf(token.trim()), keep);
    } catch (failure) {
      setError(failure);
    } finally {
      setBusy(false);
    }
  };
  const away = async () => {
    setBusy(true);
    setError(null);
    try {
      await begin(keep);
    } catch (failure) {
      setError(failure);
      setBusy(false);
    }
  };
  const notice = stated("notice");
  if (waiting) return html`<${Waiting} error=${waiting} />`;
  if (checking) return html`<main class="door" id="main"><p class="muted" role="status">Signing in.</p></main>`;
  return html`<main class="door" id="main"><div class="door-box">
    <${Brand} />
    <form class="panel" onSubmit=${submit}>
      ${notice && html`<div class="site-notice" role="note" aria-label="Site notice">${notice}</div>`}
      ${locked && !error && html`<${Notice} tone="warn" title="Locked" role="status">This page was not used for ${lasting(UNUSED / 1000)}. The work of <${Given} value=${locked.name} most=${40} /> is kept for that token; another token starts a new session.${PROVIDER && ` Sign-in with ${PROVIDER}, which asks who you are, opens the page again, without unsaved work.`}</${Notice}>`}
      ${ended && !error && html`<${Notice} tone="warn" title=${heading} role="status">${ended}</${Notice}>`}
      <${Failure} error=${error} />
      <${Field} label="Access token" type="password" mono value=${token} set=${setToken} placeholder="rosrv_…" autofocus required
        hint=${html`Create one with <code>rosrv token add NAME --role viewer</code>. The first token is in the file <code>first-token</code> of the state directory.`} />
      <${Check} label="Stay signed in until this tab is closed" on=${keep} set=${setKeep} />
      <button class="button primary" type="submit" disabled=${busy || !token.trim()}>${busy ? "Signing in" : "Sign in"}</button>
      ${PROVIDER && html`<p class="or small muted">or</p>
        <button class="button" type="button" disabled=${busy} onClick=${away}>Sign in with ${PROVIDER}</button>`}
    </form>
  </div></main>`;
}

/** Shown while the appliance cannot check the token of an earlier page. @param {{error: Problem}} given */
function Waiting({ error }) {
  return html`<main class="door" id="main"><div class="door-box">
    <${Brand} />
    <section class="panel" aria-label="Waiting">
      <${Failure} error=${error} />
      <p role="status">The token is kept. The page tries again automatically.</p>
      <button class="button" onClick=${() => end(null)}>Sign out</button>
    </section>
  </div></main>`;
}

function Brand() {
  return html`<div class="brand"><${Mark} size=${40} /><div><h1 class="brand-name">${ROBOT || "ROSRV"}</h1><div class="brand-sub">${ROBOT ? "Console of this robot's ROSRV appliance" : "Console of this appliance"}</div></div></div>`;
}

/** The sign-in page of a locked session, above everything else, including dialogs. */
export function Lock() {
  const ref = useRef(/** @type {HTMLDialogElement | null} */ (null));
  useEffect(() => {
    entitle("Locked");
    ref.current?.showModal();
  }, []);
  const stay = (/** @type {Event} */ event) => event.preventDefault();
  return html`<dialog ref=${ref} class="lock" aria-label="Locked" onCancel=${stay} onClose=${() => ref.current?.showModal()}><${Door} /></dialog>`;
}
