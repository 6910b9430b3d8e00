/** The drawing: boxes for nodes, topics and services, lines for messages, red lines for denials. */

import { html, useEffect, useRef, useState } from "../html.js";
import { Icon } from "../parts/icon.js";
import { counted, rate } from "../numbers.js";
import { plain } from "../words.js";
import { extent } from "./arrange.js";

const MARGIN = 24;
const NARROW_MARGIN = 8;
const CLOSEST = 2.5;
const FARTHEST = 0.27; // at this zoom a box is as high as its name, which is never drawn smaller than readable
const NARROW_LEAST = 0.5; // a telephone shows names rather than everything
const BOW = 46;
const NARROW_BOW = 10;
const NAME = 11.5; // font size of a name on the screen
const SUB = 10.5; // of the line below it
const GLYPH = 0.61; // width of a letter in the name's typeface, as a fraction of the font size
const SUB_GLYPH = 0.54;
const TWO_LINES = 30; // least height of a box with two lines on the screen

/** @typedef {{x: number, y: number, zoom: number}} Look the corner of what is seen, and how large it is drawn */

/** @param {{items: Map<string, any>, lines: Map<string, any>, spots: Map<string, any>, chosen: string | null, choose: (key: string | null) => void, arranged: number, narrow: boolean}} given */
export function Drawing({ items, lines, spots, chosen, choose, arranged, narrow }) {
  const box = useRef(/** @type {HTMLElement | null} */ (null));
  const [look, setLook] = useState(/** @type {Look} */ ({ x: 0, y: 0, zoom: 1 }));
  const all = withBows(extent(spots.values()), narrow ? NARROW_BOW : BOW);
  const own = useRef(false); // whether the user chose the view box; until then everything is shown
  const fit = () => {
    own.current = false;
    if (box.current) setLook(fitted(all, box.current, narrow));
  };
  const newest = useRef(fit);
  newest.current = fit;
  useEffect(() => fit(), [arranged, spots.size > 0]);
  useEffect(() => {
    if (!own.current) fit(); // a new item is outside the view box
  }, [all.x, all.y, all.w, all.h]);
  useEffect(() => {
    if (!box.current) return undefined;
    const observer = new ResizeObserver(() => own.current || newest.current());
    observer.observe(box.current);
    return () => observer.disconnect();
  }, []);
  const zoom = (/** @type {number} */ factor, /** @type {number} */ px, /** @type {number} */ py) => {
    own.current = true;
    setLook((now) => zoomed(now, factor, px, py));
  };
  const move = (/** @type {number} */ dx, /** @type {number} */ dy) => {
    own.current = true;
    setLook((now) => ({ ...now, x: now.x - dx / now.zoom, y: now.y - dy / now.zoom }));
  };
  const middle = (/** @type {number} */ factor) => box.current && zoom(factor, box.current.clientWidth / 2, box.current.clientHeight / 2);
  usePanning(box, move, zoom);
  const near = chosen ? neighbours(chosen, lines) : null;
  const key = (/** @type {KeyboardEvent} */ event) => {
    const step = { ArrowLeft: [-60, 0], ArrowRight: [60, 0], ArrowUp: [0, -60], ArrowDown: [0, 60] }[event.key];
    if (step) move(-step[0], -step[1]);
    else if (event.key === "+" || event.key === "=") middle(1.25);
    else if (event.key === "-") middle(0.8);
    else if (event.key === "0") fit();
    else if (event.key === "Escape") choose(null);
    else return;
    event.preventDefault();
  };
  return html`<div class="drawing" ref=${box} onKeyDown=${key} data-items=${items.size}>
    <svg role="group" aria-label="Graph of nodes and topics" onClick=${(/** @type {any} */ event) => event.target === event.currentTarget && choose(null)}>
      <defs><${Tip} id="tip-flow" /><${Tip} id="tip-mediated" /><${Tip} id="tip-denied" /><${Tip} id="tip-would" /></defs>
      <g transform=${`scale(${look.zoom}) translate(${-look.x} ${-look.y})`}>
        ${[...lines.values()].map((line) => html`<${Line} key=${line.key} line=${line} spots=${spots} chosen=${chosen} near=${near} choose=${choose} narrow=${narrow} zoom=${look.zoom} />`)}
        ${[...items.values()].map((item) => html`<${Box} key=${item.key} item=${item} spot=${spots.get(item.key)} chosen=${chosen === item.key} faint=${near !== null && !near.has(item.key)} zoom=${look.zoom} choose=${choose} />`)}
      </g></svg>
    <div class="drawing-tools">
      <button class="button small" onClick=${() => middle(1.25)} aria-label="Closer"><${Icon} name="plus" size=${16} /></button>
      <button class="button small" onClick=${() => middle(0.8)} aria-label="Farther"><${Icon} name="minus" size=${16} /></button>
      <button class="button small" onClick=${fit} aria-label="Show all" title="Show all (0)"><${Icon} name="fit" size=${16} /></button>
    </div></div>`;
}

function Tip(/** @type {{id: string}} */ { id }) {
  return html`<marker id=${id} class=${id} viewBox="0 0 8 8" refX="7" refY="4" markerUnits="userSpaceOnUse" markerWidth="10" markerHeight="10" orient="auto"><path d="M0 0.500L8 4L0 7.500z" /></marker>`;
}

function Box(/** @type {any} */ { item, spot, chosen, faint, zoom, choose }) {
  if (!spot) return null;
  const { x, y, w, h } = spot;
  // Zoomed out, both lines keep their size on the screen; the second is shortened, and then hidden.
  const least = Math.max(1, 1 / zoom);
  const [size, small] = [NAME * least, SUB * least];
  const left = item.mediated ? 25 : 14;
  const name = label(item.name, Math.floor((w - left - 8) / (size * GLYPH)));
  const two = h * zoom >= TWO_LINES;
  const sub = second(item, name, Math.floor((w - left - 6) / (small * SUB_GLYPH)));
  const state = [item.kind, item.members ? "many" : "", item.owners ? "impostor" : "", item.mediated ? "mediated" : "", item.lost ? "lost" : "", chosen ? "chosen" : "", faint ? "faint" : ""].filter(Boolean).join(" ");
  const said = `${item.members ? "group " : ""}${item.kind} ${plain(item.name, 120)}, ${plain(item.sub, 60)}${item.mediated ? ", mediated" : ""}${item.rate ? `, ${rate(item.rate)} messages/s` : ""}${item.lost ? ", lost" : ""}`;
  const pick = (/** @type {any} */ event) => {
    if (event.type === "keydown" && event.key !== "Enter" && event.key !== " ") return;
    event.preventDefault();
    event.stopPropagation();
    choose(item.key);
  };
  const round = item.kind === "node" || item.kind === "party" || item.kind === "master" ? 8 : h / 2;
  return html`<g class=${`box ${state}`} transform=${`translate(${x - w / 2} ${y - h / 2})`} tabindex="0" role="button" aria-label=${said} data-key=${item.key} onClick=${pick} onKeyDown=${pick}>
    ${item.members && html`<rect class="behind" x="4" y="4" width=${w} height=${h} rx=${round} />`}
    <rect class="shape" width=${w} height=${h} rx=${round} />
    ${item.mediated && html`<circle class="mark" cx=${14} cy=${h / 2} r="3.500" />`}
    <text class="box-name" x=${left} y=${two ? h / 2 - size * 0.15 : h / 2 + size * 0.35} font-size=${size}>${name}</text>
    ${two && html`<text class="box-sub" x=${left} y=${h / 2 + small * 1.12} font-size=${small}>${sub}</text>`}
    <title>${said}</title></g>`;
}

function Line(/** @type {any} */ { line, spots, chosen, near, choose, narrow, zoom }) {
  const from = spots.get(line.from);
  const to = spots.get(line.to);
  if (!from || !to) return null;
  const path = narrow ? between(from, to) : curve(from, to, spots);
  const own = chosen === line.key;
  const touched = near === null || own || line.from === chosen || line.to === chosen;
  const kind = line.kind === "denied" ? (line.would ? "would" : "denied") : line.mediated ? "mediated" : "flow";
  const shape = html`<path class=${`line ${kind}${line.kind === "flow" && line.rate > 0 ? " flowing" : ""}${touched ? "" : " faint"}${own ? " chosen" : ""}`} d=${path} marker-end=${`url(#tip-${kind})`} />`;
  if (line.kind !== "denied") return html`<g>${shape}${touched && near !== null && line.rate > 0 && (line.from !== chosen || !chosen.startsWith("t/")) && html`<text class="line-rate" font-size=${SUB * Math.max(1, 1 / zoom)} x=${(from.x + to.x) / 2} y=${(from.y + to.y) / 2 - 5} text-anchor="middle">${rate(line.rate)}/s</text>`}</g>`;
  const times = line.denials.reduce((/** @type {number} */ sum, /** @type {any} */ one) => sum + (one.equality?.times ?? 1), 0);
  const said = `denied: ${plain(line.from.replace(/^x?@?|^./, ""), 60)} to ${plain(line.to.slice(1), 60)}, ${counted(times, "time")}`;
  const pick = (/** @type {any} */ event) => {
    if (event.type === "keydown" && event.key !== "Enter" && event.key !== " ") return;
    event.preventDefault();
    event.stopPropagation();
    choose(line.key);
  };
  return html`<g class="attempt" tabindex="0" role="button" aria-label=${said} data-key=${line.key} onClick=${pick} onKeyDown=${pick}>
    <path class="reach" d=${path} />${shape}<title>${said}</title></g>`;
}

/** A line from the right side of one box to the left side of the other. A line that goes back, or to
 * a lower band, passes below all boxes of its band on its way; the longer it is, the further out it runs, beside the other lines. */
function curve(/** @type {any} */ from, /** @type {any} */ to, /** @type {Map<string, any>} */ spots) {
  const x1 = from.x + from.w / 2;
  const x2 = to.x - to.w / 2 - 2;
  if (x2 > x1 - 20) {
    const bend = Math.max(24, (x2 - x1) / 2);
    return `M${x1} ${from.y}C${x1 + bend} ${from.y} ${x2 - bend} ${to.y} ${x2} ${to.y}`;
  }
  const passed = [...spots.values()].filter((spot) => !spot.alone && spot.band === from.band && spot.x + spot.w / 2 > x2 && spot.x - spot.w / 2 < x1);
  const low = Math.max(...passed.map((spot) => spot.y + spot.h / 2)) + 14 + Math.abs(x1 - x2) * 0.03;
  const aside = Math.min(24, 4 + Math.abs(x1 - x2) * 0.01);
  const way = to.y > low ? `16V${to.y - 16}q0 16 16 16` : `-16V${to.y + 16}q0 -16 16 -16`;
  return `M${x1} ${from.y}h${aside}q16 0 16 16V${low - 16}q0 16 -16 16H${x2 - aside}q-16 0 -16 ${way}h${aside}`;
}

/** A line in the layout with two columns: between the inner sides of two boxes, through the space between the columns. */
function between(/** @type {any} */ from, /** @type {any} */ to) {
  const inner = (/** @type {any} */ spot, /** @type {number} */ out) => spot.x + (spot.x < 0 ? 1 : -1) * (spot.w / 2 + out);
  return `M${inner(from, 0)} ${from.y}C${inner(from, BOW)} ${from.y} ${inner(to, BOW)} ${to.y} ${inner(to, 2)} ${to.y}`;
}

/** A name in at most so many letters: without its first namespaces, or without its end. @param {string} text @param {number} most */
export function label(text, most) {
  const said = plain(text, 400);
  const words = said.split("/");
  for (let from = 1; from < words.length && !said.includes(" … "); from += 1) {
    const part = from === 1 ? said : words.slice(from).join("/");
    if ([...part].length <= most) return part;
  }
  const last = said.includes(" … ") ? said : words[words.length - 1];
  return [...last].length <= most ? last : `${[...last].slice(0, Math.max(1, most - 1)).join("")}…`;
}

/** The second line: what `label` left out, what it is, and its rate, as far as there is room. @param {any} item @param {string} name @param {number} most */
function second(item, name, most) {
  const said = plain(item.name, 400);
  const space = !item.members && name !== said && said.endsWith(`/${name}`) ? said.slice(0, -name.length - 1) : "";
  const flow = item.rate ? `${rate(item.rate)}/s` : "";
  const sub = plain(item.sub, 200);
  const messages = flow && `${flow.slice(0, -2)} messages/s`;
  const forms = [[space, sub, messages], [item.brief ?? space, messages], [space, sub, flow], [item.brief ?? space, flow], [sub, flow], [item.brief ?? sub], [flow]];
  const fitting = forms.map((form) => form.filter(Boolean).join(" · ")).find((form) => form && [...form].length <= most);
  return fitting ?? `${[...(space || sub)].slice(0, Math.max(1, most - 1)).join("")}…`;
}

function neighbours(/** @type {string} */ chosen, /** @type {Map<string, any>} */ lines) {
  const near = new Set([chosen]);
  for (const line of lines.values()) {
    if (line.key === chosen || line.from === chosen || line.to === chosen) {
      near.add(line.from);
      near.add(line.to);
    }
  }
  return near;
}

/** The rectangle, enlarged for the lines that go back around the outermost boxes. */
function withBows(/** @type {{x: number, y: number, w: number, h: number}} */ { x, y, w, h }, /** @type {number} */ bow) {
  return { x: x - bow, y, w: w + 2 * bow, h: h + bow };
}

function fitted(/** @type {{x: number, y: number, w: number, h: number}} */ all, /** @type {HTMLElement} */ box, /** @type {boolean} */ narrow) {
  const margin = narrow ? NARROW_MARGIN : MARGIN;
  const zoom = Math.min(1.15, (box.clientWidth - 2 * margin) / all.w, (box.clientHeight - 2 * margin) / all.h);
  const least = narrow ? Math.min(NARROW_LEAST, (box.clientWidth - margin) / all.w) : FARTHEST;
  const readable = Math.max(zoom, least); // the user pans to see the rest
  const [w, h] = [box.clientWidth / readable, box.clientHeight / readable];
  return { zoom: readable, x: all.w < w ? all.x - (w - all.w) / 2 : all.x - margin / readable, y: all.h < h ? all.y - (h - all.h) / 2 : all.y - margin / readable };
}

function zoomed(/** @type {Look} */ now, /** @type {number} */ factor, /** @type {number} */ px, /** @type {number} */ py) {
  const zoom = Math.min(CLOSEST, Math.max(FARTHEST, now.zoom * factor));
  return { zoom, x: now.x + px / now.zoom - px / zoom, y: now.y + py / now.zoom - py / zoom };
}

function usePanning(/** @type {{current: HTMLElement | null}} */ box, /** @type {(dx: number, dy: number) => void} */ pan, /** @type {(factor: number, x: number, y: number) => void} */ zoom) {
  useEffect(() => {
    const element = box.current;
    if (!element) return undefined;
    const fingers = new Map();
    let moved = 0;
    const down = (/** @type {PointerEvent} */ event) => {
      if (/** @type {Element} */ (event.target).closest(".drawing-tools")) return;
      if (!fingers.size) moved = 0;
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
    };
    const move = (/** @type {PointerEvent} */ event) => {
      const last = fingers.get(event.pointerId);
      if (!last) return;
      const [dx, dy] = [event.clientX - last[0], event.clientY - last[1]];
      moved += Math.abs(dx) + Math.abs(dy);
      if (moved > 4 && !element.hasPointerCapture(event.pointerId)) element.setPointerCapture(event.pointerId);
      if (fingers.size === 2) {
        const other = [...fingers.entries()].find(([id]) => id !== event.pointerId)?.[1];
        const apart = (/** @type {number[]} */ a, /** @type {number[]} */ b) => Math.hypot(a[0] - b[0], a[1] - b[1]);
        const place = element.getBoundingClientRect();
        zoom(apart([event.clientX, event.clientY], other) / Math.max(1, apart(last, other)), (event.clientX + other[0]) / 2 - place.left, (event.clientY + other[1]) / 2 - place.top);
      } else pan(dx, dy);
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
    };
    const up = (/** @type {PointerEvent} */ event) => fingers.delete(event.pointerId);
    const click = (/** @type {MouseEvent} */ event) => {
      if (moved > 4) event.stopPropagation();
    };
    const wheel = (/** @type {WheelEvent} */ event) => {
      event.preventDefault();
      const place = element.getBoundingClientRect();
      zoom(Math.exp(-event.deltaY * 0.0015), event.clientX - place.left, event.clientY - place.top);
    };
    element.addEventListener("pointerdown", down);
    element.addEventListener("pointermove", move);
    element.addEventListener("pointerup", up);
    element.addEventListener("pointercancel", up);
    element.addEventListener("click", click, true);
    element.addEventListener("wheel", wheel, { passive: false });
    return () => {
      element.removeEventListener("pointerdown", down);
      element.removeEventListener("pointermove", move);
      element.removeEventListener("pointerup", up);
      element.removeEventListener("pointercancel", up);
      element.removeEventListener("click", click, true);
      element.removeEventListener("wheel", wheel);
    };
  }, []);
}
