// The state of the page and its transitions: next(state, action) is a pure function of what a person did.

import { extentOf } from "./scene.js";
import { viewOf, zoomed } from "./view.js";

/** @import { Look } from "./engine.js" */
/** @import { Exercise, Pack, Point } from "./scene.js" */
/** @import { Extent, ViewState } from "./view.js" */
/** @typedef {{ entry: Point, angle: number, depth: number }} NeedleState the hand's command: mm, degrees from +x towards depth, mm */
/** @typedef {{ a: Point, b: Point }} Caliper mm */
/** @typedef {{ at: Point, text: string }} Note mm */
/** @typedef {"free" | "fixed" | "drawn"} EntryRule */
/** @typedef {{ exercise: Exercise, examination: boolean, entryFixed: boolean, steps: number }} Run an attempt that is being recorded */
/** @typedef {{ exercise: Exercise, model: string, length: number, at: number, speed: number, paused: boolean, events: [number, string][], expert: boolean }} Replay rows are steps */
/**
 * @typedef {{
 *   extent: Extent, rate: number, home: NeedleState, exercises: Exercise[], models: string[],
 *   needle: NeedleState, view: ViewState, look: Look, help: { guide: boolean, rings: boolean, readouts: boolean },
 *   tool: "needle" | "caliper" | "note", calipers: Caliper[], drawing: Caliper | null, cursor: Point | null, notes: Note[],
 *   model: string, frozen: boolean, chosen: string, examination: boolean, entryRule: EntryRule, run: Run | null, replay: Replay | null,
 *   touched: boolean, language: string, theme: "dark" | "light"
 * }} State
 */
/** What a person did; `do` says which. @typedef {{ do: string, [more: string]: any }} Action */

export const TIME_GAINS = 6;
export const ANGLES = { least: 8, most: 172 }; // degrees
const OUT = 0.3; // mm; a needle less deep is out and its entry can move
const EDGE = 1; // mm that entry and tip keep from the edges
const MOST_CALIPERS = 4, MOST_NOTES = 12, LONGEST_NOTE = 60;
const LEAST_DEPTH = 10; // mm of the picture that are always seen
const SPEEDS = [0.25, 0.5, 1, 2, 4]; // of a replay

/** @param {Pack} pack @param {Partial<Pick<State, "language" | "theme">>} [kept] @returns {State} */
export function initialState(pack, kept = {}) {
  const extent = extentOf(pack.mesh), [dx, dy] = pack.needle.direction;
  const home = { entry: /** @type {Point} */ (pack.needle.entry.slice(0, 2)), angle: (Math.atan2(dy, dx) * 180) / Math.PI, depth: 0 };
  return {
    extent, rate: pack.rate, home, exercises: pack.exercises, models: pack.models.map((model) => model.name), needle: home,
    view: { width: 800, height: 600, zoom: 1, pan: [0, 0], flip: false, depth: extent.y1 - extent.y0 },
    look: { gain: 0, timeGain: Array(TIME_GAINS).fill(0), dynamicRange: 60, invert: false },
    help: { guide: true, rings: true, readouts: true }, tool: "needle", calipers: [], drawing: null, cursor: null, notes: [], model: pack.models[0].name,
    frozen: false, chosen: pack.exercises[0]?.name ?? "", examination: false, entryRule: "free", run: null, replay: null, touched: false,
    language: "en", theme: "dark", ...kept,
  };
}

/** The helps that are drawn now: an examination shows none, nor does an exercise that takes them away. @param {State} state */
export function helpsOf(state) {
  const off = state.run !== null && (state.run.examination || state.run.exercise.help === false);
  return off ? { guide: false, rings: false, readouts: false } : state.help;
}

/** @param {NeedleState} needle */
export function isOut(needle) {
  return needle.depth < OUT;
}

/** @param {number} angle degrees @returns {Point} */
export function directionOf(angle) {
  return [Math.cos((angle * Math.PI) / 180), Math.sin((angle * Math.PI) / 180)];
}

/** @param {NeedleState} needle @returns {Point} mm */
export function tipOf(needle) {
  const [dx, dy] = directionOf(needle.angle);
  return needle.depth === 0 ? needle.entry : [needle.entry[0] + needle.depth * dx, needle.entry[1] + needle.depth * dy];
}

/** Deepest that the tip may go and still be in the picture, mm. @param {NeedleState} needle @param {Extent} extent */
export function deepestOf(needle, { x0, x1, y1 }) {
  const [dx, dy] = directionOf(needle.angle), [x, y] = needle.entry;
  const down = dy > 1e-6 ? (y1 - EDGE - y) / dy : Infinity;
  const side = Math.abs(dx) < 1e-6 ? Infinity : dx > 0 ? (x1 - EDGE - x) / dx : (x0 + EDGE - x) / dx;
  return Math.max(0, Math.min(down, side));
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
  needle.depth = between(needle.depth, 0, deepestOf(needle, state.extent));
  return { ...state, needle, touched: true };
}

/** @param {State} state @param {number} x mm @returns {State} */
function enteredAt(state, x) {
  if (!isOut(state.needle) || state.run?.entryFixed) return state;
  const { x0, x1, y0 } = state.extent;
  return steered(state, { entry: [between(x, x0 + EDGE, x1 - EDGE), y0] });
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
  return { ...state, needle: { ...state.needle, depth: 0 }, frozen: false };
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
  slide: (s, { mm }) => enteredAt(s, s.needle.entry[0] + mm),
  depth: (s, { mm }) => steered(s, { depth: mm }),
  angle: (s, { degrees }) => steered(s, { angle: degrees }),
  entry: (s, { x }) => enteredAt(s, x),
  aim: (s, { at }) => {
    const [x, y] = s.needle.entry;
    return at[1] > y + 1 ? steered(s, { angle: (Math.atan2(at[1] - y, at[0] - x) * 180) / Math.PI }) : s;
  },
  reset: (s) => ({ ...drawnOut(s), run: null, replay: null }),
  adopt: (s, { needle }) => ({ ...s, needle }),
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
  freeze: (s) => (s.run ? s : { ...s, frozen: !s.frozen }),
  // marks on the picture
  tool: (s, { name }) => ({ ...s, tool: s.tool === name ? "needle" : name, drawing: null, cursor: null }),
  cursor: (s, { at, by }) => cursorMoved(s, at, by),
  mark: (s) => {
    if (s.tool !== "caliper" || !s.cursor) return s;
    return s.drawing ? { ...CHANGES.measured(s, { do: "measured" }), cursor: s.cursor } : { ...s, drawing: { a: s.cursor, b: s.cursor } };
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
  replay: (s, { replay }) => ({ ...s, frozen: false, run: null, model: replay.model, replay: { at: 0, speed: 1, paused: false, ...replay } }),
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
  const { x0, x1, y0 } = state.extent, rule = state.examination ? state.entryRule : "free";
  const span = exercise.entry_between ?? (rule === "drawn" ? [x0 + 0.15 * (x1 - x0), x0 + 0.85 * (x1 - x0)] : null);
  const given = exercise.entry ?? (span ? [span[0] + lot * (span[1] - span[0]), y0] : rule === "fixed" ? state.home.entry : null);
  const needle = { ...state.needle, depth: 0, entry: given ? /** @type {Point} */ ([given[0], given[1]]) : state.needle.entry };
  return {
    ...state, needle, frozen: false, replay: null, touched: true, calipers: [], notes: [], drawing: null, cursor: null, tool: "needle",
    run: { exercise, examination: state.examination, entryFixed: given !== null, steps: 0 },
  };
}
