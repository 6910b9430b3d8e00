/**
 * The pad: a finger, the mouse or the arrow keys drive the base. Whatever ends the hold stops it. A hold that begins
 * before it is known who drives counts from the answer on.
 *
 * The pad locks while the picture that is shown is old, which stops the base. It unlocks when the picture is fresh again and
 * the pad was let go: a hold from before the lock never drives on.
 */

import { html, useEffect, useId, useMemo, useRef, useState } from "/console/static/vendor/preact.js";
import { COMMANDS, Drive } from "./drive.js";
import { OLD } from "./freshness.js";

const SPEEDS = /** @type {[string, string, number, number][]} */ ([["slow", "slow: 0.1 m/s", 0.1, 0.3], ["medium", "medium: 0.3 m/s", 0.3, 0.6], ["fast", "fast: 0.8 m/s", 0.8, 1.2]]);
const ARROWS = { ArrowUp: [0, 1], ArrowDown: [0, -1], ArrowLeft: [-1, 0], ArrowRight: [1, 0] };
const CHECKED = 50; // milliseconds between two checks of the picture
const LOCKED = `Locked: the picture is older than ${OLD / 1000} s. Let go until it moves, or choose "no picture".`;
const DEAD = 0.12; // fraction of the radius that means zero

export function Pad(/** @type {import("./picture.js").Given & {name: string, address: string}} */ { parts, door, topics, freshness, name, address }) {
  const bases = topics.filter(({ type }) => type in COMMANDS);
  const [chosen, setChosen] = useState(/** @type {string | null} */ (null));
  const topic = chosen ?? bases[0]?.name ?? "";
  const type = bases.find((one) => one.name === topic)?.type ?? "geometry_msgs/Twist";
  const [speed, setSpeed] = useState("slow");
  const list = useId();
  const { group, groups, guards, error, again } = useMotion(parts, topic);
  const listed = bases.some((one) => one.name === topic);
  const fastest = SPEEDS.find(([word]) => word === speed) ?? SPEEDS[0];
  const held = !group || group.ranks.length > 0 || group.holder === address; // by rank, who moves drives
  const looking = Boolean(topic) && !guards && !error;
  const why = !topic ? "Name a topic" : looking ? "Looking who drives" : error ? "It is not known who drives" : held ? "" : `Take ${group.group} first`;
  return html`<section class="stack-tight" aria-label="Pad"><h3>Pad</h3>
    <${parts.Field} label="Commands" mono value=${topic} set=${setChosen} list=${list} placeholder="/cmd_vel" hint=${listed ? type : topic ? "not listed by the door: sent as geometry_msgs/Twist" : "no topic of velocities is listed: name one"} />
    <${parts.Field} label="Speed" value=${speed} set=${setSpeed} options=${SPEEDS.map(([word, shown]) => [word, shown])} hint=${`turns with ${fastest[3]} rad/s`} />
    <datalist id=${list}>${[...new Set([...bases.map((one) => one.name), ...groups])].map((one) => html`<option key=${one} value=${one}></option>`)}</datalist>
    ${error ? html`<${parts.Failure} error=${error} retry=${again} />` : null}
    ${group && html`<${Authority} parts=${parts} group=${group} held=${held} name=${name} again=${again} />`}
    ${topic && guards && !guards.includes("deadman") && html`<${parts.Notice} tone="warn" title="No deadman guards this topic">If the connection breaks, the robot keeps its last command: <code>rosrv guard new deadman <${parts.Given} value=${topic} most=${80} /></code></${parts.Notice}>`}
    ${guards?.length ? html`<span class="muted small">Guards: ${guards.join(", ")}</span>` : null}
    <${Plate} key=${`${topic} ${type}`} parts=${parts} door=${door} freshness=${freshness} topic=${topic} type=${type} speed=${fastest} why=${why} looking=${looking} /></section>`;
}

/** The holder of the group, and the buttons that hand it over. */
function Authority(/** @type {{parts: any, group: any, held: boolean, name: string, again: () => void}} */ { parts, group, held, name, again }) {
  const order = async (/** @type {string} */ verb, /** @type {any} */ json) => {
    try {
      await parts.ask("POST", `/v1/drive/${encodeURIComponent(group.group)}/${verb}`, { json, match: "*" });
    } catch (failure) {
      parts.failed(failure);
    }
    await again();
  };
  if (group.ranks.length) return html`<div class="small"><${parts.Given} value=${group.group} most=${64} />: <${parts.Given} value=${group.standing} /><div class="muted"><${parts.Given} value=${group.why} most=${200} /></div></div>`;
  const holder = group.holder ? html`<${parts.Given} value=${group.holder} mono /> holds` : "No host holds";
  return html`<div class="row small"><span>${held ? "You hold" : holder} <strong><${parts.Given} value=${group.group} most=${64} /></strong>.</span>
    ${held ? html`<${parts.Button} small role="operator" onClick=${() => order("free", { to: "", holder: group.holder })}>Free it</${parts.Button}>` : html`<${parts.Button} small role="operator" tone="primary" onClick=${() => order("assign", { host: `door:${name}`, holder: group.holder })}>Take it</${parts.Button}>`}</div>`;
}

/** Who may drive on a topic, and the guards in force on it, every two seconds. */
function useMotion(/** @type {any} */ parts, /** @type {string} */ topic) {
  const [state, setState] = useState(/** @type {{group: any, groups: string[], guards: string[] | null, error: unknown}} */ ({ group: null, groups: [], guards: null, error: null }));
  const look = async () => {
    try {
      const [drive, guarded] = await Promise.all([parts.optional("/v1/drive"), parts.optional("/v1/guards")]);
      const all = drive?.groups ?? [];
      const group = all.find((/** @type {any} */ one) => one.names.includes(topic)) ?? null;
      const acting = (guarded?.guards ?? []).filter((/** @type {any} */ one) => one.topics.command === topic && !["shadow", "off", "broken"].includes(one.state));
      setState({ group, groups: all.flatMap((/** @type {any} */ one) => one.names), guards: acting.map((/** @type {any} */ one) => one.preset), error: null });
    } catch (error) {
      setState((known) => ({ ...known, error }));
    }
  };
  useEffect(() => {
    setState((known) => ({ ...known, group: null, guards: null, error: null }));
    look();
    const timer = setInterval(look, 2000);
    return () => clearInterval(timer);
  }, [topic]);
  return { ...state, again: look };
}

function Plate(/** @type {{parts: any, door: import("./connection.js").DoorConnection, freshness: import("./freshness.js").Freshness, topic: string, type: string, speed: any, why: string, looking: boolean}} */ { parts, door, freshness, topic, type, speed, why: reason, looking }) {
  const [driving, setDriving] = useState(false);
  const [said, setSaid] = useState("");
  const [at, setAt] = useState({ x: 0, y: 0 });
  const keys = useRef(/** @type {Set<string>} */ (new Set()));
  const pointer = useRef(/** @type {number | null} */ (null));
  const aim = useRef({ x: 0, y: 0 });
  const touching = useRef(/** @type {Set<string | number>} */ (new Set())); // keys and pointers that are held, even while the pad is off
  const [old, setOld] = useState(false);
  const why = reason || (old ? LOCKED : "");
  const off = Boolean(why) && !looking;
  const drive = useMemo(() => new Drive(door, topic, type, (on, text) => {
    setDriving(on);
    setSaid(text);
  }), []);
  const release = (/** @type {string} */ text = "") => {
    keys.current.clear();
    pointer.current = null;
    setAt({ x: 0, y: 0 });
    drive.stop(text);
  };
  const hold = (/** @type {number} */ x, /** @type {number} */ y) => {
    const length = Math.hypot(x, y);
    const scale = length < DEAD ? 0 : 1 / Math.max(1, length);
    const [, , fastest, turn] = speed;
    aim.current = { x, y };
    setAt({ x: x * scale, y: y * scale });
    if (!looking) drive.go(y * scale * fastest, -x * scale * turn);
  };
  useEffect(() => {
    const away = () => {
      touching.current.clear(); // the page does not see what is let go now
      release();
    };
    const hidden = () => document.hidden && release();
    addEventListener("blur", away);
    addEventListener("pagehide", away);
    document.addEventListener("visibilitychange", hidden);
    return () => {
      removeEventListener("blur", away);
      removeEventListener("pagehide", away);
      document.removeEventListener("visibilitychange", hidden);
      drive.stop();
    };
  }, []);
  useEffect(() => {
    const timer = setInterval(() => {
      const age = freshness.age(performance.now());
      if (age > OLD) {
        if (drive.driving) release(`The picture is older than ${OLD / 1000} s: the robot was stopped.`);
        setOld(true);
      } else if (!touching.current.size) setOld(false);
    }, CHECKED);
    return () => clearInterval(timer);
  }, []);
  useEffect(() => {
    if (off) release();
    else if (!looking && (pointer.current !== null || keys.current.size)) hold(aim.current.x, aim.current.y);
  }, [why]);
  const point = (/** @type {PointerEvent} */ event) => {
    const box = /** @type {Element} */ (event.currentTarget).getBoundingClientRect();
    hold(((event.clientX - box.left) / box.width) * 2 - 1, 1 - ((event.clientY - box.top) / box.height) * 2);
  };
  const down = (/** @type {PointerEvent} */ event) => {
    if (event.button !== 0) return;
    touching.current.add(event.pointerId);
    /** @type {Element} */ (event.currentTarget).setPointerCapture(event.pointerId);
    if (off || pointer.current !== null) return;
    pointer.current = event.pointerId;
    point(event);
  };
  const move = (/** @type {PointerEvent} */ event) => {
    if (event.pointerId === pointer.current) point(event);
  };
  const up = (/** @type {PointerEvent} */ event) => {
    touching.current.delete(event.pointerId);
    if (event.pointerId === pointer.current) release();
  };
  const press = (/** @type {KeyboardEvent} */ event) => {
    if (!(event.key in ARROWS) || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();
    touching.current.add(event.key);
    if (off || event.repeat) return;
    keys.current.add(event.key);
    steer();
  };
  const let_go = (/** @type {KeyboardEvent} */ event) => {
    touching.current.delete(event.key);
    if (!keys.current.delete(event.key)) return;
    if (keys.current.size) steer();
    else release();
  };
  const blurred = () => {
    for (const key of Object.keys(ARROWS)) touching.current.delete(key);
    release();
  };
  const steer = () => {
    const sides = [...keys.current].map((key) => ARROWS[/** @type {keyof typeof ARROWS} */ (key)]);
    hold(sides.reduce((sum, [x]) => sum + x, 0), sides.reduce((sum, [, y]) => sum + y, 0));
  };
  return html`${said && html`<${parts.Notice} tone="deny" title="The pad has stopped" role="alert"><${parts.Given} value=${said} most=${600} /></${parts.Notice}>`}
    <div class=${`door-pad${driving ? " driving" : ""}`} tabindex="0" role="application" aria-label="Pad: hold it, or the arrow keys, to drive" aria-disabled=${off ? "true" : undefined} title=${why || undefined}
      onPointerDown=${down} onPointerMove=${move} onPointerUp=${up} onPointerCancel=${up} onLostPointerCapture=${up} onKeyDown=${press} onKeyUp=${let_go} onBlur=${blurred} onContextMenu=${(/** @type {Event} */ event) => event.preventDefault()}>
      <span class="door-knob" style=${{ left: `${50 + at.x * 37}%`, top: `${50 - at.y * 37}%` }}></span></div>
    <span class="muted small" role="status">${why || (driving ? "Driving: let go to stop." : "Stopped. Hold the pad, or focus it and hold the arrow keys.")}</span>`;
}
