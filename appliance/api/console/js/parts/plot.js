/** A chart of curves over time; the legend shows the values under the pointer. */

import { html, useEffect, useRef, useState } from "../html.js";
import { minute } from "../moments.js";
import { rate } from "../numbers.js";

const LEFT = 44;
const BOTTOM = 20;
const TOP = 6;

/** @typedef {{name: string, colour: "c1" | "c2" | "c3" | "c4", points: {time: number, value: number | null}[], lately?: number | null}} Series `lately`: the average of the last minute, for the legend */

/** @param {{label: string, series: Series[], span?: number, height?: number, unit?: string, say?: (value: number | null) => string}} given `span`: seconds shown */
export function Plot({ label, series, span = 900, height = 148, unit = "/s", say = rate }) {
  const box = useRef(/** @type {HTMLElement | null} */ (null));
  const width = useWidth(box);
  const [at, setAt] = useState(/** @type {number | null} */ (null));
  const end = Math.max(0, ...series.map((one) => one.points.at(-1)?.time ?? 0)) || Date.now() / 1000;
  const start = end - span;
  const within = series.map((one) => ({ ...one, points: one.points.filter((point) => point.time >= start) }));
  const values = within.flatMap((one) => one.points.map((point) => point.value ?? 0));
  const top = ceiling(Math.max(0, ...values));
  const least = Math.min(0, ...values);
  const bottom = least < 0 ? -ceiling(-least) : 0;
  const x = (/** @type {number} */ time) => LEFT + ((time - start) / span) * Math.max(1, width - LEFT);
  const y = (/** @type {number} */ value) => TOP + (1 - (value - bottom) / (top - bottom)) * (height - TOP - BOTTOM);
  const moment = at === null ? null : start + ((at - LEFT) / Math.max(1, width - LEFT)) * span;
  const move = (/** @type {PointerEvent} */ event) => {
    const place = event.clientX - /** @type {Element} */ (event.currentTarget).getBoundingClientRect().left;
    setAt(place < LEFT || place > width ? null : place);
  };
  const said = within.map((one) => ({ ...one, now: moment === null ? one.lately ?? nearest(one.points, null) : nearest(one.points, moment) }));
  const averaged = moment === null && said.some((one) => (one.lately ?? null) !== null);
  return html`<div class="stack-tight">
    <ul class="plot-legend">${said.map((one) => html`<li key=${one.name}><span class=${`swatch ${one.colour}`}></span>${one.name} <b>${say(one.now)}</b>${unit}</li>`)}
      ${moment !== null && html`<li class="muted">${minute(moment)}</li>`}${averaged && html`<li class="muted">in the last minute</li>`}</ul>
    <div class="plot plot-box" ref=${box}>
      ${width > 0 && html`<svg height=${height} viewBox=${`0 0 ${width} ${height}`} role="img" aria-label=${`${label}: ${said.map((one) => `${one.name} ${say(one.now)}${unit}`).join(", ")}`}
        onPointerMove=${move} onPointerLeave=${() => setAt(null)}>
        ${[bottom, (bottom + top) / 2, top].map((line) => html`<line key=${line} class="grid-line" x1=${LEFT} x2=${width} y1=${y(line)} y2=${y(line)} />
          <text class="tick" x=${LEFT - 8} y=${y(line) + 4} text-anchor="end">${say(line)}</text>`)}
        ${ticks(start, end, width).map((time) => html`<text key=${time} class="tick" x=${x(time)} y=${height - 4} text-anchor="middle">${minute(time)}</text>`)}
        ${within.map((one) => html`<path key=${`a${one.name}`} class=${`area ${one.colour}`} d=${area(one.points, x, y)} /><path key=${one.name} class=${`curve ${one.colour}`} d=${curve(one.points, x, y)} />`)}
        ${at !== null && html`<line class="cursor" x1=${at} x2=${at} y1=${TOP} y2=${height - BOTTOM} />`}
      </svg>`}
    </div></div>`;
}

/** A small curve without axes. @param {{points: {time: number, value: number | null}[], colour: string, label: string}} given */
export function Sparkline({ points, colour, label }) {
  const width = 96;
  const height = 22;
  const top = Math.max(1e-9, ...points.map((one) => one.value ?? 0));
  const first = points[0]?.time ?? 0;
  const span = Math.max(1, (points.at(-1)?.time ?? 1) - first);
  const x = (/** @type {number} */ time) => ((time - first) / span) * width;
  const y = (/** @type {number} */ value) => height - 2 - (value / top) * (height - 4);
  return html`<span class="plot" role="img" aria-label=${label}><svg viewBox=${`0 0 ${width} ${height}`} style=${{ width: `${width}px`, height: `${height}px` }}>
    <path class=${`area ${colour}`} d=${area(points, x, y)} /><path class=${`curve ${colour}`} d=${curve(points, x, y)} /></svg></span>`;
}

/** @typedef {(value: number) => number} Scale */

function curve(/** @type {Series["points"]} */ points, /** @type {Scale} */ x, /** @type {Scale} */ y) {
  let pen = false;
  const said = [];
  for (const { time, value } of points) {
    if (value === null) pen = false;
    else {
      said.push(`${pen ? "L" : "M"}${x(time).toFixed(1)} ${y(value).toFixed(1)}`);
      pen = true;
    }
  }
  return said.join("");
}

function area(/** @type {Series["points"]} */ points, /** @type {Scale} */ x, /** @type {Scale} */ y) {
  const known = points.filter((one) => one.value !== null);
  if (known.length < 2) return "";
  return `${curve(known, x, y)}L${x(known[known.length - 1].time).toFixed(1)} ${y(0)}L${x(known[0].time).toFixed(1)} ${y(0)}Z`;
}

function nearest(/** @type {Series["points"]} */ points, /** @type {number | null} */ moment) {
  if (moment === null) return points.at(-1)?.value ?? null;
  let best = /** @type {Series["points"][number] | null} */ (null);
  for (const one of points) if (best === null || Math.abs(one.time - moment) < Math.abs(best.time - moment)) best = one;
  return best?.value ?? null;
}

/** The end of the axis: 1, 2 or 5 times a power of ten. */
function ceiling(/** @type {number} */ value) {
  if (value <= 0.5) return 1;
  const power = 10 ** Math.floor(Math.log10(value));
  return /** @type {number} */ ([1, 2, 5, 10].find((one) => one * power >= value)) * power;
}

function ticks(/** @type {number} */ start, /** @type {number} */ end, /** @type {number} */ width) {
  const most = Math.max(2, Math.floor(width / 110));
  const step = /** @type {number} */ ([60, 120, 300, 600, 900, 1800, 3600].find((one) => (end - start) / one <= most) ?? 3600);
  const found = [];
  for (let time = Math.ceil(start / step) * step; time <= end; time += step) if (time - start > (end - start) * 0.03 && end - time > (end - start) * 0.03) found.push(time);
  return found;
}

function useWidth(/** @type {{current: HTMLElement | null}} */ ref) {
  const [width, set] = useState(0);
  useEffect(() => {
    const element = ref.current;
    if (!element) return undefined;
    const observer = new ResizeObserver(() => set(element.clientWidth));
    observer.observe(element);
    set(element.clientWidth);
    return () => observer.disconnect();
  }, []);
  return width;
}
