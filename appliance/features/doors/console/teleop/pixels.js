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
  require(...sizeOf(bytes, type)); // before it is decoded: some kilobytes may be gigapixels
  return createImageBitmap(new Blob([bytes], { type }));
}

/** Throw unless an image of this size is shown. @param {number} width @param {number} height */
function require(width, height) {
  if (!width || !height || width * height > MOST_PIXELS) throw new Error(`An image of ${width} × ${height} is not shown; the limit is ${MOST_PIXELS / 1e6} million pixels.`);
}

/** The size of a compressed picture, by its head; zeros if it has none. @param {Uint8Array<ArrayBuffer>} bytes @param {string} type @returns {[number, number]} */
export function sizeOf(bytes, type) {
  const view = new DataView(bytes.buffer);
  if (type === "image/png") return bytes.length < 24 ? [0, 0] : [view.getUint32(16), view.getUint32(20)];
  if (type === "image/webp") return bytes.length < 31 ? [0, 0] : sizeOfWebp(view);
  for (let at = 2; at + 9 <= bytes.length && bytes[at] === 0xff; ) {
    const marker = bytes[at + 1];
    if (marker === 0xff) at += 1; // a filler
    else if (marker >= 0xc0 && marker <= 0xcf && ![0xc4, 0xc8, 0xcc].includes(marker)) return [view.getUint16(at + 7), view.getUint16(at + 5)];
    else at += 2 + view.getUint16(at + 2);
  }
  return [0, 0];
}

function sizeOfWebp(/** @type {DataView} */ view) {
  const kind = view.getUint8(15);
  const bits = view.getUint32(kind === 0x4c ? 21 : 26, true);
  if (kind === 0x4c) return /** @type {[number, number]} */ ([(bits & 0x3fff) + 1, ((bits >> 14) & 0x3fff) + 1]); // VP8L
  if (kind === 0x20) return /** @type {[number, number]} */ ([bits & 0x3fff, (bits >> 16) & 0x3fff]); // VP8
  return /** @type {[number, number]} */ ([(view.getUint32(24, true) & 0xffffff) + 1, (view.getUint32(27, true) & 0xffffff) + 1]); // VP8X
}

/** The pixels of an `Image`. Throws. @param {any} message @param {Uint8Array<ArrayBuffer>} bytes */
export function pixels({ width, height, step, encoding, is_bigendian }, bytes) {
  const size = COLOURS[encoding]?.[0] ?? DEPTHS[encoding]?.[0];
  if (!size) throw new Error(`The encoding ${encoding || "without a name"} is not shown.`);
  require(width, height);
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
