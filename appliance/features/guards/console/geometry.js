/** Positions, polygons and their distances, as the library of specifications computes them. */

const EARTH = 6371008.8; // metres: the mean radius

/** @typedef {{x: number, y: number}} Point */

/** The corners that a text lists, or null if it lists none: `-2,-2 2,-2 2,2`. @param {string} text @returns {Point[] | null} */
export function corners(text) {
  const found = text.trim().split(/\s+/).map((one) => one.split(",").map(Number));
  if (found.length < 3 || found.length > 100 || found.some((pair) => pair.length !== 2 || !pair.every(Number.isFinite))) return null;
  return found.map(([x, y]) => ({ x, y }));
}

/** @param {Point[]} polygon */
export function written(polygon) {
  return polygon.map(({ x, y }) => `${short(x)},${short(y)}`).join(" ");
}

/** To a centimetre. @param {number} value */
export function short(value) {
  return String(Number(value.toFixed(2)));
}

/** The depth of a point in metres: the distance to the edge, negative outside. @param {Point} point @param {Point[]} polygon */
export function depth(point, polygon) {
  let nearest = Infinity;
  let within = false;
  polygon.forEach((from, index) => {
    const to = polygon[(index + 1) % polygon.length];
    const [dx, dy] = [to.x - from.x, to.y - from.y];
    const along = Math.min(1, Math.max(0, ((point.x - from.x) * dx + (point.y - from.y) * dy) / (dx * dx + dy * dy || 1)));
    nearest = Math.min(nearest, Math.hypot(point.x - from.x - along * dx, point.y - from.y - along * dy));
    if (from.y > point.y !== to.y > point.y && point.x < from.x + ((point.y - from.y) * dx) / dy) within = !within;
  });
  return within ? nearest : -nearest;
}

/**
 * The position in a message; null without a finite one. `turned` is the direction in radians, null for a satellite fix.
 * @param {any} fields @param {{lat0: number, lon0: number}} origin of a satellite fix
 * @returns {(Point & {turned: number | null}) | null}
 */
export function positionIn(fields, { lat0, lon0 }) {
  if (typeof fields?.latitude === "number" && typeof fields.longitude === "number") {
    const radians = Math.PI / 180;
    const x = (fields.longitude - lon0) * radians * EARTH * Math.cos(lat0 * radians);
    return { x, y: (fields.latitude - lat0) * radians * EARTH, turned: null };
  }
  const pose = fields?.pose?.pose ?? fields?.pose ?? fields;
  const { x, y } = pose?.position ?? {};
  if (typeof x !== "number" || typeof y !== "number") return null;
  const { x: qx, y: qy, z: qz, w: qw } = pose.orientation ?? {};
  const turned = Math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz));
  return { x, y, turned: Number.isFinite(turned) ? turned : null };
}
