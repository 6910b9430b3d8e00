/** Requests to the appliance's REST interface, by path only. */

import { proof, readingKey } from "./keys.js";
import { Problem } from "./problem.js";
import { end, PERSON, session, unlocked } from "./session.js";
import { passive } from "./passive.js";

/**
 * @typedef {{query?: Record<string, any>, json?: any, text?: string, match?: string, token?: string,
 *   anonymous?: boolean, headers?: Record<string, string>, signal?: AbortSignal}} Options
 * `anonymous`: the request needs no session.
 */

/**
 * Return the response once its headers arrive. A request with `match` is a change and is signed. Throws `Problem`.
 * @param {string} method @param {string} path @param {Options} [options]
 */
export async function send(method, path, { query, json, text, match, token, anonymous, headers = {}, signal } = {}) {
  if (!token && !anonymous) await unlocked();
  const holder = anonymous ? undefined : token ?? session.get().current?.token;
  const at = new URL(path + queryText(query), location.origin);
  const body = json !== undefined ? JSON.stringify(json) : text;
  const type = json !== undefined ? "application/json" : text !== undefined ? "text/plain; charset=utf-8" : "";
  headers = { ...headers };
  if (type) headers["Content-Type"] = type;
  if (holder) headers.Authorization = `Bearer ${await readingKey(holder)}`;
  if (match !== undefined) {
    headers["If-Match"] = match;
    if (holder) {
      const { challenge } = (await ask("GET", "/v1/challenge", { token, signal })).body;
      const order = { method, target: at.pathname + at.search, match, type, body: body ?? "" };
      headers["ROSRV-Proof"] = await proof(holder, challenge, order);
    }
  }
  let response;
  try {
    response = await fetch(at, {
      method, headers, signal, body,
      cache: "no-store", credentials: "omit", redirect: "error", referrerPolicy: "no-referrer",
    });
  } catch (error) {
    if (signal?.aborted) throw error;
    const unknown = match === undefined ? "" : " The order may have taken effect: look before you repeat it.";
    throw new Problem(0, { detail: `No answer. Check that the appliance runs and that this machine can reach it.${unknown}` });
  }
  if (response.ok) return response;
  const problem = await problemOf(response);
  const { current } = session.get();
  if (problem.status === 401 && !token && holder && holder === current?.token) {
    end(current.name.startsWith(PERSON) ? "The session has ended. Sign in again." : problem.message);
  }
  if (problem.kind === "standby") passive.update({ active: problem.active });
  throw problem;
}

/** The body as JSON, and its ETag. @param {string} method @param {string} path @param {Options} [options] */
export async function ask(method, path, options) {
  const response = await send(method, path, options);
  const body = response.status === 204 ? null : await response.json();
  return { body, etag: response.headers.get("etag") };
}

/** @param {string} path @param {Record<string, any>} [query] @param {AbortSignal} [signal] */
export async function get(path, query, signal) {
  return (await ask("GET", path, { query, signal })).body;
}

/** @param {Record<string, any>} [query] Null, undefined and empty values are left out; an array repeats its name. */
export function queryText(query) {
  const words = new URLSearchParams();
  for (const [name, value] of Object.entries(query ?? {})) {
    for (const one of Array.isArray(value) ? value : [value]) {
      if (one !== null && one !== undefined && one !== "" && one !== false) words.append(name, String(one));
    }
  }
  const text = words.toString();
  return text ? `?${text}` : "";
}

async function problemOf(/** @type {Response} */ response) {
  const after = Number(response.headers.get("retry-after")) || null;
  try {
    return new Problem(response.status, await response.json(), after);
  } catch {
    return new Problem(response.status, { detail: `The appliance answered with status ${response.status}, without a reason.` }, after);
  }
}
