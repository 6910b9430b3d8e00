/** The time line: events above, a lane for each topic below, on one axis, with the selected time. */

import { html, useState } from "#console/html.js";
import { clock } from "#console/moments.js";
import { count, counted } from "#console/numbers.js";
import { Given } from "#console/parts/given.js";
import { plain } from "#console/words.js";
import { kindOf } from "./times.js";

export const COLUMNS = 160;
const HEIGHT = 20;
const LEAST = 4; // least height of a bar, so that one message is visible beside a thousand
const SHOWN = 12;
const MORE = 50;
const TAIL = 16; // characters shown of a long name's end, which distinguishes it from its neighbours

/**
 * @param {{line: any, at: number, move: (time: number) => void, zoom: (factor: number) => void, all: () => void,
 *   topics: string[], choose: (topics: string[]) => void, about: string | null}} given `line`: as REST has it; `topics`: whose messages are
 *   read; `about`: the topic that comes first
 */
export function Lanes({ line, at, move, zoom, all, topics, choose, about }) {
  const [search, setSearch] = useState("");
  const [most, setMost] = useState(SHOWN);
  const span = line.until - line.since;
  const width = span / COLUMNS;
  const column = Math.floor((at - line.since) / width);
  const seen = line.topics.filter((/** @type {any} */ one) => one.topic.includes(search)).sort((/** @type {any} */ a, /** @type {any} */ b) => Number(b.topic === about) - Number(a.topic === about));
  const to = (/** @type {number} */ next) => move(Math.min(line.until, Math.max(line.since, next)));
  const key = (/** @type {KeyboardEvent} */ event) => {
    const far = event.shiftKey ? 10 : 1;
    const does = {
      ArrowLeft: () => to(at - far * width), ArrowRight: () => to(at + far * width), PageUp: () => to(at - 10 * width), PageDown: () => to(at + 10 * width),
      Home: () => to(line.since), End: () => to(line.until), "+": () => zoom(1 / 3), "-": () => zoom(3), 0: all,
    }[event.key];
    if (!does || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    does();
  };
  const point = (/** @type {PointerEvent} */ event) => {
    const box = /** @type {Element} */ (event.currentTarget).getBoundingClientRect();
    to(line.since + ((event.clientX - box.left) / box.width) * span);
  };
  const toggle = (/** @type {string} */ topic) => choose(topics.includes(topic) ? topics.filter((one) => one !== topic) : [...topics, topic]);
  const draw = { column, point };
  const said = clock(at / 1e9, span / 1e9);
  return html`<div class="lanes">
    <div class="lane ruler"><span class="lane-name muted small">${said}</span>
      <div class="axis" role="slider" tabindex="0" aria-label="Moment" aria-valuemin="0" aria-valuemax=${COLUMNS - 1} aria-valuenow=${Math.min(COLUMNS - 1, Math.max(0, column))} aria-valuetext=${said} onKeyDown=${key} onPointerDown=${point}>
        ${[0, 1, 2, 3, 4].map((part) => html`<span key=${part} class=${part % 2 ? "odd" : ""}>${clock((line.since + (part * span) / 4) / 1e9, span / 1e9)}</span>`)}
        ${column >= 0 && column < COLUMNS && html`<i class="axis-at" style=${{ left: `${((column + 0.5) / COLUMNS) * 100}%` }}></i>`}</div><span class="lane-count"></span></div>
    ${line.marks.map((/** @type {any} */ one) => html`<${Lane} key=${one.kind} name=${kindOf(one.kind).name} counts=${one.counts} tone=${kindOf(one.kind).tone || "else"} what="event" ...${draw} />`)}
    <div class="lane-search"><input class="input" data-search type="search" aria-label="Search the topics" placeholder=${`Search ${counted(line.topics.length, "topic")}`} value=${search} onInput=${(/** @type {any} */ event) => setSearch(event.target.value)} />
      ${topics.length > 0 && html`<button class="button small" onClick=${() => choose([])}>All topics</button>`}</div>
    ${seen.slice(0, most).map((/** @type {any} */ one) => html`<${Lane} key=${`${one.topic} ${one.type}`} name=${one.topic} counts=${one.counts} tone="flow" what="message" senders=${one.senders} picked=${topics.includes(one.topic)} pick=${() => toggle(one.topic)} ...${draw} />`)}
    ${!seen.length && html`<p class="muted small lane-note">${line.topics.length ? "No topic name matches." : "No message was recorded."}</p>`}
    ${seen.length > most && html`<div class="lane-note"><button class="button small" onClick=${() => setMost(most + MORE)}>${counted(seen.length - most, "more topic")}</button></div>`}
    ${line.more_topics > 0 && html`<p class="muted small lane-note">In the bag only: ${counted(line.more_topics, "topic")} with fewer messages.</p>`}</div>`;
}

/** One lane: its name, a bar for each column, and the total number. */
function Lane(/** @type {any} */ { name, counts, tone, what, senders = [], picked, pick, column, point }) {
  const total = counts.reduce((/** @type {number} */ sum, /** @type {number} */ one) => sum + one, 0);
  const by = senders.map((/** @type {any} */ one) => `${plain(one.node)} ${plain(one.host)}`).join(", ");
  const title = `${plain(name)}: ${counted(total, what)}${by ? ` from ${by}` : ""}`;
  return html`<div class="lane">${pick ? html`<button class="lane-name mono" aria-pressed=${String(picked)} title=${title} onClick=${pick}><${Name} name=${name} /></button>` : html`<span class="lane-name">${name}</span>`}
    <svg class=${`lane-bars ${tone}`} viewBox=${`0 0 ${COLUMNS} ${HEIGHT}`} preserveAspectRatio="none" role="img" aria-label=${title} onPointerDown=${point}>
      ${column >= 0 && column < COLUMNS && html`<rect class="lane-at" x=${column} y="0" width="1" height=${HEIGHT} />`}<path d=${bars(counts)} /></svg>
    <span class="lane-count muted small">${count(total)}</span></div>`;
}

/** A name; its middle is left out if the name does not fit. */
function Name(/** @type {{name: string}} */ { name }) {
  const at = name.length > 2 * TAIL ? name.length - TAIL : name.length;
  return html`<span class="lane-head"><${Given} value=${name.slice(0, at)} most=${120} /></span>${at < name.length && html`<span class="lane-tail"><${Given} value=${name.slice(at)} /></span>`}`;
}

function bars(/** @type {number[]} */ counts) {
  const top = Math.max(1, ...counts);
  return counts.map((value, at) => {
    if (!value) return "";
    const height = LEAST + (value / top) * (HEIGHT - LEAST);
    return `M${at + 0.05} ${HEIGHT}v${-height.toFixed(1)}h.9V${HEIGHT}z`;
  }).join("");
}
