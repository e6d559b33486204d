// An attempt: recorded row by row, its events, the session that is kept of it, and the checked reader of sessions.

import { decoded, inBase64 } from "./bytes.js";
import { PackError, asList, asNumber, asRecord, asText, asWhole } from "./checked.js";
import { readExercise } from "./scene.js";
import { tipSeen } from "./probe.js";
import { apart, contactsOf, entryAt, insideOf, redirectionsOf, rowsOf, scoreOf, tipAt, watchedAt } from "./scoring.js";

/** @import { Probe, ProbePose } from "./probe.js" */
/** @import { Exercise } from "./scene.js" */
/** @import { Score, Trace } from "./scoring.js" */
/** @typedef {[number, string]} Happening step and kind */
/**
 * What is kept of an attempt: page.md, "A session".
 * @typedef {{
 *   format: 1, kind: "echospline session", version: string, core: string, scene: { title: string, pack: string }, model: string,
 *   exercise: Exercise, examination: boolean, trainee: string, attempt: number, started: string, rate: number, ended: "finished" | "reset" | "time",
 *   steps: number, poses: string, planes: string | null, events: Happening[], score: Score | null
 * }} Session
 */
/** What made a session. @typedef {{ version: string, core: string, title: string, pack: string }} Origin */

const MOST_SESSIONS = 5000, MOST_STEPS = 2_000_000, MOST_EVENTS = 10_000;
const SHARE = "echospline session", SEVERAL = "echospline sessions";

/** Collects an attempt; a row is a step. */
export class Attempt {
  /**
   * @param {Exercise} exercise @param {number} rate steps per second @param {string} model @param {boolean} examination @param {string} trainee @param {Date} started
   * @param {Probe | null} [probe] of a scene in space
   */
  constructor(exercise, rate, model, examination, trainee, started, probe = null) {
    this.exercise = exercise;
    this.rate = rate;
    this.model = model;
    this.examination = examination;
    this.trainee = trainee;
    this.started = started;
    this.probe = probe;
    this.dimension = exercise.target.centre.length;
    /** @type {number[]} */
    this.poses = [];
    /** @type {number[]} */
    this.watched = [];
    /** Rows of step and pose: from that step on the probe was held so. @type {number[]} */
    this.planes = [];
    /** @type {number[]} */
    this.seen = [];
    /** @type {ProbePose | null} */
    this.held = null;
    this.steps = 0;
  }

  /** Points that are watched, flat: centres of target and vessels at rest. */
  get places() {
    return landmarksOf(this.exercise);
  }

  /** @param {{ entry: ArrayLike<number>, tip: ArrayLike<number>, speed: number }} pose @param {ArrayLike<number>} watched @param {ProbePose | null} [held] how the probe is held */
  add({ entry, tip, speed }, watched, held = null) {
    for (let d = 0; d < this.dimension; ++d) this.poses.push(entry[d]);
    for (let d = 0; d < this.dimension; ++d) this.poses.push(tip[d]);
    this.poses.push(speed);
    for (let k = 0; k < watched.length; ++k) this.watched.push(watched[k]);
    if (this.probe && held) {
      if (held !== this.held) this.planes.push(this.steps, ...held);
      this.held = held;
      this.seen.push(Number(tipSeen(this.probe, held, tip)));
    }
    ++this.steps;
  }

  /** @returns {Trace} */
  get trace() {
    return {
      period: 1 / this.rate, dimension: this.dimension, poses: Float64Array.from(this.poses), watched: Float64Array.from(this.watched), places: 1 + this.exercise.vessels.length,
      seen: this.probe ? Uint8Array.from(this.seen) : null,
    };
  }

  /** @param {"finished" | "reset" | "time"} ended @param {number} attempt @param {Origin} origin @returns {Session} */
  session(ended, attempt, origin) {
    const trace = this.trace;
    return {
      format: 1, kind: SHARE, version: origin.version, core: origin.core, scene: { title: origin.title, pack: origin.pack }, model: this.model,
      exercise: this.exercise, examination: this.examination, trainee: this.trainee, attempt, started: this.started.toISOString(), rate: this.rate, ended,
      steps: this.steps, poses: inBase64(trace.poses), planes: this.probe ? inBase64(Float64Array.from(this.planes)) : null, events: eventsOf(trace, this.exercise), score: scoreOf(trace, this.exercise),
    };
  }
}

/** Centres of target and vessels at rest, flat, mm. @param {Exercise} exercise */
export function landmarksOf(exercise) {
  return [exercise.target, ...exercise.vessels].flatMap((ball) => ball.centre);
}

/** What happened at which step. @param {Trace} trace @param {Exercise} exercise @returns {Happening[]} */
export function eventsOf(trace, exercise) {
  const inside = insideOf(trace), n = rowsOf(trace);
  /** @type {Happening[]} */
  const events = [];
  /** @param {ArrayLike<number>} flag @param {string} begun @param {string} [ended] */
  const edges = (flag, begun, ended) => {
    for (let row = 0; row < n; ++row) {
      if (flag[row] && !(row && flag[row - 1])) events.push([row, begun]);
      if (ended && row && !flag[row] && flag[row - 1]) events.push([row, ended]);
    }
  };
  edges(inside, "entered", "left");
  exercise.vessels.forEach((vessel, j) => edges(contactsOf(trace, 1 + j, vessel.radius, inside), "vessel"));
  edges(inside.map((on, row) => Number(on && distanceAt(trace, row) <= exercise.target.radius)), "target");
  for (const row of redirectionsOf(trace, inside)) events.push([row, "redirection"]);
  if (trace.seen) edges(inside.map((on, row) => Number(on && !trace.seen?.[row])), "lost");
  return events.sort((a, b) => a[0] - b[0]);
}

/** Tip to the deformed target's centre, mm. @param {Trace} trace @param {number} row */
export function distanceAt(trace, row) {
  return apart(tipAt(trace, row), watchedAt(trace, row, 0));
}

/** Depth and distance to the target over time, thinned for a plot. @param {Trace} trace @param {number} [most] points */
export function plotOf(trace, most = 400) {
  const n = rowsOf(trace), stride = Math.max(1, Math.ceil(n / most));
  const rows = Array.from({ length: Math.ceil(n / stride) }, (_, k) => k * stride);
  return {
    time: rows.map((row) => row * trace.period), distance: rows.map((row) => distanceAt(trace, row)),
    depth: rows.map((row) => apart(tipAt(trace, row), entryAt(trace, row))),
  };
}

/** Poses of a session, rows of [entry, tip, speed]. @param {Session} session @returns {Float64Array} */
export function posesOf(session) {
  return fromBase64(session.poses);
}

/** Where the probe of a session was held, rows of [step, pose]; null in the plane. @param {Session} session @returns {Float64Array | null} */
export function planesOf(session) {
  return session.planes === null ? null : fromBase64(session.planes);
}

/** How the probe was held at a row. @param {Float64Array} planes @param {number} row @returns {ProbePose} */
export function heldAt(planes, row) {
  let k = 0;
  while (7 * (k + 1) < planes.length && planes[7 * (k + 1)] <= row) ++k;
  return /** @type {ProbePose} */ (/** @type {unknown} */ (Array.from(planes.subarray(7 * k + 1, 7 * k + 7))));
}

/** Which rows of poses had the tip in the picture. @param {Probe} probe @param {Float64Array} poses in space @param {Float64Array} planes */
export function seenOf(probe, poses, planes) {
  return Uint8Array.from({ length: poses.length / 7 }, (_, row) => Number(tipSeen(probe, heldAt(planes, row), poses.subarray(7 * row + 3, 7 * row + 6))));
}

/** Sessions of a file: one, or several. @param {string} json @returns {Session[]} */
export function readSessions(json) {
  let value;
  try {
    value = JSON.parse(json);
  } catch {
    throw new PackError("This file is no JSON: choose a file of sessions that this page or another has exported.");
  }
  const given = asRecord(value, "a file of sessions");
  if (given.format !== 1 || (given.kind !== SHARE && given.kind !== SEVERAL)) {
    throw new PackError("This file holds no sessions of echospline: choose one that this page or another has exported.");
  }
  const entries = given.kind === SHARE ? [given] : asList(given.sessions, "sessions", 0, MOST_SESSIONS);
  return entries.map((entry, k) => readSession(entry, `sessions[${k}]`));
}

/** @param {unknown} value @param {string} what @returns {Session} */
export function readSession(value, what) {
  const s = asRecord(value, what);
  if (s.format !== 1 || s.kind !== SHARE) throw new PackError(`${what} is no session of format 1; export it again.`);
  const steps = asWhole(s.steps, `${what}.steps`, 0, MOST_STEPS), scene = asRecord(s.scene, `${what}.scene`);
  const space = Array.isArray(s.exercise?.target?.centre) && s.exercise.target.centre.length === 3, columns = space ? 7 : 5;
  const poses = asText(s.poses, `${what}.poses`, 8 * MOST_STEPS * columns * 2), planes = s.planes === null || s.planes === undefined ? null : asText(s.planes, `${what}.planes`, 8 * MOST_STEPS * 7 * 2);
  if (!/^[A-Za-z0-9+/]*={0,2}$/.test(poses) || poses.length !== 4 * Math.ceil((8 * columns * steps) / 3)) {
    throw new PackError(`${what} says ${steps} steps, but its poses are of another length: the file is cut or changed.`);
  }
  if (!fromBase64(poses).every(Number.isFinite)) throw new PackError(`${what} holds poses that are no finite numbers.`);
  if ((planes !== null) !== space || (planes !== null && !arePlanes(planes))) throw new PackError(`${what} says wrongly where its probe was: the file is cut or changed.`);
  if (!["finished", "reset", "time"].includes(s.ended)) throw new PackError(`${what}.ended is finished, reset or time.`);
  const started = asText(s.started, `${what}.started`, 40);
  if (Number.isNaN(Date.parse(started))) throw new PackError(`${what}.started is no time.`);
  return {
    format: 1, kind: SHARE, version: asText(s.version, `${what}.version`, 80), core: asText(s.core, `${what}.core`, 200),
    scene: { title: asText(scene.title, `${what}.scene.title`, 200), pack: asText(scene.pack, `${what}.scene.pack`, 200) }, model: asText(s.model, `${what}.model`, 40),
    exercise: readExercise(s.exercise, `${what}.exercise`, space ? 3 : 2), examination: s.examination === true, trainee: asText(s.trainee, `${what}.trainee`, 80),
    attempt: asWhole(s.attempt, `${what}.attempt`, 0, 1e6), started, rate: asNumber(s.rate, `${what}.rate`, 10, 2000), ended: s.ended, steps, poses, planes,
    events: asList(s.events, `${what}.events`, 0, MOST_EVENTS).map((e) => {
      const pair = asList(e, `${what}.events`, 2, 2);
      return /** @type {Happening} */ ([asWhole(pair[0], `${what}.events`, 0, MOST_STEPS), asText(pair[1], `${what}.events`, 40)]);
    }),
    score: s.score === null ? null : readScore(s.score, `${what}.score`),
  };
}

/** Whether rows of [step, pose] begin at step 0 and ascend. @param {string} text */
function arePlanes(text) {
  if (!/^[A-Za-z0-9+/]*={0,2}$/.test(text) || text.length % 4) return false;
  const bytes = decoded(text);
  if (bytes.length % 56) return false;
  const rows = new Float64Array(bytes.buffer);
  return rows.every(Number.isFinite) && rows.every((value, k) => k % 7 !== 0 || (k ? value > rows[k - 7] && Number.isInteger(value) : value === 0));
}

/** @param {unknown} value @param {string} what @returns {Score} */
function readScore(value, what) {
  const s = asRecord(value, what);
  const n = (/** @type {string} */ key) => asNumber(s[key], `${what}.${key}`, -1e12, 1e12);
  const open = (/** @type {string} */ key) => (s[key] === null ? null : n(key));
  return {
    passed: s.passed === true, time: n("time"), tissue_time: n("tissue_time"), path_length: n("path_length"), path_inefficiency: open("path_inefficiency"),
    tissue_damage: n("tissue_damage"), punctures: n("punctures"), redirections: n("redirections"), smoothness: n("smoothness"), final_error: open("final_error"),
    target_shift: n("target_shift"), vessel_contacts: n("vessel_contacts"), ...(s.picture_time === undefined ? {} : { picture_time: n("picture_time") }),
  };
}

/** Attempts of a trainee at an exercise so far: as many as are kept, or the highest number among them. @param {Session[]} sessions @param {string} exercise @param {string} trainee */
export function attemptsMade(sessions, exercise, trainee) {
  const own = sessions.filter((session) => session.exercise.name === exercise && session.trainee === trainee);
  return own.reduce((most, session) => Math.max(most, session.attempt), own.length);
}

/** Attempts that a trainee has left; null where there is no limit. @param {Exercise} exercise @param {Session[]} sessions @param {string} trainee */
export function attemptsLeft(exercise, sessions, trainee) {
  return exercise.attempts === null ? null : Math.max(0, exercise.attempts - attemptsMade(sessions, exercise.name, trainee));
}

/** A file of sessions. @param {Session[]} sessions */
export function fileOf(sessions) {
  return JSON.stringify({ format: 1, kind: SEVERAL, sessions });
}

/** @param {string} text @returns {Float64Array} */
function fromBase64(text) {
  return new Float64Array(decoded(text).buffer);
}
