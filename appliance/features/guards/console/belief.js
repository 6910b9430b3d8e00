/** The variables of a guard, as its relay has them: asked once a second while a page shows them. The audit log has each look. */

import { mark, since } from "#console/elapsed.js";
import { html, useEffect, useState } from "#console/html.js";
import { lasting } from "#console/moments.js";
import { Dialog } from "#console/parts/dialog.js";
import { Given } from "#console/parts/given.js";
import { Failure, Loading } from "#console/parts/notice.js";
import { inTime } from "#console/parts/resource.js";
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
 * @returns {{belief: Belief | null, error: unknown, heard: import("#console/elapsed.js").Mark | null, may: boolean}}
 */
export function useBelief(name) {
  useStore(session);
  const allowed = may("operator");
  const [state, setState] = useState({ belief: /** @type {Belief | null} */ (null), error: /** @type {unknown} */ (null), heard: /** @type {import("#console/elapsed.js").Mark | null} */ (null) });
  useEffect(() => {
    if (!allowed) return undefined;
    let left = false;
    (async () => {
      while (!left) {
        try {
          if (!document.hidden) {
            const belief = await inTime((signal) => get(`/v1/monitors/${encodeURIComponent(name)}/values`, {}, signal));
            if (!left) setState({ belief, error: null, heard: mark() });
          }
        } catch (error) {
          if (!left) setState((before) => ({ ...before, error }));
        }
        await new Promise((done) => setTimeout(done, EVERY));
      }
    })();
    return () => {
      left = true;
    };
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

/** What keeps the values from being the present ones, as a sentence, or nothing. @param {Belief | null} belief @param {unknown} error @param {import("#console/elapsed.js").Mark | null} heard */
export function outdated(belief, error, heard) {
  if (error) return heard ? `The appliance last answered ${lasting(since(heard) / 1000)} ago.` : "The appliance does not answer.";
  if (!belief?.why_old) return "";
  return `Not known at present: ${belief.why_old}.`;
}

/** @param {{guard: any, close: () => void}} given */
export function Beliefs({ guard, close }) {
  const { belief, error, heard } = useBelief(guard.name);
  const old = belief !== null && belief.age_seconds !== null && (belief.why_old !== "" || belief.age_seconds > PRESENT || error !== null);
  return html`<${Dialog} title=${`What ${guard.name} knows`} close=${close}>
    ${!belief && error ? html`<${Failure} error=${error} />` : !belief ? html`<${Loading} rows=${4} />` : html`
    ${outdated(belief, error, heard) && html`<p role="status">${outdated(belief, error, heard)}${old && ` These values are ${short(/** @type {number} */ (belief.age_seconds))} s old.`}</p>`}
    <table class="table"><thead><tr><th>Variable</th><th>Value</th></tr></thead><tbody>
      ${Object.entries(belief.values).map(([name, value]) => html`<tr key=${name}><td><${Given} value=${name} mono most=${60} /></td><td><${Given} value=${said(value)} mono most=${200} /></td></tr>`)}
      ${Object.entries(belief.ages).map(([event, age]) => html`<tr key=${`age ${event}`}><td>last <${Given} value=${event} mono most=${60} /></td><td>${age === null ? "none yet" : `${short(age)} s ago`}</td></tr>`)}</tbody></table>`}</${Dialog}>`;
}

function said(/** @type {any} */ value) {
  if (typeof value === "number") return String(Number(value.toPrecision(6)));
  return typeof value === "string" ? value : JSON.stringify(value);
}
