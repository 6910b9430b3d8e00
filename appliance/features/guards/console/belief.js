/** The variables of a guard, as its relay has them: asked once a second while a page shows them. The audit log has each look. */

import { html, useEffect, useState } from "#console/html.js";
import { Dialog } from "#console/parts/dialog.js";
import { Given } from "#console/parts/given.js";
import { Failure, Loading } from "#console/parts/notice.js";
import { get } from "#console/rest.js";
import { may, session } from "#console/session.js";
import { useStore } from "#console/store.js";
import { short } from "./geometry.js";

const EVERY = 1000; // milliseconds
const PRESENT = 1; // seconds: the age of an answer from the relay that needs no word

/** @typedef {{values: Record<string, any>, ages: Record<string, number | null>, age_seconds: number | null, why_old: string}} Belief */

/**
 * `may`: the role of the session may look.
 * @param {string} name of a monitor
 * @returns {{belief: Belief | null, error: unknown, may: boolean}}
 */
export function useBelief(name) {
  useStore(session);
  const allowed = may("operator");
  const [state, setState] = useState({ belief: /** @type {Belief | null} */ (null), error: /** @type {unknown} */ (null) });
  useEffect(() => {
    if (!allowed) return undefined;
    const controller = new AbortController();
    const { signal } = controller;
    (async () => {
      while (!signal.aborted) {
        try {
          if (!document.hidden) setState({ belief: await get(`/v1/monitors/${encodeURIComponent(name)}/values`, {}, signal), error: null });
        } catch (error) {
          if (signal.aborted) return;
          setState((before) => ({ ...before, error }));
        }
        await new Promise((done) => setTimeout(done, EVERY));
      }
    })();
    return () => controller.abort();
  }, [name, allowed]);
  return { ...state, may: allowed };
}

/** The position that a fence has. @param {Belief | null} belief @returns {{x: number, y: number, turned: number | null} | null} */
export function positionOf(belief) {
  const { atX, atY, turned } = belief?.values ?? {};
  if (typeof atX !== "number" || typeof atY !== "number") return null;
  return { x: atX, y: atY, turned: typeof turned === "number" ? turned : null };
}

/** The age of the position in seconds, or null. @param {Belief | null} belief */
export function ageOf(belief) {
  return belief?.ages.pose ?? null;
}

/** What keeps the values from being the present ones, as a sentence, or nothing. @param {Belief | null} belief @param {unknown} error */
export function outdated(belief, error) {
  if (error) return "The appliance does not answer.";
  if (!belief?.why_old) return "";
  return `Not known at present: ${belief.why_old}.`;
}

/** @param {{guard: any, close: () => void}} given */
export function Beliefs({ guard, close }) {
  const { belief, error } = useBelief(guard.name);
  const old = belief !== null && belief.age_seconds !== null && (belief.why_old !== "" || belief.age_seconds > PRESENT || error !== null);
  return html`<${Dialog} title=${`What ${guard.name} knows`} close=${close}>
    ${!belief && error ? html`<${Failure} error=${error} />` : !belief ? html`<${Loading} rows=${4} />` : html`
    ${outdated(belief, error) && html`<p role="status">${outdated(belief, error)}${old && ` These values are ${short(/** @type {number} */ (belief.age_seconds))} s old.`}</p>`}
    <table class="table"><thead><tr><th>Variable</th><th>Value</th></tr></thead><tbody>
      ${Object.entries(belief.values).map(([name, value]) => html`<tr key=${name}><td><${Given} value=${name} mono most=${60} /></td><td><${Given} value=${said(value)} mono most=${200} /></td></tr>`)}
      ${Object.entries(belief.ages).map(([event, age]) => html`<tr key=${`age ${event}`}><td>last <${Given} value=${event} mono most=${60} /></td><td>${age === null ? "none yet" : `${short(age)} s ago`}</td></tr>`)}</tbody></table>`}</${Dialog}>`;
}

function said(/** @type {any} */ value) {
  if (typeof value === "number") return String(Number(value.toPrecision(6)));
  return typeof value === "string" ? value : JSON.stringify(value);
}
