/** The search over everything that the reader may read. The field is part of the page, so that no key is lost. */

import { html, useEffect, useRef, useState } from "../html.js";
import { Dialog } from "../parts/dialog.js";
import { Field } from "../parts/field.js";
import { late } from "../parts/late.js";
import { createStore, useStore } from "../store.js";

const searching = createStore(false);
const Results = late(() => import("./results.js"), "Results");

export function openSearch() {
  searching.set(true);
}

export function Search() {
  return useStore(searching) && html`<${Open} />`;
}

function Open() {
  const [text, setText] = useState("");
  const box = useRef(/** @type {HTMLElement | null} */ (null));
  const close = () => searching.set(false);
  useEffect(() => close, []);
  const links = () => /** @type {HTMLElement[]} */ ([...(box.current?.querySelectorAll("a, input") ?? [])]);
  const move = (/** @type {KeyboardEvent} */ event) => {
    const all = links();
    const at = all.indexOf(/** @type {HTMLElement} */ (document.activeElement));
    const next = { ArrowDown: at + 1, ArrowUp: at - 1, Enter: at === 0 ? 1 : -1 }[event.key];
    if (next === undefined || !all[next]) return;
    event.preventDefault();
    if (event.key === "Enter") all[next].click();
    else all[next].focus();
  };
  return html`<${Dialog} title="Search" close=${close} wide><div ref=${box} class="stack-tight" onKeyDown=${move}>
    <${Field} label="Hosts, nodes, topics, rules, records, guards and doors" mono value=${text} set=${setText} autofocus />
    <${Results} text=${text.trim()} close=${close} /></div></${Dialog}>`;
}
