/** The numeric fields of a message in JSON. NaN and infinity are null there. */

const MAX_FIELDS = 300;
const MAX_ELEMENTS = 8; // of an array that are offered; a path may name any

/** The paths of the numeric fields, such as `pose.position.x` or `ranges[0]`. @param {any} message @returns {string[]} */
export function numericFields(message) {
  const found = /** @type {string[]} */ ([]);
  const walk = (/** @type {any} */ value, /** @type {string} */ path) => {
    if (found.length >= MAX_FIELDS) return;
    if (value === null || typeof value === "number" || typeof value === "boolean") found.push(path);
    else if (Array.isArray(value)) value.slice(0, MAX_ELEMENTS).forEach((one, index) => walk(one, `${path}[${index}]`));
    else if (typeof value === "object") for (const [name, one] of Object.entries(value)) walk(one, path ? `${path}.${name}` : name);
  };
  walk(message, "");
  return found;
}

/** The field that a plot shows first: not one of the header. @param {string[]} fields */
export function firstField(fields) {
  return fields.find((one) => !/^header\.|[.](n?secs)$/.test(one)) ?? fields[0] ?? "";
}

/** The value of a field; null for NaN, infinity and a missing field. @param {any} message @param {string} path @returns {number | null} */
export function valueOf(message, path) {
  let value = message;
  for (const part of path.match(/[^.[\]]+/g) ?? []) value = Object.hasOwn(Object(value), part) ? value[part] : null;
  if (typeof value === "boolean") return Number(value);
  return typeof value === "number" && Number.isFinite(value) ? value : null;
}
