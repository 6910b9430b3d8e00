/** A host by its name and address. The appliance gives the names (`/v1/policy/hosts`), the smallest network first. */

import { html, useEffect, useMemo } from "../html.js";
import { live } from "../live.js";
import { get } from "../rest.js";
import { createStore, useStore } from "../store.js";
import { Given } from "./given.js";

const V4 = /^(\d{1,3})\.(\d{1,3})\.(\d{1,3})\.(\d{1,3})$/;

const IN_TEXT = /(?<![(\d./:])\d{1,3}(?:\.\d{1,3}){3}(?![\d/:]|\.\d)/g; // neither a network, nor with a port, nor behind its name

const AGAIN = 5000; // milliseconds after a failure

const labels = createStore(/** @type {{network: string, name: string}[]} */ ([]));

/** Fetch the names again after each change of the policy or of the enrolled hosts. */
export function useNames() {
  const mark = useStore(live, (one) => one.status && `${one.status.policy.revision} ${one.status.policy.loaded} ${one.status.ipsec.enrolled} ${one.status.since}`);
  useEffect(() => {
    if (!mark) return undefined;
    const controller = new AbortController();
    let timer = 0;
    const fetchThem = () => get("/v1/policy/hosts", {}, controller.signal).then((found) => labels.set(found.labels), () => {
      if (!controller.signal.aborted) timer = setTimeout(fetchThem, AGAIN); // until then, addresses are shown
    });
    fetchThem();
    return () => (controller.abort(), clearTimeout(timer));
  }, [mark]);
}

/** The name of an address; empty if it has none. @param {string | null | undefined} address @param {{network: string, name: string}[]} known */
export function nameOf(address, known) {
  if (!address) return "";
  const number = numberOf(address);
  return known.find(({ network }) => {
    const [first, length] = network.split("/");
    const from = numberOf(first);
    if (number === null || from === null) return first === address && length === "128";
    const size = 2 ** (32 - Number(length));
    return Math.floor(number / size) === Math.floor(from / size);
  })?.name ?? "";
}

/** A function that returns the name and address of a host as text; it is another one after a change of the names. */
export function useShown() {
  const known = useStore(labels);
  return useMemo(() => (/** @type {string} */ address) => [nameOf(address, known), address].filter(Boolean).join(" "), [known]);
}

/** A sentence of the appliance, with the names of the hosts whose addresses it has. @param {{value: string, most: number, none?: string}} given */
export function Sentence({ value, most, none }) {
  const known = useStore(labels);
  const named = (value ?? "").replace(IN_TEXT, (address) => [nameOf(address, known), address].filter(Boolean).join(" "));
  return html`<${Given} value=${named} most=${most} none=${none} />`;
}

/** The names of all hosts that have one. @returns {string[]} */
export function useHosts() {
  const known = useStore(labels);
  return useMemo(() => [...new Set(known.map(({ name }) => name))].sort(), [known]);
}

/** @param {{value: string | null | undefined, none?: string}} given */
export function Host({ value, none = "–" }) {
  const name = useStore(labels, (known) => nameOf(value, known));
  if (!name) return html`<${Given} value=${value} most=${40} mono none=${none} />`;
  return html`<span class="host-name"><${Given} value=${name} most=${40} /> <span class="muted small"><${Given} value=${value} most=${40} mono /></span></span>`;
}

function numberOf(/** @type {string} */ address) {
  const parts = V4.exec(address);
  return parts ? parts.slice(1).reduce((sum, part) => sum * 256 + Number(part), 0) : null;
}
