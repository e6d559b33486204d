// Bytes that a page carries: base64 of raw deflate, and the SHA-256 by which a session names its scene and its core.

/** Bytes of a text element. @param {string} text base64 of raw deflate @returns {Promise<Uint8Array<ArrayBuffer>>} */
export async function inflated(text) {
  const stream = new Blob([decoded(text.trim())]).stream().pipeThrough(new DecompressionStream("deflate-raw"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Bytes of base64; a page may carry many millions. @param {string} text @returns {Uint8Array<ArrayBuffer>} */
export function decoded(text) {
  const fast = /** @type {any} */ (Uint8Array).fromBase64;
  if (fast) return fast(text);
  const plain = atob(text), bytes = new Uint8Array(plain.length);
  for (let k = 0; k < plain.length; ++k) bytes[k] = plain.charCodeAt(k);
  return bytes;
}

/** @param {Float64Array} values little-endian, as every machine with a browser has it */
export function inBase64(values) {
  const bytes = new Uint8Array(values.buffer, values.byteOffset, values.byteLength);
  let text = "";
  for (let k = 0; k < bytes.length; k += 0x8000) text += String.fromCharCode(...bytes.subarray(k, k + 0x8000));
  return btoa(text);
}

/** SHA-256 by the browser, aside; empty where it has none for pages like this. @param {Uint8Array<ArrayBuffer>} bytes @returns {Promise<string>} */
export async function digest(bytes) {
  return globalThis.crypto?.subtle ? hexadecimal(new Uint8Array(await crypto.subtle.digest("SHA-256", bytes))) : "";
}

/** @param {Uint8Array} bytes */
function hexadecimal(bytes) {
  return Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");
}

/** Roots of the first primes, as SHA-256 asks for: the first 32 bits of their fractions. @param {number} count @param {number} power */
function fractions(count, power) {
  const found = [];
  for (let n = 2; found.length < count; ++n) {
    let prime = true;
    for (let d = 2; d * d <= n; ++d) prime &&= n % d !== 0;
    if (prime) found.push(((n ** power % 1) * 2 ** 32) | 0);
  }
  return found;
}

/** SHA-256 in hexadecimal; written out, because pages that are not served securely have no crypto.subtle. @param {Uint8Array} bytes */
export function sha256(bytes) {
  const constants = fractions(64, 1 / 3), hash = Int32Array.from(fractions(8, 1 / 2)), blocks = Math.ceil((bytes.length + 9) / 64);
  const padded = new Uint8Array(64 * blocks), view = new DataView(padded.buffer), w = new Int32Array(64);
  padded.set(bytes);
  padded[bytes.length] = 0x80;
  view.setUint32(padded.length - 8, Math.floor(bytes.length / 2 ** 29));
  view.setUint32(padded.length - 4, (bytes.length << 3) >>> 0);
  const turn = (/** @type {number} */ x, /** @type {number} */ n) => (x >>> n) | (x << (32 - n));
  for (let block = 0; block < blocks; ++block) {
    for (let i = 0; i < 16; ++i) w[i] = view.getInt32(64 * block + 4 * i);
    for (let i = 16; i < 64; ++i) {
      const a = w[i - 15], b = w[i - 2];
      w[i] = w[i - 16] + (turn(a, 7) ^ turn(a, 18) ^ (a >>> 3)) + w[i - 7] + (turn(b, 17) ^ turn(b, 19) ^ (b >>> 10));
    }
    let [a, b, c, d, e, f, g, h] = hash;
    for (let i = 0; i < 64; ++i) {
      const one = (h + (turn(e, 6) ^ turn(e, 11) ^ turn(e, 25)) + ((e & f) ^ (~e & g)) + constants[i] + w[i]) | 0;
      const two = ((turn(a, 2) ^ turn(a, 13) ^ turn(a, 22)) + ((a & b) ^ (a & c) ^ (b & c))) | 0;
      [h, g, f, e, d, c, b, a] = [g, f, e, (d + one) | 0, c, b, a, (one + two) | 0];
    }
    [a, b, c, d, e, f, g, h].forEach((value, k) => (hash[k] = hash[k] + value));
  }
  return Array.from(hash, (value) => (value >>> 0).toString(16).padStart(8, "0")).join("");
}
