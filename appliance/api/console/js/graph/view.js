/** Graph: nodes, topics and services, through the relay or past it, and denied hosts. */

import { useDeniedCounts } from "../audit/denied_hosts.js";
import { html, useEffect, useMemo, useRef, useState } from "../html.js";
import { applianceTime, live } from "../live.js";
import { notable } from "../notable.js";
import { counted } from "../numbers.js";
import { Check } from "../parts/field.js";
import { useShown } from "../parts/host.js";
import { Empty, Failure, Loading } from "../parts/notice.js";
import { place } from "../router.js";
import { useStore } from "../store.js";
import { afresh, arrange, loadLayout } from "./arrange.js";
import { collapse } from "./collapse.js";
import { Details } from "./details.js";
import { Drawing } from "./drawing.js";
import { TopicList } from "./list.js";
import { modelOf } from "./model.js";

const NARROW = matchMedia("(max-width: 620px)"); // as in graph.css
/** The frame of the drawing, about as large as graph.css makes it. @returns {import("./arrange.js").Frame} */
const FRAME = () => (NARROW.matches ? { narrow: true, w: innerWidth - 36, h: innerHeight * 0.62 } : { narrow: false, w: innerWidth - (innerWidth > 860 ? 280 : 36), h: Math.max(420, innerHeight - 236) });
const MAX = 42; // items of a kind to draw without groups
const RECENT_HOURS = 1;

export function GraphView() {
  const graph = useStore(live, (one) => one.graph);
  const denials = useStore(notable, (one) => one.denials);
  const [search, setSearch] = useState("");
  const [wanted, setWanted] = useState({ services: false, quiet: true, denied: true });
  const [opened, setOpened] = useState(/** @type {Set<string>} */ (new Set()));
  const [by, setBy] = useState(/** @type {"namespace" | "host"} */ ("namespace"));
  const [chosen, setChosen] = useState(/** @type {string | null} */ (null));
  const [form, setForm] = useState("drawing");
  const [more, setMore] = useState(false); // in a narrow frame, the options are shown on request
  const [round, setRound] = useState(0);
  const [layout, setLayout] = useState({ loaded: false, error: /** @type {any} */ (null) });
  useEffect(() => {
    loadLayout().then(() => setLayout({ loaded: true, error: null }), (error) => setLayout({ loaded: false, error }));
  }, []);
  const linked = useStore(place, (one) => one.query.get("item"));
  useEffect(() => {
    if (!linked || !graph) return;
    setWanted((wanted) => ({ ...wanted, quiet: false, services: wanted.services || linked.startsWith("s") }));
    setSearch("");
    setChosen(linked);
  }, [linked, graph !== null]);
  const shownHost = useShown();
  const counts = useDeniedCounts(denials?.[0]?.sequence ?? 0);
  const recent = useMemo(() => recentOf(denials ?? []), [denials]);
  const model = useMemo(() => (graph ? narrowed(modelOf(graph, recent, wanted, shownHost, counts), search) : null), [graph, recent, wanted, search, shownHost, counts]);
  const ready = model !== null && layout.loaded && denials !== null;
  const shown = useMemo(() => (model && ready ? collapse(model, opened, by, MAX, shownHost) : null), [model, opened, by, ready]);
  const closed = useMemo(() => (model && ready && opened.size ? collapse(model, new Set(), by, MAX, shownHost) : shown), [shown]);
  const { spots, arranged, frame } = useSpots(shown, closed, round, `${search}|${JSON.stringify(wanted)}|${by}`, FRAME());
  const present = (graph?.nodes ?? []).filter((/** @type {any} */ one) => one.state !== "lost");
  const head = html`<div class="head graph-head"><h1>Graph</h1>${graph && html`<span class="head-sub">${counted(present.length, "node")}${present.length < graph.nodes.length ? ` (${graph.nodes.length - present.length} lost)` : ""}, ${counted(graph.topics.length, "topic")}, ${counted(graph.services.length, "service")}</span>`}
    <div class="head-actions"><div class="row" role="group" aria-label="Form">
      ${[["drawing", "Drawing"], ["list", "Table"]].map(([name, word]) => html`<button key=${name} class="button" aria-pressed=${String(form === name)} onClick=${() => setForm(name)}>${word}</button>`)}</div></div></div>`;
  if (layout.error) return html`${head}<${Failure} error=${layout.error} retry=${() => location.reload()} />`;
  if (!graph || !shown || !model) return html`${head}<section class="panel"><${Loading} rows=${8} /></section>`;
  const choose = (/** @type {string | null} */ key) => setChosen(key === null ? null : shownKey(key, shown));
  const item = chosen ? shown.items.get(chosen) ?? model.items.get(chosen) : null;
  const line = chosen ? shown.lines.get(chosen) : null;
  const open = (/** @type {string} */ key) => {
    // Open the topics of a namespace together with its nodes.
    const kinds = ["gnode", "gtopic", "gservice"].map((kind) => key.replace(/^g[a-z]+/, kind));
    setOpened(new Set([...opened, key, ...kinds]));
    setChosen(null);
  };
  const fold = (/** @type {"namespace" | "host"} */ next) => {
    setOpened(new Set());
    setChosen(null);
    setBy(next);
  };
  const topics = graph.topics.filter((/** @type {any} */ one) => matches(search, [one.name, one.type, ...one.publishers.map((/** @type {any} */ each) => each.node), ...one.subscribers]));
  return html`${head}
    <div class=${`graph-grid${item || line ? " with-details" : ""}`}>
      <section class="panel graph-panel" aria-label="Graph">
        <div class="panel-head"><input class="input graph-search" type="search" data-search placeholder="Search nodes, topics, types, hosts" aria-label="Search the graph" value=${search} onInput=${(/** @type {any} */ event) => setSearch(event.target.value)} onKeyDown=${(/** @type {any} */ event) => event.key === "Enter" && choose(found(model, search))} />
          <button class="button graph-more" aria-expanded=${String(more)} onClick=${() => setMore(!more)}>Options</button>
          <div class=${`graph-options${more ? " open" : ""}`}><${Check} label="Denied" on=${wanted.denied} set=${(denied) => setWanted({ ...wanted, denied })} />
          <${Check} label="Services" on=${wanted.services} set=${(services) => setWanted({ ...wanted, services })} />
          <${Check} label="Without logging" on=${wanted.quiet} set=${(quiet) => setWanted({ ...wanted, quiet })} />
          <select class="input graph-fold" aria-label="Groups" value=${by} onInput=${(/** @type {any} */ event) => fold(event.target.value)}>
            <option value="namespace" selected=${by === "namespace"}>Groups by namespace</option><option value="host" selected=${by === "host"}>Groups by host</option></select>
          <span class="end">${opened.size > 0 && html`<button class="button small" onClick=${() => setOpened(new Set())}>Close groups</button>`}
            ${form === "drawing" && html`<button class="button small" onClick=${() => setRound(round + 1)} title="Compute the layout again">Arrange</button>`}</span></div></div>
        ${form === "list" ? html`<${TopicList} topics=${topics} denials=${recent} choose=${choose} chosen=${chosen} />`
          : shown.items.size === 0 ? html`<${Empty} icon="graph" title=${search ? "Nothing matches" : "No node has registered yet"}>${search ? "Search for a part of a name, a type or a host." : "Point nodes at the appliance: export ROS_MASTER_URI to its address, and start them."}</${Empty}>`
          : html`<${Drawing} items=${shown.items} lines=${shown.lines} spots=${spots} chosen=${chosen} choose=${choose} arranged=${arranged} narrow=${frame.narrow} /><${Legend} />`}
      </section>
      ${(item || line) && html`<${Details} key=${chosen} item=${item} line=${line} shown=${shown} denials=${recent} choose=${choose} open=${open} />`}
    </div>`;
}

function Legend() {
  return html`<ul class="legend" aria-label="Legend">
    <li><svg width="30" height="16" aria-hidden="true"><rect class="legend-node" x="1" y="1" width="28" height="14" rx="4" /></svg>node</li>
    <li><svg width="32" height="18" aria-hidden="true"><rect class="legend-node" x="3" y="3" width="28" height="14" rx="4" /><rect class="legend-node" x="1" y="1" width="28" height="14" rx="4" /></svg>several, drawn as one</li>
    <li><svg width="30" height="16" aria-hidden="true"><rect class="legend-node lost" x="1" y="1" width="28" height="14" rx="4" /></svg>node that does not answer</li>
    <li><svg width="30" height="16" aria-hidden="true"><rect class="legend-topic" x="1" y="1" width="28" height="14" rx="7" /></svg>topic or service</li>
    <li><svg width="34" height="16" aria-hidden="true"><path class="line mediated" d="M1 8H33" /></svg>through the relay</li>
    <li><svg width="34" height="16" aria-hidden="true"><path class="line flow" d="M1 8H33" /></svg>direct</li>
    <li><svg width="34" height="16" aria-hidden="true"><path class="line denied" d="M1 8H33" /></svg>denied, last hour</li>
    <li><svg width="30" height="16" aria-hidden="true"><rect class="legend-party" x="1" y="1" width="28" height="14" rx="4" /></svg>denied host</li>
    <li><svg width="34" height="16" aria-hidden="true"><path class="line would" d="M1 8H33" /></svg>would be denied</li></ul>`;
}

/** Places that stay while the graph changes; a search, a filter or *Arrange* computes a new layout, in which groups open in place. */
function useSpots(/** @type {any} */ shown, /** @type {any} */ closed, /** @type {number} */ round, /** @type {string} */ cause, /** @type {import("./arrange.js").Frame} */ frame) {
  const kept = useRef({ spots: new Map(), cause: "", round: -1, arranged: 0, frame });
  return useMemo(() => {
    if (!shown) return kept.current;
    const anew = kept.current.cause !== cause || kept.current.round !== round || kept.current.frame.narrow !== frame.narrow;
    const before = kept.current.spots;
    const start = anew ? afresh(closed.items, closed.lines, frame) : before;
    const spots = anew && closed === shown ? start : arrange(shown.items, shown.lines, start, frame);
    const moved = anew || [...before].some(([key, spot]) => spots.has(key) && spots.get(key) !== spot);
    kept.current = { spots, cause, round, frame, arranged: kept.current.arranged + (moved || !before.size ? 1 : 0) };
    return kept.current;
  }, [shown, round, cause, frame.narrow]);
}

function recentOf(/** @type {any[]} */ denials) {
  const since = ((applianceTime() ?? 0) - RECENT_HOURS * 3600) * 1000;
  return denials.filter((one) => Date.parse(one.time) > since);
}

/** The items that match a search, and the items that they are connected to. */
function narrowed(/** @type {import("./model.js").Model} */ model, /** @type {string} */ search) {
  if (!search.trim()) return model;
  const hit = new Set([...model.items.values()].filter((one) => matches(search, [one.name, one.sub])).map((one) => one.key));
  const near = new Set(hit);
  const lines = new Map([...model.lines].filter(([, line]) => hit.has(line.from) || hit.has(line.to)));
  for (const line of lines.values()) near.add(line.from).add(line.to);
  return { items: new Map([...model.items].filter(([key]) => near.has(key))), lines };
}

/** The item that Enter in the search opens: the item with the shortest name that contains the searched text. */
function found(/** @type {import("./model.js").Model} */ model, /** @type {string} */ search) {
  const named = [...model.items.values()].filter((one) => search.trim() && matches(search, [one.name]));
  return named.sort((a, b) => a.name.length - b.name.length)[0]?.key ?? null;
}

function matches(/** @type {string} */ search, /** @type {string[]} */ words) {
  const wanted = search.trim().toLowerCase();
  return !wanted || words.some((one) => String(one).toLowerCase().includes(wanted));
}

function shownKey(/** @type {string} */ key, /** @type {any} */ shown) {
  if (shown.items.has(key) || shown.lines.has(key)) return key;
  for (const item of shown.items.values()) if (item.members?.some((/** @type {any} */ one) => one.key === key)) return item.key;
  return key;
}
