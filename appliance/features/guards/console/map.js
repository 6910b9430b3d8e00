/** The map of a fence: its polygon, the robot's position and its trail; the corners of a new polygon can be moved. */

import { html, useEffect, useId, useRef, useState } from "#console/html.js";
import { depth, short } from "./geometry.js";

const ROOM = 1; // metres around what is drawn
const STEPS = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000];
const LINES = 8; // most lines of the grid in a direction
const WIDE = 3; // the grid goes on to both sides, since the map may be wider than what is drawn
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

/** @typedef {import("./geometry.js").Point} Point */

/**
 * @param {{name: string, polygon: Point[], margin: number, robot: (Point & {turned: number | null}) | null, where: string, old?: boolean,
 *   trail: (Point & {turned: number | null})[], draft?: Point[] | null, move?: (index: number, to: Point) => void}} given
 *   `robot`: where the guard has it, `where` says so, `old`: perhaps no longer there; `trail`: seen positions; `draft`: a new
 *   polygon, whose corners `move` moves
 */
export function FenceMap({ name, polygon, margin, robot, where, old = false, trail, draft = null, move }) {
  const id = useId();
  const drawing = useRef(/** @type {SVGSVGElement | null} */ (null));
  const [held, setHeld] = useState(/** @type {number | null} */ (null));
  const frame = useFrame([...polygon, ...(draft ?? []), ...trail, ...(robot ? [robot] : [])], held !== null);
  const bounds = draft ?? polygon;
  const outside = trail.filter((one) => depth(one, bounds) < margin).length;
  const pixel = Math.max(frame.width, frame.height) / 320;
  const at = (/** @type {PointerEvent} */ event) => {
    const matrix = drawing.current?.getScreenCTM()?.inverse();
    const { x, y } = new DOMPoint(event.clientX, event.clientY).matrixTransform(matrix);
    return { x: tenth(x), y: tenth(-y) };
  };
  const key = (/** @type {KeyboardEvent} */ event, /** @type {number} */ index, /** @type {Point} */ corner) => {
    const step = ARROWS[/** @type {keyof typeof ARROWS} */ (event.key)];
    if (!step || !move) return;
    event.preventDefault();
    const size = event.shiftKey ? 1 : 0.1;
    move(index, { x: tenth(corner.x + step[0] * size), y: tenth(corner.y + step[1] * size) });
  };
  return html`<figure class="fence">
    <svg ref=${drawing} class="fence-map" viewBox=${`${frame.x} ${-frame.y - frame.height} ${frame.width} ${frame.height}`} role=${move ? "group" : "img"} aria-label=${`Map of ${name}. ${where}`}
      onPointerMove=${(/** @type {PointerEvent} */ event) => held !== null && move?.(held, at(event))} onPointerUp=${() => setHeld(null)} onPointerCancel=${() => setHeld(null)}>
      <clipPath id=${id}><polygon points=${points(bounds)} /></clipPath>
      ${lines(frame.x - WIDE * frame.width, (1 + 2 * WIDE) * frame.width, frame.step).map((x) => html`<line key=${`x${x}`} class="fence-grid" x1=${x} x2=${x} y1=${-frame.y} y2=${-frame.y - frame.height} /><text class="fence-tick" x=${x + 2 * pixel} y=${-frame.y - 3 * pixel} font-size=${9 * pixel}>${short(x)}</text>`)}
      ${lines(frame.y, frame.height, frame.step).map((y) => html`<line key=${`y${y}`} class="fence-grid" x1=${frame.x - WIDE * frame.width} x2=${frame.x + (1 + WIDE) * frame.width} y1=${-y} y2=${-y} />${y > frame.y + 14 * pixel && html`<text class="fence-tick" x=${frame.x + 2 * pixel} y=${-y - 2 * pixel} font-size=${9 * pixel}>${short(y)}</text>`}`)}
      ${draft && html`<polygon class="fence-before" points=${points(polygon)} />`}
      <polygon class="fence-area" points=${points(bounds)} />
      ${margin > 0 && html`<polygon class="fence-margin" clip-path=${`url(#${id})`} points=${points(bounds)} stroke-width=${2 * margin} />`}
      <polygon class="fence-edge" points=${points(bounds)} />
      ${trail.length > 1 && html`<polyline class="fence-trail" points=${points(trail)} />`}
      ${robot && html`<g class=${`fence-robot${depth(robot, bounds) < margin ? " out" : ""}${old ? " old" : ""}`} transform=${`translate(${robot.x} ${-robot.y}) rotate(${(-(robot.turned ?? 0) * 180) / Math.PI}) scale(${pixel})`}>
        ${robot.turned === null ? html`<circle r="6" />` : html`<path d="M10 0L-7 6L-4 0L-7 -6z" />`}</g>`}
      ${draft && move && draft.map((corner, index) => html`<circle key=${index} class="fence-corner" tabindex="0" role="button" cx=${corner.x} cy=${-corner.y} r=${7 * pixel}
        aria-label=${`Corner ${index + 1}: ${short(corner.x)}, ${short(corner.y)}. The arrow keys move it by 0.1 m, with Shift by 1 m.`} onKeyDown=${(/** @type {KeyboardEvent} */ event) => key(event, index, corner)}
        onPointerDown=${(/** @type {PointerEvent} */ event) => { /** @type {Element} */ (event.currentTarget).setPointerCapture(event.pointerId); setHeld(index); }} />`)}
    </svg>
    <figcaption class="muted small">${where} The grid is ${short(frame.step)} m.${trail.length > 1 ? ` ${outside} of ${trail.length} seen positions are outside${margin ? `, or within ${short(margin)} m of the edge` : ""}.` : ""}</figcaption></figure>`;
}

/** The part of the plane that is drawn. It stays while a corner is held. @param {Point[]} shown @param {boolean} held */
function useFrame(shown, held) {
  const kept = useRef(/** @type {ReturnType<typeof frameOf> | null} */ (null));
  const frame = held && kept.current ? kept.current : frameOf(shown);
  useEffect(() => {
    kept.current = frame;
  });
  return frame;
}

function frameOf(/** @type {Point[]} */ shown) {
  const [xs, ys] = [shown.map((one) => one.x), shown.map((one) => one.y)];
  const [x, y] = [Math.min(...xs) - ROOM, Math.min(...ys) - ROOM];
  const [width, height] = [Math.max(...xs) + ROOM - x, Math.max(...ys) + ROOM - y];
  const step = STEPS.find((one) => Math.max(width, height) / one <= LINES) ?? Math.max(width, height) / LINES;
  return { x, y, width, height, step };
}

function lines(/** @type {number} */ from, /** @type {number} */ length, /** @type {number} */ step) {
  const first = Math.ceil(from / step);
  return Array.from({ length: Math.max(0, Math.floor((from + length) / step) - first + 1) }, (_, index) => (first + index) * step);
}

function points(/** @type {Point[]} */ corners) {
  return corners.map(({ x, y }) => `${x},${-y}`).join(" ");
}

const tenth = (/** @type {number} */ value) => Math.round(value * 10) / 10;
