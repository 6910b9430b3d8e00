/**
 * Follow server-sent events with a token (EventSource cannot send one). After an error or silence, reconnect with a
 * growing pause, continuing after the last event.
 */

import { mark, since } from "./elapsed.js";
import { Problem } from "./problem.js";
import { send } from "./rest.js";
import { session } from "./session.js";

const SILENCE = 20_000; // milliseconds; the appliance sends at least a comment every 15 s
const CHECKED = 1000; // milliseconds between two looks at the silence: a timer alone stands still while the computer sleeps
const FIRST_PAUSE = 1000;
const LONGEST_PAUSE = 30_000;

/**
 * @typedef {{state: "connecting" | "live" | "lost", reason: string | null, again: number | null}} Standing
 * `again`: the time of the next attempt (milliseconds of the monotonic clock).
 */

/**
 * @param {() => string} path asked anew for each try
 * @param {(event: string, data: any, id: string | null) => void} heard
 * @param {(standing: Standing) => void} stands
 * @param {string | null} [last] the id after which to begin
 * @returns {{stop: () => void, retry: () => void}}
 */
export function follow(path, heard, stands, last = null) {
  let stopped = false;
  let pause = FIRST_PAUSE;
  let wake = () => {};
  let running = new AbortController();

  async function once() {
    running = new AbortController();
    /** @type {Record<string, string>} */
    const headers = last === null ? {} : { "Last-Event-ID": last };
    const response = await send("GET", path(), { headers, signal: running.signal });
    if (!response.body) throw new Problem(0, { detail: "This browser cannot read streams." });
    stands({ state: "live", reason: null, again: null });
    await read(response.body, running, (event, data, id) => {
      pause = FIRST_PAUSE;
      if (id !== null) last = id;
      heard(event, data, id);
    });
  }

  async function run() {
    stands({ state: "connecting", reason: null, again: null });
    while (!stopped) {
      let reason = "The connection ended.";
      let least = 0;
      try {
        await once();
      } catch (error) {
        if (stopped) return;
        if (error instanceof Problem) {
          if (error.status === 401) return; // the session has ended, and the sign-in page says so
          reason = error.message;
          least = (error.retryAfter ?? 0) * 1000;
        }
      }
      if (stopped) return;
      const wait = Math.max(least, pause * (0.75 + Math.random() * 0.5));
      pause = Math.min(pause * 2, LONGEST_PAUSE);
      stands({ state: "lost", reason, again: performance.now() + wait });
      await new Promise((resolve) => {
        const timer = setTimeout(resolve, wait);
        wake = () => (clearTimeout(timer), resolve(undefined));
      });
      if (!stopped) stands({ state: "connecting", reason, again: null });
    }
  }

  const leave = session.subscribe(() => {
    if (session.get().locked) running.abort(); // the next attempt waits until the page is unlocked
  });
  run();
  return {
    stop: () => ((stopped = true), leave(), running.abort(), wake()),
    retry: () => ((pause = FIRST_PAUSE), wake()),
  };
}

async function read(
  /** @type {ReadableStream<Uint8Array>} */ body, /** @type {AbortController} */ controller,
  /** @type {(event: string, data: any, id: string | null) => void} */ heard,
) {
  const reader = body.pipeThrough(/** @type {any} */ (new TextDecoderStream())).getReader();
  let rest = "";
  let last = mark();
  const watchdog = setInterval(() => since(last) > SILENCE && controller.abort(), CHECKED);
  try {
    for (;;) {
      const { done, value } = await reader.read();
      last = mark();
      if (done) return;
      const blocks = (rest + value.replaceAll("\r\n", "\n")).split("\n\n");
      rest = blocks.pop() ?? "";
      for (const block of blocks) tell(block, heard);
    }
  } finally {
    clearInterval(watchdog);
  }
}

function tell(/** @type {string} */ block, /** @type {(event: string, data: any, id: string | null) => void} */ heard) {
  let event = "message";
  let id = /** @type {string | null} */ (null);
  const data = [];
  for (const line of block.split("\n")) {
    const [, name, value] = /^([a-z]+): ?(.*)$/.exec(line) ?? [];
    if (name === "event") event = value;
    else if (name === "id") id = value;
    else if (name === "data") data.push(value);
  }
  if (data.length) heard(event, JSON.parse(data.join("\n")), id);
}
