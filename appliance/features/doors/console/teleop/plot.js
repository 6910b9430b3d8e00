/** The plot of a numeric field over the last minute. */

import { html, useEffect, useId, useRef, useState } from "/console/static/vendor/preact.js";
import { firstField, numericFields, valueOf } from "./fields.js";

const SPAN = 60_000; // milliseconds
const INTERVAL = 50; // least milliseconds between two values
const PRESENT = 2000; // milliseconds: the age of a value that needs no word
const LEFT = 52;
const BOTTOM = 18;
const TOP = 6;

/** @typedef {{time: number, value: number | null}} Point */

export function FieldPlot(/** @type {import("./picture.js").Given} */ { parts, door, topics }) {
  const [topic, setTopic] = useState("");
  const [field, setField] = useState("");
  const [fields, setFields] = useState(/** @type {string[]} */ ([]));
  const [wrong, setWrong] = useState("");
  const [said, setSaid] = useState("");
  const points = useRef(/** @type {Point[]} */ ([]));
  const shown = useRef("");
  const canvas = useRef(/** @type {HTMLCanvasElement | null} */ (null));
  const list = useId();
  const show = (/** @type {string} */ path) => {
    shown.current = path;
    points.current = [];
    setField(path);
  };
  useEffect(() => {
    show("");
    setFields([]);
    setWrong("");
    setSaid("");
    if (!topic) return undefined;
    const heard = (/** @type {any} */ message) => {
      setFields((known) => (known.length ? known : numericFields(message)));
      if (!shown.current) show(firstField(numericFields(message)));
      const time = performance.now();
      points.current.push({ time, value: valueOf(message, shown.current) });
      while (points.current[0].time < time - SPAN) points.current.shift();
    };
    const leave = door.subscribe(topic, { interval: INTERVAL }, heard, setWrong);
    const timer = setInterval(() => {
      draw(canvas.current, points.current);
      setSaid(newest(points.current.at(-1)));
    }, 100);
    return () => {
      clearInterval(timer);
      leave();
    };
  }, [door, topic]);
  return html`<section class="stack-tight" aria-label="Plot"><h3>Plot</h3>
    <div class="form-grid"><${parts.Field} label="Topic" value=${topic} set=${setTopic} options=${[["", "choose a topic"], ...topics.map(({ name }) => [name, name])]} />
      <${parts.Field} label="Field" mono value=${field} set=${show} list=${list} disabled=${!topic} /></div>
    <datalist id=${list}>${fields.map((one) => html`<option key=${one} value=${one}></option>`)}</datalist>
    ${wrong && html`<${parts.Notice} tone="deny" role="alert"><${parts.Given} value=${wrong} most=${600} /></${parts.Notice}>`}
    ${topic && html`<canvas class="door-plot" ref=${canvas} role="img" aria-label=${`${field} of ${topic}: ${said}`}></canvas>
      <span class="muted small"><${parts.Given} value=${field} mono most=${80} /> <b>${said}</b>, last 60 s</span>`}</section>`;
}

/** Draw the points with the present size and colours of the page. */
function draw(/** @type {HTMLCanvasElement | null} */ canvas, /** @type {Point[]} */ points) {
  const pen = canvas?.getContext("2d");
  if (!canvas || !pen) return;
  const [width, height, ratio] = [canvas.clientWidth, canvas.clientHeight, devicePixelRatio];
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    Object.assign(canvas, { width: Math.round(width * ratio), height: Math.round(height * ratio) });
  }
  const colours = getComputedStyle(canvas);
  const colour = (/** @type {string} */ name) => colours.getPropertyValue(name);
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  const [least, most] = bounds(points);
  const now = performance.now();
  const x = (/** @type {number} */ time) => LEFT + (1 - (now - time) / SPAN) * (width - LEFT - 1);
  const y = (/** @type {number} */ value) => TOP + (1 - (value - least) / (most - least)) * (height - TOP - BOTTOM);
  pen.font = `11px ${colour("font-family")}`;
  pen.fillStyle = colour("--muted");
  pen.strokeStyle = colour("--line");
  pen.textAlign = "right";
  for (const value of [least, (least + most) / 2, most]) {
    line(pen, [[LEFT, Math.round(y(value)) + 0.5], [width, Math.round(y(value)) + 0.5]]);
    pen.fillText(say(value), LEFT - 6, y(value) + 4);
  }
  pen.textAlign = "center";
  for (const seconds of [45, 30, 15]) pen.fillText(`−${seconds} s`, x(now - seconds * 1000), height - 4);
  pen.strokeStyle = pen.fillStyle = colour("--plot-1");
  pen.lineWidth = 1.6;
  for (const piece of pieces(points)) {
    if (piece.length === 1) pen.fillRect(x(piece[0].time) - 1, y(piece[0].value) - 1, 2, 2);
    else line(pen, piece.map(({ time, value }) => [x(time), y(value)]));
  }
  pen.lineWidth = 1;
}

/** The lines between the gaps that NaN makes. @param {Point[]} points @returns {{time: number, value: number}[][]} */
export function pieces(points) {
  const found = /** @type {any[][]} */ ([[]]);
  for (const one of points) {
    if (one.value === null) found.push([]);
    else found[found.length - 1].push(one);
  }
  return found.filter((one) => one.length);
}

/** The ends of the axis, never equal. @param {Point[]} points @returns {[number, number]} */
export function bounds(points) {
  let [least, most] = [Infinity, -Infinity];
  for (const { value } of points) if (value !== null) [least, most] = [Math.min(least, value), Math.max(most, value)];
  if (least > most) return [0, 1];
  const room = (most - least) * 0.05 || Math.abs(most) * 0.05 || 1;
  return [least - room, most + room];
}

function line(/** @type {CanvasRenderingContext2D} */ pen, /** @type {number[][]} */ points) {
  pen.beginPath();
  for (const [x, y] of points) pen.lineTo(x, y);
  pen.stroke();
}

/** The newest value in words, with its age once it is not the present one. */
function newest(/** @type {Point | undefined} */ point) {
  if (!point) return "no value yet";
  const age = performance.now() - point.time;
  return `${point.value === null ? "NaN" : say(point.value)}${age < PRESENT ? "" : `, ${Math.round(age / 1000)} s ago`}`;
}

function say(/** @type {number} */ value) {
  return String(Number(value.toPrecision(4)));
}
