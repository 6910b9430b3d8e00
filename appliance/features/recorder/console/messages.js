/** Decoded messages around a point in time, for investigators. The audit log records each request. */

import { html, useEffect, useState } from "#console/html.js";
import { clock, iso } from "#console/moments.js";
import { bytes } from "#console/numbers.js";
import { Button } from "#console/parts/button.js";
import { Given } from "#console/parts/given.js";
import { Failure } from "#console/parts/notice.js";
import { get } from "#console/rest.js";

const PAUSE = 250; // milliseconds after the last step on the time line
const EACH = 5;

/** @param {{path: string, at: number, record: string | null, topics: string[], clear: () => void, span: number}} given `record`: the event at that time; `topics`: none: of all */
export function Messages({ path, at, record, topics, clear, span }) {
  const [reading, setReading] = useState(false);
  const [page, setPage] = useState(""); // the place of a message, once the user has paged on from the selected time
  const [found, setFound] = useState(/** @type {any} */ (null));
  const [error, setError] = useState(/** @type {unknown} */ (null));
  useEffect(() => setPage(""), [at, record, topics]);
  useEffect(() => {
    if (!reading) return undefined;
    const controller = new AbortController();
    const timer = setTimeout(() => {
      get(`${path}/messages`, { at: page || record || iso(at), topic: topics, neighbours: EACH }, controller.signal).then(
        (body) => {
          setFound(body);
          setError(null);
        },
        (problem) => controller.signal.aborted || setError(problem),
      );
    }, PAUSE);
    return () => {
      clearTimeout(timer);
      controller.abort();
    };
  }, [path, reading, at, record, page, topics]);
  const messages = reading ? found?.messages ?? [] : [];
  return html`<section class="panel" aria-labelledby="said"><div class="panel-head"><h2 id="said">Messages</h2>${topics.length > 0 && html`<span class="small"><${Given} value=${topics.join(", ")} mono most=${80} /> <button class="link" onClick=${clear}>all topics</button></span>`}
      <span class="end">${reading && html`<button class="button small" disabled=${!messages.length} onClick=${() => setPage(messages[0].place)}>Earlier</button><button class="button small" disabled=${!messages.length} onClick=${() => setPage(messages[messages.length - 1].place)}>Later</button>`}
        <${Button} small role="investigator" aria-keyshortcuts="m" onClick=${() => setReading(!reading)}>${reading ? "Stop reading" : "Read messages"}</${Button}></span></div>
    <div class="panel-body stack-tight">${error ? html`<${Failure} error=${error} />` : null}
      ${!reading ? html`<p class="muted small">As sent, before monitors changed or dropped them. The audit log records who reads them.</p>` : !messages.length && !error ? html`<p class="muted small" role="status">${found ? "No message." : "Reading."}</p>` : null}
      <ul class="said" aria-label="Messages">${messages.map((/** @type {any} */ one, /** @type {number} */ place) => html`<li key=${one.place}><details open=${place === found.chosen || place === found.chosen - 1}>
        <summary class=${place === found.chosen ? "chosen" : ""}><span class="mono small">${clock(one.time / 1e9, Math.min(span, 0.5))}</span> <${Given} value=${one.topic} mono most=${80} /> <span class="muted small"><${Given} value=${`${one.sender.node} ${one.sender.host}`} most=${120} />, ${bytes(one.size)}</span></summary>
        ${one.why && html`<p class="small"><${Given} value=${one.why} most=${400} /></p>`}<pre class="bytes" tabindex="0" aria-label="Its fields">${lines(one.fields)}</pre></details></li>`)}</ul></div></section>`;
}

/** Fields as JSON, one field on each line. Line breaks come only from this function, never from the fields. */
function lines(/** @type {any} */ fields) {
  return JSON.stringify(fields, null, 1).split("\n").map((line, at) => html`<div key=${at}><${Given} value=${line} most=${400} /></div>`);
}
