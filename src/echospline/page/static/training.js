// An attempt: recorded row by row, its events, the session that is kept of it, and the checked reader of sessions.

import { decoded, inBase64 } from "./bytes.js";
import { PackError, asList, asNumber, asRecord, asText, asWhole } from "./checked.js";
import { inPicture } from "./probe.js";
import { readExercise } from "./scene.js";
import { contactsOf, insideOf, redirectionsOf, rowSize, rowsOf, scoreOf, tipAt, watchedAt } from "./scoring.js";

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

const PLANE = 7; // numbers of a row of planes: step, x, y, z, yaw, pitch, roll
const IN_BASE64 = /^[A-Za-z0-9+/]*={0,2}$/;
const MOST_SESSIONS = 5000, MOST_STEPS = 2_000_000, MOST_EVENTS = 10_000;
const SHARE = "echospline session", SEVERAL = "echospline sessions";

/** Collects an attempt; a row is a step. */
export class Attempt {
  /** @param {Exercise} exercise @param {number} rate steps per second @param {string} model @param {boolean} examination @param {string} trainee @param {Date} started @param {Probe | null} [probe] of a scene in space */
  constructor(exercise, rate, model, examination, trainee, started, probe = null) {
    this.exercise = exercise;
    this.rate = rate;
    this.model = model;
    this.examination = examination;
    this.trainee = trainee;
    this.started = started;
    /** @type {number[]} */
    this.poses = [];
    /** @type {number[]} */
    this.watched = [];
    this.probe = probe;
    /** Rows of [step, pose] at which the probe was moved. @type {number[]} */
    this.planes = [];
    /** @type {ProbePose | null} */
    this.held = null;
    /** @type {number[]} */
    this.seen = [];
    this.steps = 0;
  }

  /** Points that are watched, flat: centres of target and vessels at rest. */
  get places() {
    return landmarksOf(this.exercise);
  }

  /** @param {{ entry: ArrayLike<number>, tip: ArrayLike<number>, speed: number }} pose @param {ArrayLike<number>} watched @param {ProbePose | null} [held] where the probe is */
  add({ entry, tip, speed }, watched, held = null) {
    for (const place of [entry, tip]) for (let d = 0; d < this.exercise.target.centre.length; ++d) this.poses.push(place[d]);
    this.poses.push(speed);
    if (this.probe && held) {
      if (held.some((value, k) => value !== this.held?.[k])) this.planes.push(this.steps, ...held);
      this.held = held;
      this.seen.push(Number(inPicture(this.probe, held, tip)));
    }
    for (let k = 0; k < watched.length; ++k) this.watched.push(watched[k]);
    ++this.steps;
  }

  /** @returns {Trace} */
  get trace() {
    return {
      period: 1 / this.rate, poses: Float64Array.from(this.poses), watched: Float64Array.from(this.watched), places: 1 + this.exercise.vessels.length,
      dimension: this.exercise.target.centre.length, seen: this.probe ? Uint8Array.from(this.seen) : null,
    };
  }

  /** @param {"finished" | "reset" | "time"} ended @param {number} attempt @param {Origin} origin @returns {Session} */
  session(ended, attempt, origin) {
    const trace = this.trace;
    return {
      format: 1, kind: SHARE, version: origin.version, core: origin.core, scene: { title: origin.title, pack: origin.pack }, model: this.model,
      exercise: this.exercise, examination: this.examination, trainee: this.trainee, attempt, started: this.started.toISOString(), rate: this.rate, ended,
      steps: this.steps, poses: inBase64(trace.poses), planes: this.planes.length ? inBase64(Float64Array.from(this.planes)) : null, events: eventsOf(trace, this.exercise), score: scoreOf(trace, this.exercise),
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
  return events.sort((a, b) => a[0] - b[0]);
}

/** Tip to the deformed target's centre, mm. @param {Trace} trace @param {number} row */
export function distanceAt(trace, row) {
  const centre = watchedAt(trace, row, 0);
  return Math.hypot(...Array.from(tipAt(trace, row), (value, d) => value - centre[d]));
}

/** Depth and distance to the target over time, thinned for a plot. @param {Trace} trace @param {number} [most] points */
export function plotOf(trace, most = 400) {
  const n = rowsOf(trace), stride = Math.max(1, Math.ceil(n / most));
  const rows = Array.from({ length: Math.ceil(n / stride) }, (_, k) => k * stride), { poses: p, dimension: D } = trace, size = rowSize(D);
  return {
    time: rows.map((row) => row * trace.period), distance: rows.map((row) => distanceAt(trace, row)),
    depth: rows.map((row) => Math.hypot(...Array.from({ length: D }, (_, d) => p[size * row + D + d] - p[size * row + d]))),
  };
}

/** Poses of a session, row by row. @param {Session} session @returns {Float64Array} */
export function posesOf(session) {
  return fromBase64(session.poses);
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
  const centre = asRecord(asRecord(s.exercise, `${what}.exercise`).target, `${what}.exercise.target`).centre, dimension = Array.isArray(centre) && centre.length === 3 ? 3 : 2;
  const poses = asText(s.poses, `${what}.poses`, 16 * MOST_STEPS * rowSize(dimension)), planes = s.planes === null || s.planes === undefined ? null : asText(s.planes, `${what}.planes`, 16 * MOST_STEPS * PLANE);
  if (planes !== null && (!IN_BASE64.test(planes) || decoded(planes).length % (8 * PLANE))) throw new PackError(`${what}.planes are no rows of ${PLANE} numbers: the file is cut or changed.`);
  if (!IN_BASE64.test(poses) || poses.length !== 4 * Math.ceil((8 * rowSize(dimension) * steps) / 3)) {
    throw new PackError(`${what} says ${steps} steps, but its poses are of another length: the file is cut or changed.`);
  }
  if (!fromBase64(poses).every(Number.isFinite)) throw new PackError(`${what} holds poses that are no finite numbers.`);
  if (!["finished", "reset", "time"].includes(s.ended)) throw new PackError(`${what}.ended is finished, reset or time.`);
  const started = asText(s.started, `${what}.started`, 40);
  if (Number.isNaN(Date.parse(started))) throw new PackError(`${what}.started is no time.`);
  return {
    format: 1, kind: SHARE, version: asText(s.version, `${what}.version`, 80), core: asText(s.core, `${what}.core`, 200),
    scene: { title: asText(scene.title, `${what}.scene.title`, 200), pack: asText(scene.pack, `${what}.scene.pack`, 200) }, model: asText(s.model, `${what}.model`, 40),
    exercise: readExercise(s.exercise, `${what}.exercise`, dimension), examination: s.examination === true, trainee: asText(s.trainee, `${what}.trainee`, 80),
    attempt: asWhole(s.attempt, `${what}.attempt`, 0, 1e6), started, rate: asNumber(s.rate, `${what}.rate`, 10, 2000), ended: s.ended, steps, poses, planes,
    events: asList(s.events, `${what}.events`, 0, MOST_EVENTS).map((e) => {
      const pair = asList(e, `${what}.events`, 2, 2);
      return /** @type {Happening} */ ([asWhole(pair[0], `${what}.events`, 0, MOST_STEPS), asText(pair[1], `${what}.events`, 40)]);
    }),
    score: s.score === null ? null : readScore(s.score, `${what}.score`),
  };
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
