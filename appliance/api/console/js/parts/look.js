/** Messages of topics as subscribers receive them, for a minute. The audit log has each query. */

import { useEffect, useState } from "../html.js";
import { Problem } from "../problem.js";
import { get } from "../rest.js";

export const SECONDS = 60; // the query ends automatically after it
const EACH = { messages: 20, seconds: 2 };
const PAUSE = 500; // milliseconds between queries of a topic
const MAX = 1200; // messages that are kept of a topic

/**
 * `seen`: the messages of each topic, oldest first; messages are missed before one that is the `first` of a query. `turn` begins and ends the query.
 * @param {string[]} topics
 * @returns {{looking: boolean, turn: () => void, seen: Record<string, any[]>, error: unknown}}
 */
export function useLook(topics) {
  const [until, setUntil] = useState(0);
  const [seen, setSeen] = useState(/** @type {Record<string, any[]>} */ ({}));
  const [error, setError] = useState(/** @type {unknown} */ (null));
  const about = topics.join();
  useEffect(() => {
    if (!until) return undefined;
    const controller = new AbortController();
    const { signal } = controller;
    setError(null);
    let unheard = 0;
    Promise.all(topics.map(async (topic) => {
      try {
        await follow(topic, until, signal, (more) => setSeen((seen) => ({ ...seen, [topic]: recent([...(seen[topic] ?? []), ...more]) })));
      } catch (problem) {
        unheard += 1; // a topic that nobody publishes does not end the query of the others
        if (!signal.aborted && (!(problem instanceof Problem && problem.status === 404) || unheard === topics.length)) setError(problem);
      }
    })).then(() => signal.aborted || setUntil(0));
    return () => controller.abort();
  }, [about, until]);
  return { looking: until > 0, turn: () => setUntil(until ? 0 : performance.now() + SECONDS * 1000), seen, error };
}

/** @param {string} topic @param {number} until @param {AbortSignal} signal @param {(more: any[]) => void} heard */
async function follow(topic, until, signal, heard) {
  for (let latched = true; performance.now() < until && !signal.aborted; latched = false) {
    const [body] = /** @type {any[]} */ (await Promise.all([get("/v1/messages", { topic, latched, ...EACH }, signal), pause(PAUSE)]));
    heard(body.messages.map((/** @type {any} */ one, /** @type {number} */ at) => ({ ...one, first: at === 0 })));
  }
}

function recent(/** @type {any[]} */ messages) {
  const newest = Math.max(...messages.map((one) => one.time)) / 1e9;
  return messages.filter((one) => one.time / 1e9 > newest - 2 * SECONDS).slice(-MAX);
}

const pause = (/** @type {number} */ milliseconds) => new Promise((done) => setTimeout(done, milliseconds));
