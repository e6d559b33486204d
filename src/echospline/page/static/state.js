// The state of the page and its transitions: next(state, action) is a pure function of what a person did.

import { heldBetween, planeMatrix, raised, shifted } from "./probe.js";
import { extentOf } from "./scene.js";
import { viewOf, zoomed } from "./view.js";

/** @import { Look } from "./engine.js" */
/** @import { Probe, ProbePose } from "./probe.js" */
/** @import { Exercise, Pack, Point } from "./scene.js" */
/** @import { Extent, ViewState } from "./view.js" */
/**
 * The hand's command: entry and depth in mm; `angle` from the skin towards depth, in space within an upright plane that `heading` turns from
 * +x towards +z, degrees. In the plane there is no heading.
 * @typedef {{ entry: number[], angle: number, heading: number, depth: number }} NeedleState
 */
/** @typedef {{ a: Point, b: Point }} Caliper mm */
/** @typedef {{ at: Point, text: string }} Note mm */
/** @typedef {{ guide: boolean, rings: boolean, readouts: boolean, motion: boolean, body: boolean }} Helps `motion`: how the tissue has moved; `body`: the small drawing of probe, plane and needle */
/** @typedef {"free" | "fixed" | "drawn"} EntryRule */
/** @typedef {{ exercise: Exercise, examination: boolean, entryFixed: boolean, steps: number }} Run an attempt that is being recorded */
/** @typedef {{ exercise: Exercise, model: string, length: number, at: number, speed: number, paused: boolean, events: [number, string][], expert: boolean }} Replay rows are steps */
/**
 * @typedef {{
 *   extent: Extent, low: number[], high: number[], probe: Probe | null, held: ProbePose | null, rate: number, home: NeedleState, exercises: Exercise[], models: string[],
 *   needle: NeedleState, view: ViewState, look: Look, help: Helps,
 *   tool: "needle" | "caliper" | "note", calipers: Caliper[], drawing: Caliper | null, cursor: Point | null, notes: Note[],
 *   model: string, frozen: boolean, comparing: boolean, chosen: string, examination: boolean, entryRule: EntryRule, run: Run | null, replay: Replay | null,
 *   touched: boolean, language: string, theme: "dark" | "light"
 * }} State
 */
/** What a person did; `do` says which. @typedef {{ do: string, [more: string]: any }} Action */

export const TIME_GAINS = 6;
export const ANGLES = { least: 8, most: 172 }; // degrees
const OUT = 0.3; // mm; a needle less deep is out and its entry can move
const EDGE = 1; // mm that entry and tip keep from the edges
const MOST_CALIPERS = 4, MOST_NOTES = 12, LONGEST_NOTE = 60;
const BODY_SHARE = 0.27; // of the stage's width, for the small drawing in space
const EXPECTED = 25; // mm of needle that a view is made for before it is in
const LEAST_DEPTH = 10; // mm of the picture that are always seen
const SPEEDS = [0.25, 0.5, 1, 2, 4]; // of a replay

/** @param {Pack} pack @param {Partial<Pick<State, "language" | "theme">>} [kept] @returns {State} */
export function initialState(pack, kept = {}) {
  const { mesh, probe } = pack, high = mesh.origin.map((from, d) => from + (mesh.shape[d] - 1) * mesh.spacing[d]);
  const extent = probe ? { x0: probe.origin[0], y0: probe.origin[1], x1: -probe.origin[0], y1: probe.origin[1] + (probe.rows - 1) * probe.spacing[1] } : extentOf(mesh);
  const home = { entry: pack.needle.entry, ...anglesOf(pack.needle.direction), depth: 0 };
  return {
    extent, low: mesh.origin, high, probe, held: probe?.pose ?? null, rate: pack.rate, home, exercises: pack.exercises, models: pack.models.map((model) => model.name), needle: home,
    view: { width: 800, height: 600, zoom: 1, pan: [0, 0], flip: false, depth: extent.y1 - extent.y0, aside: probe ? BODY_SHARE : 0 },
    look: { gain: 0, timeGain: Array(TIME_GAINS).fill(0), dynamicRange: 60, invert: false },
    help: { guide: true, rings: true, readouts: true, motion: false, body: true }, tool: "needle", calipers: [], drawing: null, cursor: null, notes: [], model: pack.models[0].name,
    frozen: false, comparing: false, chosen: pack.exercises[0]?.name ?? "", examination: false, entryRule: "free", run: null, replay: null, touched: false,
    language: "en", theme: "dark", ...kept,
  };
}

/** The helps that are drawn now: an examination shows none, nor does an exercise that takes them away. @param {State} state @returns {Helps} */
export function helpsOf(state) {
  const off = state.run !== null && (state.run.examination || state.run.exercise.help === false);
  return off ? { guide: false, rings: false, readouts: false, motion: false, body: false } : state.help;
}

/** @param {NeedleState} needle */
export function isOut(needle) {
  return needle.depth < OUT;
}

/** Direction of the needle, of length 1, in as many numbers as its entry has. @param {NeedleState} needle @returns {number[]} */
export function axisOf({ entry, angle, heading }) {
  const [a, h] = [(angle * Math.PI) / 180, (heading * Math.PI) / 180];
  return entry.length === 3 ? [Math.cos(a) * Math.cos(h), Math.sin(a), Math.cos(a) * Math.sin(h)] : [Math.cos(a), Math.sin(a)];
}

/** Angle and heading of a direction. @param {ArrayLike<number>} d @returns {{ angle: number, heading: number }} degrees */
export function anglesOf(d) {
  if (d.length < 3) return { angle: (Math.atan2(d[1], d[0]) * 180) / Math.PI, heading: 0 };
  return { angle: (Math.atan2(d[1], Math.hypot(d[0], d[2])) * 180) / Math.PI, heading: (Math.atan2(d[2], d[0]) * 180) / Math.PI };
}

/** @param {NeedleState} needle @returns {number[]} mm */
export function tipOf(needle) {
  const axis = axisOf(needle);
  return needle.depth === 0 ? needle.entry : needle.entry.map((value, d) => value + needle.depth * axis[d]);
}

/** Deepest that the tip may go and still be in the tissue, mm. @param {NeedleState} needle @param {{ low: number[], high: number[] }} tissue */
export function deepestOf(needle, { low, high }) {
  const axis = axisOf(needle);
  const ways = needle.entry.map((from, d) => {
    if (Math.abs(axis[d]) < 1e-6 || (d === 1 && axis[d] < 0)) return Infinity;
    return ((axis[d] > 0 ? high[d] - EDGE : low[d] + EDGE) - from) / axis[d];
  });
  return Math.max(0, Math.min(...ways));
}

/** Matrix of the probe's plane; null where the scene is the plane. @param {Pick<State, "held">} state */
export function planeOfState({ held }) {
  return held && planeMatrix(held);
}

/** Seconds that a running attempt has left. @param {State} state @returns {number} */
export function secondsLeft(state) {
  return state.run ? Math.max(0, state.run.exercise.time_limit - state.run.steps / state.rate) : 0;
}

/** Whether the hand moves the needle now. @param {State} state */
export function steerable(state) {
  return state.replay === null;
}

/** @param {State} state @param {Action} action @returns {State} */
export function next(state, action) {
  const change = CHANGES[action.do];
  if (!change) throw new Error(`expected an action; got ${JSON.stringify(action.do)}`);
  return change(state, action);
}

/** @param {number} value @param {number} low @param {number} high */
function between(value, low, high) {
  return Math.min(Math.max(value, low), Math.max(low, high));
}

/** @param {State} state @param {Partial<NeedleState>} change @returns {State} */
function steered(state, change) {
  if (!steerable(state)) return state;
  const needle = { ...state.needle, ...change };
  needle.angle = between(needle.angle, ANGLES.least, ANGLES.most);
  needle.heading = ((((needle.heading + 180) % 360) + 360) % 360) - 180;
  needle.depth = between(needle.depth, 0, deepestOf(needle, state));
  return { ...state, needle, touched: true };
}

/** Let the needle enter at a place of the skin. @param {State} state @param {ArrayLike<number>} at mm, of the scene @returns {State} */
function enteredAt(state, at) {
  if (!isOut(state.needle) || state.run?.entryFixed) return state;
  const { low, high } = state;
  return steered(state, { entry: low.map((least, d) => (d === 1 ? least : between(at[d], least + EDGE, high[d] - EDGE))) });
}

/** A place of the picture in the scene. @param {State} state @param {ArrayLike<number>} at mm */
function inScene(state, at) {
  const plane = planeOfState(state);
  return plane ? raised(plane, at) : at;
}

/** The entry moved along the picture, and across it. @param {State} state @param {number} mm @param {number} across @returns {State} */
function slid(state, mm, across) {
  const { entry } = state.needle;
  if (!state.held) return enteredAt(state, [entry[0] + mm, entry[1]]);
  const [x, , z] = shifted([...entry.slice(0, 3), state.held[3], 0, 0], mm, across);
  return enteredAt(state, [x, entry[1], z]);
}

/** Probe over the needle: along it, or across it at its tip. @param {State} state @param {string} name @returns {State} */
function viewedBy(state, name) {
  if (!state.held) return state;
  const { needle } = state, [dx, , dz] = axisOf({ ...needle, angle: Math.min(needle.angle, 89) }), far = isOut(needle) ? EXPECTED : needle.depth;
  const yaw = (Math.atan2(-dz, dx) * 180) / Math.PI, part = name === "along" ? far / 2 : far, flat = Math.cos((needle.angle * Math.PI) / 180);
  const way = flat < 0 ? -part : part, size = Math.hypot(dx, dz) || 1;
  const [x, z] = [needle.entry[0] + (way * Math.abs(flat) * dx) / size, needle.entry[2] + (way * Math.abs(flat) * dz) / size];
  return held(state, [x, state.held[1], z, name === "along" ? yaw : yaw + 90, 0, 0]);
}

/** @param {State} state @param {ProbePose} pose @returns {State} */
function held(state, pose) {
  return { ...state, held: heldBetween(pose, state.low, state.high), touched: true };
}

/** @param {State} state @param {Partial<Look>} change @returns {State} */
function looked(state, change) {
  return { ...state, look: { ...state.look, ...change } };
}

/** @param {State} state @param {Partial<ViewState>} change @returns {State} */
function viewed(state, change) {
  return { ...state, view: { ...state.view, ...change } };
}

/** @param {State} state @param {Partial<Replay>} change @returns {State} */
function replayed(state, change) {
  return state.replay ? { ...state, replay: { ...state.replay, ...change } } : state;
}

/** The needle out, at the entry and angle that were chosen. @param {State} state @returns {State} */
function drawnOut(state) {
  return { ...state, needle: { ...state.needle, depth: 0 }, frozen: false, comparing: false };
}

/** Move the cursor of marks, from the middle of the picture at first. @param {State} state @param {Point} [at] @param {Point} [by] mm @returns {State} */
function cursorMoved(state, at, by = [0, 0]) {
  const { x0, x1, y0, y1 } = state.extent, now = at ?? state.cursor ?? [(x0 + x1) / 2, y0 + state.view.depth / 2];
  const cursor = /** @type {Point} */ ([between(now[0] + by[0], x0, x1), between(now[1] + by[1], y0, y1)]);
  return { ...state, cursor, drawing: state.drawing && !at ? { a: state.drawing.a, b: cursor } : state.drawing };
}

/** @type {Record<string, (state: State, action: Action) => State>} */
const CHANGES = {
  // the needle
  push: (s, { mm }) => steered(s, { depth: s.needle.depth + mm }),
  turn: (s, { degrees }) => steered(s, { angle: s.needle.angle + degrees }),
  slide: (s, { mm, across }) => slid(s, mm, across ?? 0),
  depth: (s, { mm }) => steered(s, { depth: mm }),
  angle: (s, { degrees }) => steered(s, { angle: degrees }),
  heading: (s, { degrees }) => (s.held ? steered(s, { heading: degrees }) : s),
  head: (s, { degrees }) => (s.held ? steered(s, { heading: s.needle.heading + degrees }) : s),
  entry: (s, { at }) => enteredAt(s, inScene(s, at)),
  enter: (s, { x, z }) => enteredAt(s, [x ?? s.needle.entry[0], s.low[1], z ?? s.needle.entry[2]]),
  aim: (s, { at }) => {
    const way = Array.from(inScene(s, at)).slice(0, s.needle.entry.length).map((value, d) => value - s.needle.entry[d]);
    return way[1] > 1 ? steered(s, anglesOf(way)) : s;
  },
  reset: (s) => ({ ...drawnOut(s), run: null, replay: null }),
  adopt: (s, { needle }) => ({ ...s, needle }),
  // the probe
  probe: (s, { slide = 0, across = 0, turn = 0, tilt = 0, rock = 0 }) => {
    if (!s.held) return s;
    const [x, y, z, yaw, pitch, roll] = shifted(s.held, slide, across);
    return held(s, [x, y, z, yaw + turn, pitch + tilt, roll + rock]);
  },
  hold: (s, { k, value }) => (s.held ? held(s, /** @type {ProbePose} */ (s.held.map((old, j) => (j === k ? value : old)))) : s),
  over: (s, { name }) => viewedBy(s, name),
  "hold-all": (s, { pose }) => (s.held ? held(s, pose) : s),
  adoptProbe: (s, { pose }) => (s.held ? { ...s, held: pose } : s),
  // the view
  resize: (s, { width, height }) => viewed(s, { width: Math.max(1, width), height: Math.max(1, height) }),
  zoom: (s, { factor, about }) => ({ ...s, view: zoomed(s.view, s.extent, factor, about ?? [s.view.width / 2, s.view.height / 2]) }),
  pan: (s, { by }) => (s.view.zoom > 1 ? viewed(s, { pan: [s.view.pan[0] + by[0], s.view.pan[1] + by[1]] }) : s),
  fit: (s) => viewed(s, { zoom: 1, pan: [0, 0] }),
  flip: (s) => viewed(s, { flip: !s.view.flip, pan: [0, s.view.pan[1]] }),
  seen: (s, { mm }) => viewed(s, { depth: between(mm, LEAST_DEPTH, s.extent.y1 - s.extent.y0) }),
  // the look
  gain: (s, { dB }) => looked(s, { gain: between(dB, -30, 30) }),
  timeGain: (s, { k, dB }) => looked(s, { timeGain: s.look.timeGain.map((old, j) => (j === k ? between(dB, -20, 20) : old)) }),
  flatGain: (s) => looked(s, { gain: 0, timeGain: Array(TIME_GAINS).fill(0), dynamicRange: 60 }),
  range: (s, { dB }) => looked(s, { dynamicRange: between(dB, 20, 100) }),
  invert: (s) => looked(s, { invert: !s.look.invert }),
  help: (s, { name }) => ({ ...s, help: { ...s.help, [name]: !s.help[/** @type {"guide"} */ (name)] } }),
  freeze: (s) => (s.run || s.comparing ? s : { ...s, frozen: !s.frozen }),
  comparing: (s, { on }) => (s.run || s.replay ? s : { ...s, comparing: on, frozen: on }),
  // marks on the picture
  tool: (s, { name }) => ({ ...s, tool: s.tool === name ? "needle" : name, drawing: null, cursor: null }),
  cursor: (s, { at, by }) => cursorMoved(s, at, by),
  mark: (s) => {
    if (s.tool !== "caliper") return s;
    if (!s.cursor) s = cursorMoved(s); // Enter before any arrow marks the middle
    return s.drawing ? { ...CHANGES.measured(s, { do: "measured" }), cursor: s.cursor } : { ...s, drawing: { a: /** @type {Point} */ (s.cursor), b: /** @type {Point} */ (s.cursor) } };
  },
  measure: (s, { a, b }) => ({ ...s, drawing: { a, b } }),
  measured: (s) => {
    const long = s.drawing && Math.hypot(s.drawing.b[0] - s.drawing.a[0], s.drawing.b[1] - s.drawing.a[1]) * viewOf(s.view, s.extent).scale >= 3;
    return { ...s, calipers: s.drawing && long ? [...s.calipers, s.drawing].slice(-MOST_CALIPERS) : s.calipers, drawing: null };
  },
  note: (s, { at, text }) => ({ ...s, notes: text.trim() ? [...s.notes, { at, text: text.trim().slice(0, LONGEST_NOTE) }].slice(-MOST_NOTES) : s.notes, tool: "needle", cursor: null }),
  clear: (s) => ({ ...s, calipers: [], notes: [], drawing: null, cursor: null, tool: "needle" }),
  // model, appearance of the page
  model: (s, { name }) => (s.run || s.replay || !s.models.includes(name) ? s : { ...s, model: name }),
  language: (s, { name }) => ({ ...s, language: name }),
  theme: (s) => ({ ...s, theme: s.theme === "dark" ? "light" : "dark" }),
  touch: (s) => ({ ...s, touched: true }),
  // training
  choose: (s, { name }) => (s.run ? s : { ...s, chosen: name }),
  another: (s) => {
    const k = s.exercises.findIndex((exercise) => exercise.name === s.chosen);
    return s.run || !s.exercises.length ? s : { ...s, chosen: s.exercises[(k + 1) % s.exercises.length].name };
  },
  examination: (s) => (s.run ? s : { ...s, examination: !s.examination }),
  entryRule: (s, { rule }) => (s.run ? s : { ...s, entryRule: rule }),
  start: (s, { lot }) => started(s, lot),
  stepped: (s, { steps }) => (s.run ? { ...s, run: { ...s.run, steps } } : s),
  stop: (s) => ({ ...s, run: null }),
  // replay
  replay: (s, { replay }) => ({ ...s, frozen: false, comparing: false, run: null, model: replay.model, replay: { at: 0, speed: 1, paused: false, ...replay } }),
  scrub: (s, { at }) => replayed(s, { at: between(at, 0, s.replay?.length ?? 0) }),
  pause: (s) => (s.replay && s.replay.paused && s.replay.at >= s.replay.length ? replayed(s, { at: 0, paused: false }) : replayed(s, { paused: !s.replay?.paused })),
  played: (s, { rows }) => {
    if (!s.replay || s.replay.paused) return s;
    const at = Math.min(s.replay.length, s.replay.at + rows);
    return replayed(s, { at, paused: at >= s.replay.length });
  },
  speed: (s, { value }) => replayed(s, { speed: SPEEDS.includes(value) ? value : 1 }),
  leave: (s) => ({ ...drawnOut(s), replay: null }),
};

/**
 * An attempt begins: needle out; its entry where the exercise or the examination's rule says.
 * @param {State} state @param {number} lot random, 0 to 1, for a drawn entry @returns {State}
 */
function started(state, lot) {
  const exercise = state.exercises.find((one) => one.name === state.chosen);
  if (!exercise || state.run) return state;
  const { low, high } = state, rule = state.examination ? state.entryRule : "free";
  const span = exercise.entry_between ?? (rule === "drawn" ? [low[0] + 0.15 * (high[0] - low[0]), low[0] + 0.85 * (high[0] - low[0])] : null);
  const given = exercise.entry ?? (span ? [span[0] + lot * (span[1] - span[0]), low[1], state.home.entry[2]] : rule === "fixed" ? state.home.entry : null);
  const needle = { ...state.needle, depth: 0, entry: given ? given.slice(0, state.needle.entry.length) : state.needle.entry };
  return {
    ...state, needle, frozen: false, comparing: false, replay: null, touched: true, calipers: [], notes: [], drawing: null, cursor: null, tool: "needle",
    run: { exercise, examination: state.examination, entryFixed: given !== null, steps: 0 },
  };
}
