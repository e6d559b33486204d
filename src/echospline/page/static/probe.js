// A probe as a hand holds it in space: where its plane lies, what its picture shows, and points seen from there. In the plane it never moves.

import { PackError, asNumber, asNumbers, asRecord, asWhole } from "./checked.js";

/** Middle of the face (mm), then yaw, pitch and roll (degrees), as in Python. @typedef {[number, number, number, number, number, number]} ProbePose */
/**
 * Shape of a probe's picture; lengths mm, opening degrees.
 * @typedef {{
 *   shape: "linear" | "curved", columns: number, rows: number, spacing: number[], origin: number[], width: number, radius: number, opening: number,
 *   depth: number, pose: ProbePose, elevation: number, elevation_depth: number, element_height: number
 * }} Probe
 */

export const MOST_TILT = 45; // degrees
const SLICE_SIGMAS = 2, LEAST_SLICE = 0.5; // a tip is in the slice up to so many sigma of its thickness, and up to so many mm where it is thinner
const LARGEST_PICTURE = 2048 * 2048;

/** @param {unknown} value @returns {Probe} */
export function readProbe(value) {
  const p = asRecord(value, "probe"), n = (/** @type {string} */ key, /** @type {number} */ low, /** @type {number} */ high) => asNumber(p[key], `probe.${key}`, low, high);
  if (p.shape !== "linear" && p.shape !== "curved") throw new PackError("A probe is linear or curved. Make the page anew.");
  const columns = asWhole(p.columns, "probe.columns", 2, 4096), rows = asWhole(p.rows, "probe.rows", 2, 4096), spacing = asNumbers(p.spacing, "probe.spacing", 2);
  if (columns * rows > LARGEST_PICTURE || Math.min(...spacing) <= 0) throw new PackError("The probe's picture is not one that a page can draw: make its pixels larger.");
  const curved = p.shape === "curved", radius = curved ? n("radius", 1, 500) : 0, opening = curved ? n("opening", 1, 179) : 0, depth = n("depth", 1, 500);
  const width = (columns - 1) * spacing[0], top = curved ? radius * (Math.cos(((opening / 2) * Math.PI) / 180) - 1) : 0;
  return {
    shape: p.shape, columns, rows, spacing, origin: p.origin ? asNumbers(p.origin, "probe.origin", 2) : [-Math.floor(columns / 2) * spacing[0], top], width, radius, opening, depth,
    pose: /** @type {ProbePose} */ (asNumbers(p.pose, "probe.pose", 6)), elevation: n("elevation", 0, 100), elevation_depth: n("elevation_depth", 0.1, 1000),
    element_height: n("element_height", 0, 200),
  };
}

/** Matrix (16 numbers, row by row) that takes the plane's frame to the scene's. @param {ProbePose} pose @returns {number[]} */
export function planeMatrix([x, y, z, yaw, pitch, roll]) {
  const [a, b, c] = [yaw, pitch, roll].map((degrees) => (degrees * Math.PI) / 180);
  const [ca, sa, cb, sb, cc, sc] = [Math.cos(a), Math.sin(a), Math.cos(b), Math.sin(b), Math.cos(c), Math.sin(c)];
  return [
    ca * cc + sa * sb * sc, sa * sb * cc - ca * sc, sa * cb, x,
    cb * sc, cb * cc, -sb, y,
    ca * sb * sc - sa * cc, sa * sc + ca * sb * cc, ca * cb, z,
    0, 0, 0, 1,
  ];
}

/** The pose of a plane: the inverse of `planeMatrix`. @param {ArrayLike<number>} m 16 numbers, row by row @returns {ProbePose} */
export function poseOfMatrix(m) {
  const degrees = 180 / Math.PI;
  return [m[3], m[7], m[11], Math.atan2(m[2], m[10]) * degrees, Math.asin(Math.max(-1, Math.min(1, -m[6]))) * degrees, Math.atan2(m[4], m[5]) * degrees];
}

/** A pose turned about its own axes: yaw, then pitch, then roll, degrees. @param {ProbePose} pose @param {ArrayLike<number>} turn @returns {ProbePose} */
export function turnedBy(pose, turn) {
  const a = planeMatrix(pose), b = planeMatrix([0, 0, 0, turn[0], turn[1], turn[2]]);
  const at = (/** @type {number} */ i, /** @type {number} */ j) => (j === 3 ? a[4 * i + 3] : a[4 * i] * b[j] + a[4 * i + 1] * b[4 + j] + a[4 * i + 2] * b[8 + j]);
  return poseOfMatrix(Array.from({ length: 16 }, (_, k) => (k < 12 ? at(k >> 2, k & 3) : k === 15 ? 1 : 0)));
}

/** A point of the scene in the frame of the plane: lateral, depth, and how far off the plane, mm. @param {number[] | null} m null: the scene is the plane @param {ArrayLike<number>} p @returns {[number, number, number]} */
export function lowered(m, p) {
  if (!m) return [p[0], p[1], 0];
  const [x, y, z] = [p[0] - m[3], p[1] - m[7], p[2] - m[11]];
  return [m[0] * x + m[4] * y + m[8] * z, m[1] * x + m[5] * y + m[9] * z, m[2] * x + m[6] * y + m[10] * z];
}

/** A direction of the scene in the frame of the plane. @param {number[] | null} m @param {ArrayLike<number>} d @returns {[number, number, number]} */
export function turnedDown(m, d) {
  return m ? [m[0] * d[0] + m[4] * d[1] + m[8] * d[2], m[1] * d[0] + m[5] * d[1] + m[9] * d[2], m[2] * d[0] + m[6] * d[1] + m[10] * d[2]] : [d[0], d[1], 0];
}

/** A point of the plane in the scene. @param {number[]} m @param {ArrayLike<number>} p lateral, depth, off the plane @returns {[number, number, number]} */
export function raised(m, p) {
  const z = p[2] ?? 0;
  return [m[0] * p[0] + m[1] * p[1] + m[2] * z + m[3], m[4] * p[0] + m[5] * p[1] + m[6] * z + m[7], m[8] * p[0] + m[9] * p[1] + m[10] * z + m[11]];
}

/** A pose shifted along the probe's face and across it, on the skin. @param {ArrayLike<number>} pose @param {number} along @param {number} across mm @returns {ProbePose} */
export function shifted(pose, along, across) {
  const yaw = (pose[3] * Math.PI) / 180, [c, s] = [Math.cos(yaw), Math.sin(yaw)];
  return [pose[0] + along * c + across * s, pose[1], pose[2] - along * s + across * c, pose[3], pose[4], pose[5]];
}

/** A pose that a hand can hold: over the tissue, tilted and rocked no further than MOST_TILT. @param {number[]} pose @param {number[]} low @param {number[]} high mm @returns {ProbePose} */
export function heldBetween([x, y, z, yaw, pitch, roll], low, high) {
  const within = (/** @type {number} */ value, /** @type {number} */ least, /** @type {number} */ most) => Math.min(Math.max(value, least), most);
  return [
    within(x, low[0], high[0]), y, within(z, low[2], high[2]), ((((yaw + 180) % 360) + 360) % 360) - 180, within(pitch, -MOST_TILT, MOST_TILT), within(roll, -MOST_TILT, MOST_TILT),
  ];
}

/** Which pixels the beams reach, 0 or 1; null where all are. @param {Probe} probe @returns {Uint8Array | undefined} */
export function maskOf({ shape, columns, rows, spacing, origin, radius, opening, depth }) {
  if (shape === "linear") return undefined;
  const mask = new Uint8Array(columns * rows), half = 1e-9 + spacing[0] / 2, widest = (opening / 2) * (Math.PI / 180) + 1e-9;
  for (let row = 0; row < rows; ++row) {
    for (let column = 0; column < columns; ++column) {
      const x = origin[0] + column * spacing[0], y = origin[1] + row * spacing[1] + radius, r = Math.hypot(x, y);
      mask[row * columns + column] = Number(r >= radius - half && r <= radius + depth + half && Math.atan2(Math.abs(x), y) <= widest);
    }
  }
  return mask;
}

/** Sigma of the slice at each row, mm. @param {Probe} probe @returns {Float32Array | undefined} undefined: infinitely thin */
export function spreadOf(probe) {
  if (probe.elevation === 0) return undefined;
  return Float32Array.from({ length: probe.rows }, (_, row) => sigmaAt(probe, probe.origin[1] + row * probe.spacing[1]));
}

/** Whether a tip is in the picture: in the slice, and where the beams reach; the definition of page/probe.py. @param {Probe} probe @param {ProbePose} pose @param {ArrayLike<number>} tip mm */
export function tipSeen(probe, pose, tip) {
  const [x, y, off] = lowered(planeMatrix(pose), tip), { shape, columns, rows, spacing, origin, radius, opening, depth } = probe, [dx, dy] = spacing;
  if (x < origin[0] - dx / 2 || x > origin[0] + (columns - 0.5) * dx || y < origin[1] - dy / 2 || y > origin[1] + (rows - 0.5) * dy) return false;
  if (shape === "curved") {
    const r = Math.hypot(x, y + radius), half = 1e-9 + dx / 2;
    if (r < radius - half || r > radius + depth + half || Math.atan2(Math.abs(x), y + radius) > (opening / 2) * (Math.PI / 180) + 1e-9) return false;
  }
  return Math.abs(off) <= Math.max(SLICE_SIGMAS * sigmaAt(probe, y), LEAST_SLICE);
}

/** Sigma of the slice at a depth, mm. @param {Probe} probe @param {number} y mm */
function sigmaAt({ elevation, elevation_depth, element_height }, y) {
  return elevation > 0 ? Math.hypot(((Math.max(0, y) - elevation_depth) * element_height) / (2.5 * elevation_depth), elevation) : 0;
}

/** What a core's plane is made with. @param {Probe} probe */
export function planeOptions(probe) {
  const { columns, rows, spacing, origin } = probe;
  return { columns, rows, spacing, origin, step: 8, mask: maskOf(probe), spread: spreadOf(probe), background: 0 };
}
