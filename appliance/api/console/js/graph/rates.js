/** A topic's rate and delay in the relay over time, from the graph's updates. */

import { html, useEffect, useState } from "../html.js";
import { Plot } from "../parts/plot.js";

const SPAN = 120; // seconds to show; kept only while the topic is open

/** @typedef {{time: number, rate: number, delay: number}} Look */

/** @param {{topic: any}} given as `/v1/graph` has it; another object each time it comes */
export function Rates({ topic }) {
  const [looks, setLooks] = useState(/** @type {Look[]} */ ([]));
  useEffect(() => {
    const time = Date.now() / 1000;
    const rate = topic.publishers.reduce((/** @type {number} */ sum, /** @type {any} */ one) => sum + one.messages_per_second, 0);
    const delay = Math.max(0, ...topic.publishers.map((/** @type {any} */ one) => one.delay_seconds)) * 1000;
    setLooks((looks) => [...looks.filter((one) => one.time > time - SPAN), { time, rate, delay }]);
  }, [topic]);
  const points = (/** @type {"rate" | "delay"} */ name) => looks.map((one) => ({ time: one.time, value: one[name] }));
  return html`<div><h3>Rate</h3><${Plot} label="Rate" span=${SPAN} height=${96} series=${[{ name: "messages", colour: "c3", points: points("rate") }]} />
    <h3>Delay in the relay</h3><${Plot} label="Delay" unit=" ms" span=${SPAN} height=${96} series=${[{ name: "longest of its publishers", colour: "c4", points: points("delay") }]} /></div>`;
}
