/**
 * The two keys derived from a token (docs/reference/rest.md, "Signed orders"). The token itself is never sent.
 *
 * The reading key is sent with every request. The signing key (Ed25519) signs each change together with a
 * challenge that the appliance accepts once.
 *
 * For single sign-on, the page makes a token itself, and the appliance gets only the verifiers of its keys.
 */

import { Problem } from "./problem.js";

const bytes = (/** @type {string} */ text) => new TextEncoder().encode(text);
// The prefix of the 32 bytes of a private Ed25519 key in PKCS #8 (RFC 8410).
const PKCS8 = [0x30, 0x2e, 0x02, 0x01, 0x00, 0x30, 0x05, 0x06, 0x03, 0x2b, 0x65, 0x70, 0x04, 0x22, 0x04, 0x20];

/** @param {string} token @returns {Promise<string>} */
export async function readingKey(token) {
  const id = /^rosrv_([0-9a-f]{12})_[\w-]{43}$/.exec(token)?.[1];
  if (!id) throw new Problem(401, { detail: "The token is wrong or revoked. A token starts with rosrv_; create one with rosrv token add." });
  return `rosrv-read_${id}_${text(await derived(token, "rosrv reading key 1"))}`;
}

/** Return a new token, as `rosrv token add` makes it. */
export function newToken() {
  return `rosrv_${hex(crypto.getRandomValues(new Uint8Array(6)).buffer)}_${text(crypto.getRandomValues(new Uint8Array(32)).buffer)}`;
}

/** The id of a token. @param {string} token */
export const idOf = (token) => token.split("_")[1];

/** Return a token's id and what verifies its keys. @param {string} token */
export async function verifiersOf(token) {
  const reading = text(await crypto.subtle.digest("SHA-256", bytes(await readingKey(token))));
  const { x } = await crypto.subtle.exportKey("jwk", await signingKey(token, true));
  return { id: idOf(token), reading, verifying: x };
}

/**
 * Return the header that proves a change; `target` is path and query.
 * @param {string} token @param {string} challenge
 * @param {{method: string, target: string, match: string, type: string, body: string}} order
 */
export async function proof(token, challenge, { method, target, match, type, body }) {
  const lines = ["rosrv order 1", challenge, method, target, match, type, hex(await crypto.subtle.digest("SHA-256", bytes(body)))];
  const key = await signingKey(token, false);
  return `${challenge} ${text(await crypto.subtle.sign("Ed25519", key, bytes(lines.join("\n"))))}`;
}

async function signingKey(/** @type {string} */ token, /** @type {boolean} */ extractable) {
  const seed = new Uint8Array(await derived(token, "rosrv signing key 1"));
  try {
    return await crypto.subtle.importKey("pkcs8", new Uint8Array([...PKCS8, ...seed]), "Ed25519", extractable, ["sign"]);
  } catch {
    throw new Problem(0, { detail: "This browser cannot sign changes (Ed25519). Use a newer browser, or `rosrv` on the command line." });
  }
}

async function derived(/** @type {string} */ token, /** @type {string} */ label) {
  if (!globalThis.crypto?.subtle) throw new Problem(0, { detail: "Browsers disable cryptography on this page. Open it over https, or on the appliance's machine." });
  const key = await crypto.subtle.importKey("raw", bytes(token), { name: "HMAC", hash: "SHA-256" }, false, ["sign"]);
  return crypto.subtle.sign("HMAC", key, bytes(label));
}

function text(/** @type {ArrayBuffer} */ data) {
  return btoa(String.fromCharCode(...new Uint8Array(data))).replace(/\+/g, "-").replace(/\//g, "_").replace(/=+$/, "");
}

function hex(/** @type {ArrayBuffer} */ data) {
  return [...new Uint8Array(data)].map((one) => one.toString(16).padStart(2, "0")).join("");
}
