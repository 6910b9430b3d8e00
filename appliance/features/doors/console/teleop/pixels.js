/** Images of ROS as pictures that a canvas can draw. Everything in a message comes from the network. */

const MOST_PIXELS = 16_000_000;
const MAGIC = /** @type {[number[], string][]} */ ([[[0xff, 0xd8, 0xff], "image/jpeg"], [[0x89, 0x50, 0x4e, 0x47], "image/png"], [[0x52, 0x49, 0x46, 0x46], "image/webp"]]);
/** Bytes of a pixel, and the places of red, green and blue in it. @type {Record<string, [number, number, number, number]>} */
const COLOURS = {
  rgb8: [3, 0, 1, 2], bgr8: [3, 2, 1, 0], "8UC3": [3, 2, 1, 0], rgba8: [4, 0, 1, 2], bgra8: [4, 2, 1, 0], "8UC4": [4, 2, 1, 0],
  mono8: [1, 0, 0, 0], "8UC1": [1, 0, 0, 0],
};
/** Single values of more bits, which are drawn from the least to the greatest. @type {Record<string, [number, "getUint16" | "getInt16" | "getFloat32"]>} */
const DEPTHS = { mono16: [2, "getUint16"], "16UC1": [2, "getUint16"], "16SC1": [2, "getInt16"], "32FC1": [4, "getFloat32"] };

/** Return the picture of a `CompressedImage` or an `Image`. Throws an error in words. @param {any} message @returns {Promise<ImageBitmap>} */
export function decoded(message) {
  const bytes = bytesOf(message.data);
  if (message.encoding !== undefined) return createImageBitmap(pixels(message, bytes));
  const [, type] = MAGIC.find(([magic]) => magic.every((byte, at) => bytes[at] === byte)) ?? [];
  if (!type) throw new Error(`The format ${message.format || "without a name"} is not JPEG, PNG or WebP.`);
  return createImageBitmap(new Blob([bytes], { type }));
}

/** The pixels of an `Image`. Throws. @param {any} message @param {Uint8Array<ArrayBuffer>} bytes */
export function pixels({ width, height, step, encoding, is_bigendian }, bytes) {
  const size = COLOURS[encoding]?.[0] ?? DEPTHS[encoding]?.[0];
  if (!size) throw new Error(`The encoding ${encoding || "without a name"} is not shown.`);
  if (!width || !height || width * height > MOST_PIXELS) throw new Error(`An image of ${width} × ${height} is not shown; the limit is ${MOST_PIXELS / 1e6} million pixels.`);
  if (step < width * size || bytes.length < step * height) throw new Error(`An image of ${width} × ${height} in ${encoding} has more than ${bytes.length} bytes.`);
  const image = new ImageData(width, height);
  if (COLOURS[encoding]) colours(image, bytes, step, COLOURS[encoding]);
  else depths(image, new DataView(bytes.buffer), step, DEPTHS[encoding], !is_bigendian);
  return image;
}

function colours(/** @type {ImageData} */ image, /** @type {Uint8Array} */ bytes, /** @type {number} */ step, [size, red, green, blue]) {
  let to = 0;
  for (let row = 0; row < image.height; row += 1) {
    for (let at = row * step, end = at + image.width * size; at < end; at += size) {
      image.data[to] = bytes[at + red];
      image.data[to + 1] = bytes[at + green];
      image.data[to + 2] = bytes[at + blue];
      image.data[to + 3] = 255;
      to += 4;
    }
  }
}

function depths(/** @type {ImageData} */ image, /** @type {DataView} */ view, /** @type {number} */ step, [size, read], /** @type {boolean} */ little) {
  const at = (/** @type {number} */ pixel) => view[read](Math.floor(pixel / image.width) * step + (pixel % image.width) * size, little);
  const count = image.width * image.height;
  let [least, most] = [Infinity, -Infinity];
  for (let pixel = 0; pixel < count; pixel += 1) {
    const value = at(pixel);
    if (Number.isFinite(value)) [least, most] = [Math.min(least, value), Math.max(most, value)];
  }
  const scale = most > least ? 255 / (most - least) : 0;
  for (let pixel = 0; pixel < count; pixel += 1) {
    const value = at(pixel);
    image.data.fill(Number.isFinite(value) ? (value - least) * scale : 0, pixel * 4, pixel * 4 + 3);
    image.data[pixel * 4 + 3] = 255;
  }
}

function bytesOf(/** @type {string} */ base64) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let at = 0; at < text.length; at += 1) bytes[at] = text.charCodeAt(at);
  return bytes;
}
