/** The picture of a camera: the newest image of a topic, and no queue of older ones. */

import { html, useEffect, useRef, useState } from "/console/static/vendor/preact.js";
import { decoded } from "./pixels.js";

const TYPES = { "sensor_msgs/CompressedImage": 100, "sensor_msgs/Image": 250 }; // least milliseconds between two images
const SHOWN = 2000; // milliseconds between two changes of the text

/** @typedef {{parts: any, door: import("./connection.js").DoorConnection, topics: {name: string, type: string}[], freshness: import("./freshness.js").Freshness}} Given */

export function Picture(/** @type {Given} */ { parts, door, topics, freshness }) {
  const images = topics.filter(({ type }) => type in TYPES);
  const [chosen, setChosen] = useState(/** @type {string | null} */ (null));
  const topic = chosen ?? images[0]?.name ?? "";
  const type = images.find(({ name }) => name === topic)?.type;
  const [wrong, setWrong] = useState("");
  const [about, setAbout] = useState("");
  const canvas = useRef(/** @type {HTMLCanvasElement | null} */ (null));
  useEffect(() => {
    setWrong("");
    setAbout("");
    freshness.begin(Boolean(type));
    if (!type) return undefined;
    const drawing = newestOnly(({ message }) => decoded(message), (picture, { message, arrived }) => {
      draw(canvas.current, picture);
      freshness.drawn(message.data, arrived);
      setWrong("");
    }, (error) => setWrong(error.message));
    const heard = (/** @type {any} */ message) => drawing.give({ message, arrived: performance.now() });
    const leave = door.subscribe(topic, { interval: TYPES[/** @type {keyof typeof TYPES} */ (type)], newest: true }, heard, setWrong);
    const timer = setInterval(() => setAbout(drawing.about(SHOWN)), SHOWN);
    return () => {
      clearInterval(timer);
      drawing.end();
      leave();
      freshness.begin(false);
    };
  }, [door, topic, type]);
  const options = images.length ? [...images.map(({ name }) => [name, name]), ["", "no picture"]] : [["", "no topic of images"]];
  return html`<section class="stack-tight" aria-label="Picture"><h3>Picture</h3>
    <${parts.Field} label="Camera" value=${topic} set=${setChosen} options=${options} disabled=${!images.length} />
    ${wrong && html`<${parts.Notice} tone="deny" role="alert"><${parts.Given} value=${wrong} most=${600} /></${parts.Notice}>`}
    ${type && html`<canvas class="door-picture" ref=${canvas} role="img" aria-label=${`Picture of ${topic}`} width="4" height="3"></canvas><span class="muted small">${about || "No image yet."}</span>`}</section>`;
}

/** Draw one picture after another: of those that come in the meantime, only the newest. */
function newestOnly(/** @type {(message: any) => Promise<ImageBitmap>} */ decode, /** @type {(picture: ImageBitmap, message: any) => void} */ show, /** @type {(error: Error) => void} */ failed) {
  let [busy, ended, drawn, size] = [false, false, 0, ""];
  let next = /** @type {any} */ (null);
  const work = async () => {
    busy = true;
    while (next && !ended) {
      const message = next;
      next = null;
      try {
        const picture = await decode(message);
        if (!ended) show(picture, message);
        size = `${picture.width} × ${picture.height}`;
        drawn += 1;
        picture.close();
      } catch (error) {
        if (!ended) failed(/** @type {any} */ (error));
      }
    }
    busy = false;
  };
  return {
    give: (/** @type {any} */ message) => {
      next = message;
      if (!busy) work();
    },
    end: () => (ended = true),
    about: (/** @type {number} */ milliseconds) => {
      const rate = (drawn * 1000) / milliseconds;
      drawn = 0;
      return size && `${size}, ${Number(rate.toFixed(1))} a second`;
    },
  };
}

function draw(/** @type {HTMLCanvasElement | null} */ canvas, /** @type {ImageBitmap} */ picture) {
  if (!canvas) return;
  if (canvas.width !== picture.width || canvas.height !== picture.height) Object.assign(canvas, { width: picture.width, height: picture.height });
  canvas.getContext("2d")?.drawImage(picture, 0, 0);
}
