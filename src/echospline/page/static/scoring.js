// Scores of a recorded insertion in the plane: the definitions of page/scoring.py, line by line; a test compares both.

/** @import { Exercise } from "./scene.js" */
/**
 * A recorded insertion, one row per step: poses are [entry x, y, tip x, y, speed], watched the deformed centres of target and vessels.
 * @typedef {{ period: number, poses: Float64Array, watched: Float64Array, places: number }} Trace
 */
/**
 * Result of an exercise; lengths mm, times s; null stands for infinite.
 * @typedef {{
 *   passed: boolean, time: number, tissue_time: number, path_length: number, path_inefficiency: number | null, tissue_damage: number,
 *   punctures: number, redirections: number, smoothness: number, final_error: number | null, target_shift: number, vessel_contacts: number
 * }} Score
 */

export const ROW = 5; // numbers of a pose in the plane
const INSIDE = 0.5; // mm; a needle this deep is in the tissue
const TURN = 3, TURN_REST = 0.5; // degrees that make a redirection; s of a steady direction that end it
const STEADY = 0.01; // degrees between rows of a steady direction
const JERK_INTERVAL = 0.05; // s over which positions are averaged before the third difference

/** Number of rows. @param {Trace} trace */
export function rowsOf(trace) {
  return trace.poses.length / ROW;
}

/** Score a trace: a pure function, so that a stored session can be scored again. @param {Trace} trace @param {Exercise} exercise @returns {Score} */
export function scoreOf(trace, exercise) {
  const n = rowsOf(trace), { poses, period } = trace;
  if (trace.places !== 1 + exercise.vessels.length) throw new Error(`a trace of this exercise watches ${1 + exercise.vessels.length} places; got ${trace.places}`);
  if (n === 0) {
    return { passed: false, time: 0, tissue_time: 0, path_length: 0, path_inefficiency: 0, tissue_damage: 0, punctures: 0, redirections: 0, smoothness: 0, final_error: null, target_shift: 0, vessel_contacts: 0 };
  }
  const inside = insideOf(trace);
  let path = 0, damage = 0;
  for (let row = 1; row < n; ++row) {
    if (!inside[row] || !inside[row - 1]) continue;
    path += Math.hypot(poses[ROW * row + 2] - poses[ROW * row - 3], poses[ROW * row + 3] - poses[ROW * row - 2]);
    damage += sweptArea(poses, row);
  }
  const touched = exercise.vessels.reduce((sum, vessel, j) => sum + rises(contactsOf(trace, 1 + j, vessel.radius, inside)), 0);
  const last = n - 1, [x, y] = watchedAt(trace, last, 0);
  const error = inside[last] ? Math.hypot(poses[ROW * last + 2] - x, poses[ROW * last + 3] - y) : Infinity;
  const turned = redirectionsOf(trace, inside).length, most = exercise.most_redirections ?? Infinity;
  const inefficiency = inefficiencyOf(trace, inside, path), [cx, cy] = exercise.target.centre;
  return {
    passed: error <= exercise.target.radius && touched === 0 && turned <= most, time: period * n, tissue_time: period * inside.reduce((a, b) => a + b, 0),
    path_length: path, path_inefficiency: Number.isFinite(inefficiency) ? inefficiency : null, tissue_damage: damage, punctures: rises(inside), redirections: turned,
    smoothness: smoothnessOf(trace), final_error: Number.isFinite(error) ? error : null, target_shift: Math.hypot(x - cx, y - cy), vessel_contacts: touched,
  };
}

/** Which rows have the needle in the tissue. @param {Trace} trace @returns {Uint8Array} */
export function insideOf({ poses }) {
  return Uint8Array.from({ length: poses.length / ROW }, (_, row) => Number(Math.hypot(poses[ROW * row + 2] - poses[ROW * row], poses[ROW * row + 3] - poses[ROW * row + 1]) > INSIDE));
}

/** Deformed centre of a place. @param {Trace} trace @param {number} row @param {number} place @returns {[number, number]} */
export function watchedAt({ watched, places }, row, place) {
  const k = 2 * (row * places + place);
  return [watched[k], watched[k + 1]];
}

/** Area between the shaft of a row and that of the row before, mm^2. @param {Float64Array} p @param {number} row */
function sweptArea(p, row) {
  const b = ROW * row, a = b - ROW; // entry and tip before: a, a + 2; now: b, b + 2
  return triangleArea(p, a, a + 2, b + 2) + triangleArea(p, a, b + 2, b);
}

/** @param {Float64Array} p @param {number} a @param {number} b @param {number} c */
function triangleArea(p, a, b, c) {
  return 0.5 * Math.abs((p[b] - p[a]) * (p[c + 1] - p[a + 1]) - (p[b + 1] - p[a + 1]) * (p[c] - p[a]));
}

/** Rows at which a turn inside the tissue exceeds TURN; one turn lasts until the needle holds still. @param {Trace} trace @param {Uint8Array} inside @returns {number[]} */
export function redirectionsOf({ poses, period }, inside) {
  const rest = Math.max(1, roundHalfEven(TURN_REST / period)), found = [];
  let held = 0, turning = false, still = 0, before = 0, whole = 0, degreesBefore = 0;
  for (let row = 0; row < inside.length; ++row) {
    const k = ROW * row, raw = Math.atan2(poses[k + 3] - poses[k + 1], poses[k + 2] - poses[k]);
    if (row) whole += unwrapping(raw - before);
    const degrees = ((raw + whole) * 180) / Math.PI, moved = Math.abs(degrees - degreesBefore);
    before = raw;
    degreesBefore = degrees;
    if (!row || !inside[row] || !inside[row - 1]) {
      held = degrees;
      turning = false;
      still = 0;
      continue;
    }
    still = moved < STEADY ? still + 1 : 0;
    if (!turning && Math.abs(degrees - held) > TURN) {
      found.push(row);
      turning = true;
    }
    if (still >= rest) {
      held = degrees;
      turning = false;
    }
  }
  return found;
}

/** Which rows have the shaft in a disc that moves with the tissue. @param {Trace} trace @param {number} place @param {number} radius @param {Uint8Array} inside @returns {Uint8Array} */
export function contactsOf(trace, place, radius, inside) {
  const { poses } = trace;
  return inside.map((within, row) => {
    if (!within) return 0;
    const k = ROW * row, [cx, cy] = watchedAt(trace, row, place), ux = poses[k + 2] - poses[k], uy = poses[k + 3] - poses[k + 1];
    const t = Math.min(1, Math.max(0, ((cx - poses[k]) * ux + (cy - poses[k + 1]) * uy) / Math.max(ux * ux + uy * uy, 1e-12)));
    return Number(Math.hypot(poses[k] + t * ux - cx, poses[k + 1] + t * uy - cy) <= radius);
  });
}

/** Root of the integral of the squared jerk of the tip, mm/s^2.5. @param {Trace} trace */
function smoothnessOf({ poses, period }) {
  const rows = Math.max(1, roundHalfEven(JERK_INTERVAL / period)), blocks = Math.floor(poses.length / ROW / rows), dt = rows * period;
  if (blocks < 4) return 0;
  let sum = 0;
  for (const axis of [2, 3]) {
    const mean = Float64Array.from({ length: blocks }, (_, b) => {
      let total = 0;
      for (let row = 0; row < rows; ++row) total += poses[ROW * (b * rows + row) + axis];
      return total / rows;
    });
    for (let b = 3; b < blocks; ++b) sum += ((mean[b] - mean[b - 1] - 2 * (mean[b - 1] - mean[b - 2]) + (mean[b - 2] - mean[b - 3])) / dt ** 3) ** 2;
  }
  return Math.sqrt(sum * dt);
}

/** @param {Trace} trace @param {Uint8Array} inside @param {number} path mm */
function inefficiencyOf({ poses }, inside, path) {
  const first = inside.indexOf(1), last = inside.lastIndexOf(1);
  if (first < 0) return 0;
  const straight = Math.hypot(poses[ROW * last + 2] - poses[ROW * first + 2], poses[ROW * last + 3] - poses[ROW * first + 3]);
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
