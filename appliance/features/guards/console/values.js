/** Set the values of a guard. A new polygon is drawn on the map, beside what the robot did. */

import { html, useState } from "#console/html.js";
import { Button } from "#console/parts/button.js";
import { Dialog } from "#console/parts/dialog.js";
import { Check, Field } from "#console/parts/field.js";
import { Notice } from "#console/parts/notice.js";
import { corners, written } from "./geometry.js";
import { Area } from "./area.js";
import { margins } from "./margins.js";
import { Margins } from "./meter.js";

/** @param {{guard: any, preset: any, seen: Record<string, any[]>, guards: ReturnType<typeof import("./state.js").useGuards>, close: () => void}} given */
export function SetValues({ guard, preset, seen, guards, close }) {
  const [values, setValues] = useState(/** @type {Record<string, string>} */ ({}));
  const [hold, setHold] = useState(false);
  const set = (/** @type {string} */ name) => (/** @type {string} */ value) => setValues({ ...values, [name]: value });
  const changed = Object.fromEntries(preset.parameters.filter((/** @type {any} */ one) => one.name in values && values[one.name] !== inForce(guard, one)).map((/** @type {any} */ one) => [one.name, values[one.name]]));
  const wrong = preset.parameters.filter((/** @type {any} */ one) => one.name in changed && !fits(one, changed[one.name]));
  const loads = preset.parameters.filter((/** @type {any} */ one) => one.loads && one.name in changed);
  const tried = withValues(guard, changed);
  const draft = corners(tried.loads.polygon ?? "");
  const polygon = corners(guard.loads.polygon ?? "");
  const ready = Object.keys(changed).length > 0 && !wrong.length;
  const save = async () => {
    const given = loads.length ? null : changed;
    const path = given ? `/v1/monitors/${encodeURIComponent(guard.name)}/given` : `/v1/guards/${encodeURIComponent(guard.name)}`;
    const query = loads.length && hold ? { hold: 1 } : {};
    const said = Object.entries(changed).map(([name, value]) => `${name}=${value}`).join(", ");
    if (await guards.order(`${guard.name} is set`, said, "PATCH", path, { json: { values: given ? typed(preset, given) : changed }, query })) close();
  };
  const foot = html`<button class="button" onClick=${close}>Not yet</button><${Button} role=${loads.length ? "admin" : "operator"} tone="primary" disabled=${!ready} why=${wrong.length ? `${wrong[0].name} is not valid` : "Nothing is changed"} onClick=${save}>Set</${Button}>`;
  return html`<${Dialog} wide title=${`Set values of ${guard.name}`} close=${close} foot=${foot}>
    <div class="form-grid">${preset.parameters.map((/** @type {any} */ one) => html`<${Value} key=${one.name} parameter=${one} value=${values[one.name] ?? inForce(guard, one)} set=${set(one.name)} wrong=${wrong.includes(one)} />`)}</div>
    ${ready && html`<${Outlook} tried=${tried} seen=${seen} loads=${loads} />`}
    ${polygon && html`<${Area} guard=${guard} tried=${tried} seen=${seen} draft=${draft ?? polygon}
      move=${(/** @type {number} */ index, /** @type {any} */ to) => set("polygon")(written((draft ?? polygon).map((one, at) => (at === index ? to : one))))} />`}
    ${loads.length > 0 && html`<${Check} label="Load even if the guard then holds its topics, until it is resumed" on=${hold} set=${setHold} />`}</${Dialog}>`;
}

/** What the new values would have meant for the seen messages. */
function Outlook(/** @type {{tried: any, seen: Record<string, any[]>, loads: any[]}} */ { tried, seen, loads }) {
  const found = margins(tried, seen);
  const beyond = found.filter((one) => one.used >= 1);
  const anew = loads.filter((one) => tried.origin !== "current" || ["joints", "time", "entries"].includes(one.kind));
  const begins = anew.length > 0 && html`<p>With another value of ${anew.map((one) => one.name).join(", ")} the guard begins in its initial state.</p>`;
  if (!found.length) return html`<${Notice} title="Without messages to compare with">Watch the robot first, to see here what these values would have stopped. <code>rosrv guard set ${tried.name} VALUE=… --dry-run</code> compares with the last hour of the flight recorder.${begins}</${Notice}>`;
  return html`<${Notice} tone=${beyond.length ? "warn" : "allow"} role="status" title=${beyond.length ? "These values would have stopped the robot in the last minutes" : "These values would have stopped nothing in the last minutes"}><${Margins} margins=${found} />${begins}</${Notice}>`;
}

function Value(/** @type {{parameter: any, value: string, set: (value: string) => void, wrong: boolean}} */ { parameter, value, set, wrong }) {
  const { kind, unit, least, most, what, name } = parameter;
  const range = least ? `${least} to ${most}${unit && ` ${unit}`}` : unit;
  const hint = [what, range, wrong && "not valid"].filter(Boolean).join("; ");
  return html`<div class=${least || kind === "bool" ? undefined : "whole-row"}><${Field} label=${name} value=${value} set=${set} mono=${!least} hint=${hint} aria-invalid=${wrong ? "true" : undefined} inputmode=${least ? "decimal" : undefined}
    options=${kind === "bool" ? [["true", "true"], ["false", "false"]] : undefined} /></div>`;
}

/** The value in force, as text. @param {any} guard @param {any} parameter */
function inForce(guard, parameter) {
  const given = guard.given.find((/** @type {any} */ one) => one.name === parameter.name);
  return String(given?.value ?? guard.loads[parameter.name] ?? parameter.default);
}

function fits(/** @type {any} */ parameter, /** @type {string} */ value) {
  if (parameter.kind === "corners") return corners(value) !== null;
  if (!parameter.least) return value.trim() !== "";
  const number = value.trim() === "" ? NaN : Number(value);
  return number >= Number(parameter.least) && number <= Number(parameter.most) && (parameter.kind !== "int" || Number.isInteger(number));
}

/** Values as REST has them: numbers and booleans. @param {any} preset @param {Record<string, string>} values */
function typed(preset, values) {
  return Object.fromEntries(Object.entries(values).map(([name, value]) => {
    const { kind } = preset.parameters.find((/** @type {any} */ one) => one.name === name);
    return [name, kind === "bool" ? value === "true" : Number(value)];
  }));
}

/** The guard as it would be with other values. @param {any} guard @param {Record<string, string>} values */
function withValues(guard, values) {
  const given = guard.given.map((/** @type {any} */ one) => (one.name in values && one.kind !== "bool" ? { ...one, value: Number(values[one.name]) } : one));
  return { ...guard, given, loads: { ...guard.loads, ...values } };
}
