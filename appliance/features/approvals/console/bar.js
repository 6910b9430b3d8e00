/**
 * The bar of waiting calls, on every page, at the lower edge of the window.
 *
 * 1. A call keeps its place: newer ones come above it, and an ended one stays while the pointer or the focus is on the
 *    bar. So nothing moves under the pointer, and the page behind does not move either.
 * 2. Buttons wake half a second after they appear or move, or after the page is seen again: a click that was meant for
 *    something else decides nothing.
 */

import { html, useEffect, useRef, useState } from "#console/html.js";
import { lasting } from "#console/moments.js";
import { counted } from "#console/numbers.js";
import { Button } from "#console/parts/button.js";
import { Given } from "#console/parts/given.js";
import { Host } from "#console/parts/host.js";
import { Link } from "#console/router.js";
import { session } from "#console/session.js";
import { useStore } from "#console/store.js";
import { decide, held, useHeldCalls } from "./held.js";
import { TIMES, wants } from "./call.js";
import { asleep, placed, pruned, waitingOf } from "./slots.js";
import { Sound } from "./sound.js";

const CHECKED = 200; // milliseconds between two checks
const NARROW = "(max-width: 720px)";

export function WaitingCalls() {
  useHeldCalls();
  const { rows, heard } = useStore(held);
  const [slots, setSlots] = useState(/** @type {import("./slots.js").Slot[]} */ ([]));
  const [now, setNow] = useState(performance.now());
  const bar = useRef(/** @type {HTMLElement | null} */ (null));
  const signedIn = useStore(session, ({ current }) => current !== null);
  useEffect(() => setSlots((slots) => placed(slots, rows, heard?.steady ?? 0, performance.now())), [rows]);
  useEffect(() => {
    if (!slots.length) return undefined;
    const timer = setInterval(() => {
      setNow(performance.now());
      const used = bar.current?.matches(":hover, :focus-within") ?? false;
      setSlots((slots) => pruned(slots, performance.now(), used));
    }, CHECKED);
    return () => clearInterval(timer);
  }, [slots.length > 0]);
  useEffect(() => {
    const seen = () => setSlots((slots) => asleep(slots, performance.now()));
    seen();
    document.addEventListener("visibilitychange", seen);
    return () => document.removeEventListener("visibilitychange", seen);
  }, [signedIn]);
  if (!slots.length || !signedIn) return null;
  const most = matchMedia(NARROW).matches ? 2 : 3;
  const more = slots.length - most;
  const waiting = waitingOf(rows);
  return html`<section class="waiting-calls" ref=${bar} aria-label="Calls that wait for you">
    <span class="sr-only" role="status">${counted(waiting.length, "call waits", "calls wait")}</span>
    ${slots.slice(0, most).reverse().map((slot) => html`<${Call} key=${slot.number} slot=${slot} now=${now} />`)}
    <div class="waiting-foot"><${Sound} /><${Link} to="/console/robot" class="small">${more > 0 ? `${more} more on Robot` : "All on Robot"}</${Link}></div></section>`;
}

function Call(/** @type {{slot: import("./slots.js").Slot, now: number}} */ { slot: { number, call, left, ended, awake }, now }) {
  const off = { disabled: now < awake || ended !== "", why: ended || "It wakes in half a second" };
  const seconds = Math.max(0, (left - now) / 1000);
  return html`<div class=${`waiting-call${ended ? " ended" : ""}`} data-approval=${number}>
    <div class="waiting-what"><${Host} value=${call.host} /> <span class="muted">wants to</span> ${wants(call)}</div>
    <div class="waiting-left nowrap" data-left>${ended || html`<b>${lasting(seconds)}</b> left`}</div>
    <div class="row waiting-buttons">${call.category === "call" && html`<${Button} small role="operator" tone="primary" ...${off} onClick=${() => decide(number, "approve")}>Approve once</${Button}>`}
      ${TIMES.map((seconds) => html`<${Button} key=${seconds} small role="operator" ...${off} onClick=${() => decide(number, "approve", seconds)}>For ${lasting(seconds)}</${Button}>`)}
      <${Button} small role="operator" ...${off} onClick=${() => decide(number, "refuse")}>Refuse</${Button}></div></div>`;
}
