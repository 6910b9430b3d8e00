/** The robot through the person's own door: a picture, a plot and a pad. Loaded when the door is opened. */

import { html, useEffect, useMemo, useState } from "/console/static/vendor/preact.js";
import { DoorConnection } from "./connection.js";
import { Freshness } from "./freshness.js";
import { Pad } from "./pad.js";
import { Picture } from "./picture.js";
import { FieldPlot } from "./plot.js";

const EVERY = 5000; // milliseconds between two lists of topics

/**
 * `parts` are components and functions of the console: `Button`, `Failure`, `Field`, `Given`, `Loading`, `Notice`, `ask`, `failed`, and
 * `optional(path)`, which gets an answer of REST, or null from an appliance without the feature.
 * @param {{parts: any, ticket: string, name: string, address: string, ended: (reason: string) => void}} given `ticket`: the WebSocket's address
 */
export function Teleop({ parts, ticket, name, address, ended }) {
  const [door, setDoor] = useState(/** @type {DoorConnection | null} */ (null));
  const [topics, setTopics] = useState(/** @type {{name: string, type: string}[] | null} */ (null));
  const [wrong, setWrong] = useState("");
  const freshness = useMemo(() => new Freshness(), []);
  useEffect(() => {
    const connection = new DoorConnection(ticket, () => setDoor(connection), ended);
    return () => connection.close();
  }, [ticket]);
  useEffect(() => {
    if (!door) return undefined;
    const look = async () => {
      try {
        const { topics, types } = await door.call("/rosapi/topics");
        setTopics(topics.map((/** @type {string} */ one, /** @type {number} */ at) => ({ name: one, type: types[at] })));
        setWrong("");
      } catch (error) {
        setWrong(/** @type {any} */ (error).message);
      }
    };
    look();
    const timer = setInterval(look, EVERY);
    return () => clearInterval(timer);
  }, [door]);
  if (!door || (!topics && !wrong)) return html`<${parts.Loading} rows=${3} />`;
  const given = { parts, door, topics: topics ?? [], freshness };
  return html`<div class="panel-body stack">
    ${wrong && html`<${parts.Notice} tone="deny" title="The door lists no topics" role="alert"><${parts.Given} value=${wrong} most=${600} /></${parts.Notice}>`}
    <div class="door-robot"><${Picture} ...${given} /><${FieldPlot} ...${given} /><${Pad} ...${given} name=${name} address=${address} /></div></div>`;
}
