/** The policy in force and the edited text, which is kept while another view is shown. */

import { ask, get } from "../rest.js";
import { session } from "../session.js";
import { createStore } from "../store.js";

export const draft = createStore({
  live: /** @type {any} */ (null), // the answer to GET /v1/policy
  etag: /** @type {string | null} */ (null), // of the revision that the edited text started from
  base: "", // the text that the edited text started from
  text: "",
  signature: "", // the site's signature of the text
  error: /** @type {unknown} */ (null),
  findings: /** @type {any[]} */ ([]),
  granted: false, // the text is what "Grant this" proposed for a denial
  errors: 0, // in the text and its tests, as last checked; an error of the signature is not one of them
  report: /** @type {any} */ (null), // of the last dry run or load
  tested: /** @type {any} */ (null),
});

session.subscribe(() => {
  const { current, locked } = session.get();
  if (!current && !locked) draft.set({ live: null, etag: null, base: "", text: "", signature: "", error: null, granted: false, findings: [], errors: 0, report: null, tested: null });
});

/** Fetch the policy in force. An edited text stays, together with the revision that it started from. */
export async function look() {
  try {
    const { body, etag } = await ask("GET", "/v1/policy");
    const { text, base, live, report } = draft.get();
    if (report?.loaded && report.revision !== body.revision) draft.update({ report: null });
    if (live === null || text === base) draft.update({ live: body, etag, base: body.text, text: body.text, error: null });
    else draft.update({ live: body, error: null });
  } catch (error) {
    draft.update({ error });
  }
}

export function write(/** @type {string} */ text) {
  const { text: before, base } = draft.get();
  if (text === before) return;
  draft.update({ text, report: null });
  if (text === base) draft.update({ error: null, granted: false, findings: [], errors: 0 }); // it is not checked again
}

/** Discard the edited text and start again from the policy in force. */
export function discard() {
  const { live } = draft.get();
  draft.update({ text: live.text, base: live.text, etag: `"${live.revision}"`, error: null, granted: false, findings: [], errors: 0, report: null, tested: null });
}

/** Keep the edited text, but base it on the revision that is now in force. */
export function rebase() {
  const { live } = draft.get();
  draft.update({ base: live.text, etag: `"${live.revision}"`, report: null });
}

/** Check the text and run its tests, for the person who edits it. The policy in force does not change. */
export async function check(/** @type {AbortSignal} */ signal) {
  const { text } = draft.get();
  try {
    const { body } = await ask("POST", "/v1/policy/test", { json: { text }, signal });
    if (draft.get().text === text) draft.update({ tested: body, findings: [], errors: 0, error: null });
  } catch (error) {
    if (!signal.aborted && draft.get().text === text) refused(error, { signed: false });
  }
}

let newest = 0; // number of the newest dry run or load: the result of an earlier one is ignored

/**
 * Compute the effect of the text with a dry run. Return false if its result is ignored, because a newer dry run or
 * load has started or the text has changed. Throws `Problem`.
 */
export async function dryRun() {
  const { text, signature } = draft.get();
  const number = ++newest;
  const ignored = () => number !== newest || draft.get().text !== text || draft.get().signature !== signature;
  try {
    const { body } = await ask("POST", "/v1/policy", { query: { dry_run: 1 }, json: { text, signature } });
    if (ignored()) return false;
    draft.update({ report: body, findings: body.warnings, errors: 0, error: null });
  } catch (error) {
    if (ignored()) return false;
    refused(error);
    throw error;
  }
  return true;
}

/** Bring the text into force. @param {string} note @param {number | null} within seconds to confirm */
export async function load(note, within) {
  const { text, signature, etag } = draft.get();
  newest += 1;
  try {
    const { body, etag: next } = await ask("POST", "/v1/policy", { query: { confirm_within: within }, json: { text, note, signature }, match: etag ?? "" });
    draft.update({ report: body, findings: body.warnings, errors: 0, base: text, etag: next, error: null, granted: false });
    await look();
    return body;
  } catch (error) {
    refused(error);
    throw error;
  }
}

/** Make a change that has no text: rollback, reload or confirm. @param {string} what @param {any} [json] */
export async function change(what, json) {
  const { live } = draft.get();
  const { body } = await ask("POST", `/v1/policy/${what}`, { json, match: `"${live.revision}"` });
  const clean = draft.get().text === draft.get().base;
  if (clean) draft.update({ base: "", text: "" , live: null, report: null });
  await look();
  return body;
}

export async function revisions(/** @type {AbortSignal} */ signal) {
  return (await get("/v1/policy/revisions", {}, signal)).revisions;
}

/** @param {any} error @param {{signed?: boolean}} [how] `signed`: the signature was checked too, so an error may be its own */
function refused(error, { signed = draft.get().live?.site_keys.length > 0 } = {}) {
  const findings = Array.isArray(error?.findings) ? error.findings : [];
  draft.update({ error, findings, report: null, tested: null });
  if (!signed) draft.update({ errors: findings.filter((/** @type {any} */ one) => one.severity === "error").length });
}
