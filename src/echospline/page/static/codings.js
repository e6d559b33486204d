// Arrays of a pack that are written shorter: what their neighbours or their mirror images tell was left out, and is found again bit for bit.

import { PackError, asList, asRecord, asWhole, shown } from "./checked.js";

const LARGEST_WEIGHT = 32767; // in 256ths
const MOST_MIRRORED = 2 ** 24; // entries

/** @typedef {{ read: (from: any) => any, count: number }} Coding how many numbers were written, and the array of them */

/** Check what a pack says of an array's coding. @param {any} entry @param {string} what @param {string} dtype @param {number[]} shape @returns {Coding} */
export function codingOf(entry, what, dtype, shape) {
  const size = shape.reduce((a, b) => a * b, 1), given = asRecord(entry, what);
  if (given.kind === "neighbours") {
    if (dtype !== "uint8" || shape.length !== 3 || shape.some((n) => n < 1 || n > 4096)) throw new PackError(`Neighbours code bytes of three axes up to 4096; ${what} is of ${shown(dtype)} of ${shown(shape)}. Make the page anew.`);
    const weights = asList(given.weights, `${what}.weights`, 7, 7).map((w) => asWhole(w, `${what}.weights`, -LARGEST_WEIGHT, LARGEST_WEIGHT));
    return { count: size, read: (left) => fromResiduals(left, shape, weights) };
  }
  if (given.kind !== "mirrored") throw new PackError(`Expected neighbours or mirrored for ${what}; got ${shown(given.kind)}. Make the page anew with this version.`);
  if (!["float32", "float64"].includes(dtype) || size > MOST_MIRRORED) throw new PackError(`Mirrors code up to ${MOST_MIRRORED} floats; ${what} is of ${size} of ${shown(dtype)}. Make the page anew.`);
  const mirrors = asList(given.mirrors, `${what}.mirrors`, 1, 3).map((value) => mirrorOf(value, what));
  const { rows, columns } = mirrors[0];
  if (mirrors.some((m) => m.rows.length !== rows.length || m.columns.length * rows.length !== size)) {
    throw new PackError(`Rows and columns of the mirrors of ${what} fit no table of ${size} numbers. Make the page anew.`);
  }
  const { from, count } = sources(mirrors, rows.length, columns.length);
  return { count, read: (values) => fromKept(values, from) };
}

/** @param {any} value @param {string} what */
function mirrorOf(value, what) {
  const entry = asRecord(value, what);
  const side = (/** @type {string} */ name) => {
    const list = asList(entry[name], `${what}.${name}`, 1, MOST_MIRRORED);
    return Int32Array.from(list, (k) => {
      if (asWhole(k, `${what}.${name}`, -list.length, list.length) === 0) throw new PackError(`Expected places from 1 for ${what}.${name}; got 0. Make the page anew.`);
      return k;
    });
  };
  return { rows: side("rows"), columns: side("columns") };
}

/** The volume of which residuals were written: one pass, in whole numbers. @param {Uint8Array} left @param {number[]} shape slowest axis first @param {number[]} weights in 256ths */
function fromResiduals(left, [nz, ny, nx], [wx, wy, wxy, wz, wxz, wyz, wxyz]) {
  const voxels = new Uint8Array(left.length), nothing = new Uint8Array(nx);
  const row = (/** @type {number} */ z, /** @type {number} */ y) => (z < 0 || y < 0 ? nothing : voxels.subarray((z * ny + y) * nx, (z * ny + y + 1) * nx));
  for (let z = 0; z < nz; ++z) {
    for (let y = 0; y < ny; ++y) {
      const own = row(z, y), above = row(z, y - 1), behind = row(z - 1, y), corner = row(z - 1, y - 1);
      let a = 0, b = 0, c = 0, d = 0; // the four at x - 1
      for (let x = 0, at = (z * ny + y) * nx; x < nx; ++x, ++at) {
        const up = above[x], back = behind[x], both = corner[x];
        // what the last voxel has no part in comes first: only the rest waits for it
        const sum = (Math.imul(wy, up) + Math.imul(wxy, b) + Math.imul(wz, back) + Math.imul(wxz, c) + Math.imul(wyz, both) + Math.imul(wxyz, d) + 128) | 0;
        const guess = (sum + Math.imul(wx, a)) >> 8;
        own[x] = a = (left[at] + (guess < 0 ? 0 : guess > 255 ? 255 : guess)) & 255;
        b = up;
        c = back;
        d = both;
      }
    }
  }
  return voxels;
}

/** How many entries were written, and for every entry 0 where it was written, else the place of its earlier image, from 1, negative where the sign changes. @param {{ rows: Int32Array, columns: Int32Array }[]} mirrors @param {number} height @param {number} width */
function sources(mirrors, height, width) {
  const from = new Int32Array(height * width);
  let count = from.length;
  for (let r = 0, at = 0; r < height; ++r) {
    for (let c = 0; c < width; ++c, ++at) {
      for (const { rows, columns } of mirrors) {
        const row = rows[r], column = columns[c], image = (Math.abs(row) - 1) * width + Math.abs(column);
        if (image > at) continue;
        from[at] = row < 0 === column < 0 ? image : -image;
        --count;
        break;
      }
    }
  }
  return { from, count };
}

/** @param {Float32Array | Float64Array} values @param {Int32Array} from */
function fromKept(values, from) {
  const table = values instanceof Float32Array ? new Float32Array(from.length) : new Float64Array(from.length);
  for (let at = 0, next = 0; at < from.length; ++at) {
    const image = from[at];
    table[at] = image === 0 ? values[next++] : image > 0 ? table[image - 1] : -table[-image - 1];
  }
  return table;
}
