/** The sound of a call that waits. It is off until a person switches it on in this browser. */

import { html } from "#console/html.js";
import { Check } from "#console/parts/field.js";
import { store, stored } from "#console/storage.js";
import { createStore, useStore } from "#console/store.js";

const KEPT = "rosrv.approval-sound";
const TONES = [660, 880]; // Hz
const LENGTH = 0.18; // seconds

/** `silent`: it is on, but the browser plays nothing before the page is clicked. */
const sound = createStore({ on: stored(KEPT) === "on", silent: false });
let player = /** @type {AudioContext | null} */ (null);

export function Sound() {
  const { on, silent } = useStore(sound);
  return html`<div class="row"><${Check} label="Sound for a new call" on=${on} set=${turn} />${on && silent && html`<span class="small muted">This browser plays it once you have clicked into the page.</span>`}</div>`;
}

/** Play the sound, if it is on. */
export async function ring() {
  if (!sound.get().on) return;
  player ??= new AudioContext();
  if (player.state !== "running") {
    sound.update({ silent: true });
    await player.resume(); // pending until the page was clicked
    return sound.update({ silent: false }); // the call may be over by then
  }
  sound.update({ silent: false });
  TONES.forEach((tone, at) => play(/** @type {AudioContext} */ (player), tone, at * LENGTH));
}

function play(/** @type {AudioContext} */ player, /** @type {number} */ tone, /** @type {number} */ after) {
  const from = player.currentTime + after;
  const [source, volume] = [player.createOscillator(), player.createGain()];
  source.frequency.value = tone;
  volume.gain.setValueAtTime(0.2, from);
  volume.gain.exponentialRampToValueAtTime(0.001, from + LENGTH);
  source.connect(volume).connect(player.destination);
  source.start(from);
  source.stop(from + LENGTH);
}

function turn(/** @type {boolean} */ on) {
  store(KEPT, on ? "on" : "off");
  sound.update({ on });
  ring(); // so that the person hears it
}
