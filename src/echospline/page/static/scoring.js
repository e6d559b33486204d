// Scores of a recorded insertion, in the plane or in space: the definitions of page/scoring.py, line by line; a test compares both.

/** @import { Exercise } from "./scene.js" */
/**
 * A recorded insertion, one row per step: poses are [entry, tip, speed], watched the deformed centres of target and vessels, in `dimension`
 * numbers each; in space `seen` says at which steps the tip was in the picture.
 * @typedef {{ period: number, dimension: number, poses: Float64Array, watched: Float64Array, places: number, seen: Uint8Array | null }} Trace
 */
/**
 * Result of an exercise; lengths mm, times s; null stands for infinite.
 * @typedef {{
 *   passed: boolean, time: number, tissue_time: number, path_length: number, path_inefficiency: number | null, tissue_damage: number,
 *   punctures: number, redirections: number, smoothness: number, final_error: number | null, target_shift: number, vessel_contacts: number, picture_time?: number
 * }} Score
 */

const INSIDE = 0.5; // mm; a needle this deep is in the tissue
const TURN = 3, TURN_REST = 0.5; // degrees that make a redirection; s of a steady direction that end it
const STEADY = 0.01; // degrees between rows of a steady direction
const JERK_INTERVAL = 0.05; // s over which positions are averaged before the third difference

/** Numbers of a row of poses. @param {{ dimension: number }} trace */
export function rowOf({ dimension }) {
  return 2 * dimension + 1;
}

/** Number of rows. @param {Trace} trace */
export function rowsOf(trace) {
  return trace.poses.length / rowOf(trace);
}

/** @param {Trace} trace @param {number} row @returns {Float64Array} mm */
export function entryAt({ poses, dimension }, row) {
  const k = (2 * dimension + 1) * row;
  return poses.subarray(k, k + dimension);
}

/** @param {Trace} trace @param {number} row @returns {Float64Array} mm */
export function tipAt({ poses, dimension }, row) {
  const k = (2 * dimension + 1) * row + dimension;
  return poses.subarray(k, k + dimension);
}

/** Deformed centre of a place. @param {Trace} trace @param {number} row @param {number} place @returns {Float64Array} mm */
export function watchedAt({ watched, places, dimension }, row, place) {
  const k = dimension * (row * places + place);
  return watched.subarray(k, k + dimension);
}

/** @param {ArrayLike<number>} a @param {ArrayLike<number>} b */
export function apart(a, b) {
  return a.length === 2 ? Math.hypot(a[0] - b[0], a[1] - b[1]) : Math.hypot(Math.hypot(a[0] - b[0], a[1] - b[1]), a[2] - b[2]);
}

/** Score a trace: a pure function, so that a stored session can be scored again. @param {Trace} trace @param {Exercise} exercise @returns {Score} */
export function scoreOf(trace, exercise) {
  const n = rowsOf(trace), { period, seen } = trace;
  if (trace.places !== 1 + exercise.vessels.length) throw new Error(`a trace of this exercise watches ${1 + exercise.vessels.length} places; got ${trace.places}`);
  if (n === 0) {
    return { passed: false, time: 0, tissue_time: 0, path_length: 0, path_inefficiency: 0, tissue_damage: 0, punctures: 0, redirections: 0, smoothness: 0, final_error: null, target_shift: 0, vessel_contacts: 0, ...(seen ? { picture_time: 0 } : {}) };
  }
  const inside = insideOf(trace);
  let path = 0, damage = 0;
  for (let row = 1; row < n; ++row) {
    if (!inside[row] || !inside[row - 1]) continue;
    path += apart(tipAt(trace, row), tipAt(trace, row - 1));
    damage += sweptArea(trace, row);
  }
  const touched = exercise.vessels.reduce((sum, vessel, j) => sum + rises(contactsOf(trace, 1 + j, vessel.radius, inside)), 0);
  const last = n - 1, target = watchedAt(trace, last, 0);
  const error = inside[last] ? apart(tipAt(trace, last), target) : Infinity;
  const turned = redirectionsOf(trace, inside).length, most = exercise.most_redirections ?? Infinity;
  const inefficiency = inefficiencyOf(trace, inside, path);
  return {
    passed: error <= exercise.target.radius && touched === 0 && turned <= most, time: period * n, tissue_time: period * inside.reduce((a, b) => a + b, 0),
    path_length: path, path_inefficiency: Number.isFinite(inefficiency) ? inefficiency : null, tissue_damage: damage, punctures: rises(inside), redirections: turned,
    smoothness: smoothnessOf(trace), final_error: Number.isFinite(error) ? error : null, target_shift: apart(target, exercise.target.centre), vessel_contacts: touched,
    ...(seen ? { picture_time: period * inside.reduce((sum, on, row) => sum + Number(on && seen[row]), 0) } : {}),
  };
}

/** Which rows have the needle in the tissue. @param {Trace} trace @returns {Uint8Array} */
export function insideOf(trace) {
  return Uint8Array.from({ length: rowsOf(trace) }, (_, row) => Number(apart(tipAt(trace, row), entryAt(trace, row)) > INSIDE));
}

/** Area between the shaft of a row and that of the row before, mm^2. @param {Trace} trace @param {number} row */
function sweptArea(trace, row) {
  const [a, b, c, d] = [entryAt(trace, row - 1), tipAt(trace, row - 1), tipAt(trace, row), entryAt(trace, row)];
  return triangleArea(a, b, c) + triangleArea(a, c, d);
}

/** @param {ArrayLike<number>} a @param {ArrayLike<number>} b @param {ArrayLike<number>} c */
function triangleArea(a, b, c) {
  return 0.5 * crossed(minus(b, a), minus(c, a));
}

/** @param {ArrayLike<number>} a @param {ArrayLike<number>} b @returns {number[]} */
function minus(a, b) {
  return Array.from(a, (value, d) => value - b[d]);
}

/** Length of the cross product. @param {number[]} u @param {number[]} v */
function crossed(u, v) {
  const z = u[0] * v[1] - u[1] * v[0];
  return u.length === 2 ? Math.abs(z) : Math.hypot(Math.hypot(u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2]), z);
}

/** Rows at which a turn inside the tissue exceeds TURN; one turn lasts until the needle holds still. @param {Trace} trace @param {Uint8Array} inside @returns {number[]} */
export function redirectionsOf(trace, inside) {
  const rest = Math.max(1, roundHalfEven(TURN_REST / trace.period)), found = [], between = turnsOf(trace);
  let held = 0, turning = false, still = 0;
  for (let row = 0; row < inside.length; ++row) {
    if (!row || !inside[row] || !inside[row - 1]) {
      held = row;
      turning = false;
      still = 0;
      continue;
    }
    still = between(row, row - 1) < STEADY ? still + 1 : 0;
    if (!turning && between(row, held) > TURN) {
      found.push(row);
      turning = true;
    }
    if (still >= rest) {
      held = row;
      turning = false;
    }
  }
  return found;
}

/** Degrees between the directions of two rows. @param {Trace} trace @returns {(row: number, other: number) => number} */
function turnsOf(trace) {
  const along = (/** @type {number} */ row) => minus(tipAt(trace, row), entryAt(trace, row));
  if (trace.dimension === 3) {
    return (row, other) => {
      const [a, b] = [along(row), along(other)];
      return (Math.atan2(crossed(a, b), a[0] * b[0] + a[1] * b[1] + a[2] * b[2]) * 180) / Math.PI;
    };
  }
  const degrees = new Float64Array(rowsOf(trace));
  let before = 0, whole = 0;
  for (let row = 0; row < degrees.length; ++row) {
    const [x, y] = along(row), raw = Math.atan2(y, x);
    if (row) whole += unwrapping(raw - before);
    degrees[row] = ((raw + whole) * 180) / Math.PI;
    before = raw;
  }
  return (row, other) => Math.abs(degrees[row] - degrees[other]);
}

/** Which rows have the shaft in a round structure that moves with the tissue. @param {Trace} trace @param {number} place @param {number} radius mm @param {Uint8Array} inside @returns {Uint8Array} */
export function contactsOf(trace, place, radius, inside) {
  return inside.map((on, row) => {
    if (!on) return 0;
    const entry = entryAt(trace, row), along = minus(tipAt(trace, row), entry), from = minus(watchedAt(trace, row, place), entry);
    const [dot, square] = along.reduce(([a, b], value, d) => [a + from[d] * value, b + value * value], [0, 0]);
    const t = Math.min(1, Math.max(0, dot / Math.max(square, 1e-12)));
    return Number(apart(along.map((value) => t * value), from) <= radius);
  });
}

/** Root of the integral of the squared jerk of the tip, mm/s^2.5. @param {Trace} trace */
function smoothnessOf(trace) {
  const { period, dimension } = trace, rows = Math.max(1, roundHalfEven(JERK_INTERVAL / period)), blocks = Math.floor(rowsOf(trace) / rows), dt = rows * period;
  if (blocks < 4) return 0;
  let sum = 0;
  for (let axis = 0; axis < dimension; ++axis) {
    const mean = Float64Array.from({ length: blocks }, (_, b) => {
      let total = 0;
      for (let row = 0; row < rows; ++row) total += tipAt(trace, b * rows + row)[axis];
      return total / rows;
    });
    for (let b = 3; b < blocks; ++b) sum += ((mean[b] - mean[b - 1] - 2 * (mean[b - 1] - mean[b - 2]) + (mean[b - 2] - mean[b - 3])) / dt ** 3) ** 2;
  }
  return Math.sqrt(sum * dt);
}

/** @param {Trace} trace @param {Uint8Array} inside @param {number} path mm */
function inefficiencyOf(trace, inside, path) {
  const first = inside.indexOf(1), last = inside.lastIndexOf(1);
  if (first < 0) return 0;
  const straight = apart(tipAt(trace, last), tipAt(trace, first));
  return straight > INSIDE ? 100 * (path / straight - 1) : Infinity;
}

/** How often a flag rises. @param {Uint8Array} flag */
export function rises(flag) {
  return flag.reduce((count, on, row) => count + Number(on && !(row && flag[row - 1])), 0);
}

/** What numpy.unwrap adds to the angles from here on, by the difference from the one before; radians. @param {number} turn */
function unwrapping(turn) {
  if (Math.abs(turn) < Math.PI) return 0;
  const whole = 2 * Math.PI, inner = (((turn + Math.PI) % whole) + whole) % whole - Math.PI;
  return (inner === -Math.PI && turn > 0 ? Math.PI : inner) - turn;
}

/** Round as Python does. @param {number} value */
function roundHalfEven(value) {
  const low = Math.floor(value);
  return value - low === 0.5 ? low + (low % 2) : Math.round(value);
}
