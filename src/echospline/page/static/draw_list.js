// What is drawn over (and with) the picture, as a list of plain commands: a pure function of the state and of the tissue now.

import { arc, body } from "./body.js";
import { lowered, turnedDown } from "./probe.js";
import { axisOf, helpsOf, planeOfState, secondsLeft } from "./state.js";
import { viewOf } from "./view.js";

/** @import { Exercise, Point } from "./scene.js" */
/** @import { State } from "./state.js" */
/** @import { View } from "./view.js" */
/** @typedef {{ left: number, top: number, right: number, bottom: number }} Area CSS pixels */
/**
 * One command of the renderer; places are CSS pixels.
 * @typedef {{ draw: "fill", ink: string }
 *   | { draw: "picture", left: number, top: number, width: number, height: number, flip: boolean, area: Area }
 *   | { draw: "clip", area: Area | null }
 *   | { draw: "line", points: Point[], ink: string, width: number, halo?: boolean, dash?: number[] }
 *   | { draw: "circle", at: Point, r: number, ink: string, width: number, fill?: string, halo?: boolean }
 *   | { draw: "shape", points: Point[], fill: string, ink?: string }
 *   | { draw: "bar", area: Area, from: string, to: string, round: number }
 *   | { draw: "text", at: Point, text: string, ink: string, align?: CanvasTextAlign, size?: number, bold?: boolean, halo?: boolean }} DrawCommand
 */
/**
 * The tissue now, as the engine has it.
 * @typedef {{
 *   entry: ArrayLike<number>, tip: ArrayLike<number>, speed: number, watched: ArrayLike<number>, expert: { entry: ArrayLike<number>, tip: ArrayLike<number> } | null, motion: number[],
 *   picture: { columns: number, rows: number, spacing: Point, origin: Point }
 * }} Live
 */
/** Words that are drawn, from the table of the language. @typedef {(key: string, values?: Record<string, string | number>) => string} Say */

const INK = "#e8f1f5", QUIET = "#a9bac5", ACCENT = "#5fd4e0", TARGET = "#ffd166", VESSEL = "#ff7b7b", CALIPER = "#b8f28a", NOTE = "#ffe9b8", EXPERT = "#c9a4ff", MOTION = "#ffb36b";
const STAGES = { dark: { back: "#05070a", quiet: "#a9bac5", rule: "#5b6b77", from: "#27323b", to: "#4a5a66" }, light: { back: "#dfe6ea", quiet: "#45545e", rule: "#7b8b96", from: "#8b9aa5", to: "#5b6b77" } };
const OUTSIDE = 34; // mm of shaft that is drawn above the skin
const HUB_ROOM = 14; // CSS pixels between its end and the top of the stage
const PLATE = "rgba(5, 8, 10, 0.5)";
const SLICE = 2.5; // mm off the plane up to which a needle is drawn as lying in it
const LEAST_ARROW = 1; // CSS pixels
const FAR = 400; // mm that the guide reaches
const LOW_TIME = 10; // s left at which the countdown is coloured
const IN_TISSUE = 0.2; // mm of depth at which the tip has a ring

/** @param {State} state @param {Live} live @param {Say} say @returns {DrawCommand[]} */
export function drawList(state, live, say) {
  const view = viewOf(state.view, state.extent), helps = helpsOf(state), stage = STAGES[state.theme];
  const exercise = state.run?.exercise ?? state.replay?.exercise ?? state.exercises.find((one) => one.name === state.chosen);
  const plane = planeOfState(state), shown = seenFrom(plane, live, state);
  return [
    { draw: "fill", ink: stage.back },
    picture(view, live),
    ...ruler(view, state, stage),
    ...probe(view, state, stage),
    { draw: "clip", area: view.area },
    ...(exercise && (helps.rings || unseen(state, shown)) ? rings(view, shown, helps.rings ? exercise : { ...exercise, vessels: [] }, say) : []),
    ...(helps.motion ? arrows(view, live) : []),
    ...(helps.guide ? guide(view, shown) : []),
    ...(live.expert ? expertNeedle(view, plane, live.expert, say) : []),
    ...calipers(view, state),
    ...notes(view, state),
    { draw: "clip", area: null },
    ...hub(view, shown),
    ...readouts(view, state, live, shown, helps.readouts, helps.rings && Boolean(exercise), say),
    ...settings(view, state, say),
    ...(helps.body ? body(state, live, helps.rings ? exercise : undefined) : []),
  ];
}

/**
 * What lies where in the picture: places by lateral distance, depth and distance off the plane, mm.
 * @typedef {{ entry: [number, number, number], tip: [number, number, number], axis: [number, number, number], places: [number, number, number][], inside: boolean }} Seen
 */

/** @param {number[] | null} plane @param {Live} live @param {State} state @returns {Seen} */
function seenFrom(plane, { entry, tip, watched }, { needle, low }) {
  const count = Math.floor(watched.length / low.length);
  return {
    entry: lowered(plane, entry), tip: lowered(plane, tip), axis: turnedDown(plane, axisOf(needle)), inside: Math.hypot(...Array.from(tip, (value, d) => value - entry[d])) > IN_TISSUE,
    places: Array.from({ length: count }, (_, k) => lowered(plane, Array.from({ length: low.length }, (_, d) => watched[k * low.length + d]))),
  };
}

/** @param {View} view @param {Live} live @returns {DrawCommand} */
function picture(view, { picture: { columns, rows, spacing, origin } }) {
  const first = [origin[0] - spacing[0] / 2, origin[1] - spacing[1] / 2]; // pixels are squares about their centres
  const [ax, top] = view.toScreen(first), [bx] = view.toScreen([first[0] + columns * spacing[0], 0]);
  return { draw: "picture", left: Math.min(ax, bx), top, width: Math.abs(bx - ax), height: rows * spacing[1] * view.scale, flip: view.flip, area: view.area };
}

/** Depth in cm on the right, ticks every 5 mm. @param {View} view @param {State} state @param {typeof STAGES.dark} stage @returns {DrawCommand[]} */
function ruler(view, { extent }, stage) {
  const { area } = view, x = area.right + 8;
  /** @type {DrawCommand[]} */
  const drawn = [{ draw: "line", points: [[x, area.top], [x, area.bottom]], ink: stage.rule, width: 1.5 }];
  for (let mm = 0; mm <= extent.y1 - extent.y0 + 1e-6; mm += 5) {
    const [, y] = view.toScreen([0, extent.y0 + mm]);
    if (y < area.top - 0.5 || y > area.bottom + 0.5) continue;
    drawn.push({ draw: "line", points: [[x, y], [x + (mm % 10 ? 4 : 8), y]], ink: stage.rule, width: 1.5 });
    if (mm % 10 === 0) drawn.push({ draw: "text", at: [x + 12, y], text: mm ? String(mm / 10) : "cm", ink: stage.quiet, size: 11, halo: false });
  }
  return drawn;
}

/** The probe's face and the dot at its marked side. @param {View} view @param {State} state @param {typeof STAGES.dark} stage @returns {DrawCommand[]} */
function probe(view, { probe: shape }, stage) {
  if (shape?.shape === "curved") {
    const face = arc(shape, shape.radius - 1.2).map((p) => view.toScreen(p)), [x, y] = face[view.flip ? face.length - 2 : 1];
    return [
      { draw: "clip", area: { ...view.area, top: 0 } }, { draw: "line", points: face, ink: stage.to, width: Math.max(6, 2 * view.scale) }, { draw: "clip", area: null },
      { draw: "circle", at: [x, y], r: 3.5, ink: ACCENT, width: 0, fill: ACCENT },
    ];
  }
  const [ax, y] = view.toScreen([view.extent.x0, view.extent.y0]), [bx] = view.toScreen([view.extent.x1, view.extent.y0]);
  const [left, right] = [Math.min(ax, bx), Math.max(ax, bx)], dot = view.flip ? right - 10 : left + 10;
  if (y < view.area.top - 1) return [];
  return [
    { draw: "bar", area: { left, top: y - 15, right, bottom: y - 2 }, from: stage.from, to: stage.to, round: 6 },
    { draw: "circle", at: [dot, y - 8.5], r: 3.5, ink: ACCENT, width: 0, fill: ACCENT },
  ];
}

/** Whether a target that no picture shows has to be shown, or nobody could aim: without help, until the needle is in the tissue. @param {State} state @param {Seen} seen */
function unseen({ run }, { inside }) {
  return run !== null && !inside && !run.exercise.target.imaged && !run.exercise.target.echo;
}

/** Target and vessels where the plane cuts them. @param {View} view @param {Seen} seen @param {Exercise} exercise @param {Say} say @returns {DrawCommand[]} */
function rings(view, { places }, exercise, say) {
  return [exercise.target, ...exercise.vessels].flatMap((ring, k) => {
    if (k >= places.length || Math.abs(places[k][2]) >= ring.radius) return [];
    const at = view.toScreen(places[k]), r = Math.sqrt(ring.radius ** 2 - places[k][2] ** 2) * view.scale, [x, y] = at;
    const ink = k ? VESSEL : TARGET;
    /** @type {DrawCommand[]} */
    const drawn = [{ draw: "circle", at, r, ink, width: 2, halo: true, ...(k ? { fill: "rgba(255, 90, 90, 0.14)" } : {}) }];
    if (k === 0) drawn.push({ draw: "line", points: [[x - 3, y], [x + 3, y]], ink, width: 1.5, halo: true }, { draw: "line", points: [[x, y - 3], [x, y + 3]], ink, width: 1.5, halo: true });
    return [...drawn, { draw: "text", at: [x, y - r - 10], text: say(k ? "vessel" : "target"), ink, align: "center", size: 12 }];
  });
}

/** How the tissue has moved: from where a place lay to where it is. @param {View} view @param {Live} live @returns {DrawCommand[]} */
function arrows(view, { motion }) {
  /** @type {DrawCommand[]} */
  const drawn = [];
  for (let k = 0; k < motion.length; k += 4) {
    const a = view.toScreen([motion[k], motion[k + 1]]), b = view.toScreen([motion[k + 2], motion[k + 3]]);
    if (Math.hypot(b[0] - a[0], b[1] - a[1]) < LEAST_ARROW) continue;
    drawn.push({ draw: "line", points: [a, b], ink: MOTION, width: 1.5, halo: true }, { draw: "circle", at: b, r: 2, ink: MOTION, width: 0, fill: MOTION });
  }
  return drawn;
}

/** Where the needle would go, as far as that is near the plane; a cross where it would pass through it. @param {View} view @param {Seen} seen @returns {DrawCommand[]} */
function guide(view, { tip, axis, inside }) {
  const [from, to] = nearPlane(tip[2], axis[2]);
  /** @type {DrawCommand[]} */
  const drawn = [];
  const at = (/** @type {number} */ mm) => view.toScreen([tip[0] + mm * axis[0], tip[1] + mm * axis[1]]);
  if (to > from) drawn.push({ draw: "line", points: [at(from), at(to)], ink: ACCENT, width: 1.5, dash: [7, 7], halo: true });
  const through = axis[2] === 0 ? -1 : -tip[2] / axis[2];
  if (through > 0 && Math.abs(axis[2]) > 0.05) {
    const [x, y] = at(through);
    drawn.push({ draw: "line", points: [[x - 6, y - 6], [x + 6, y + 6]], ink: ACCENT, width: 2, halo: true }, { draw: "line", points: [[x - 6, y + 6], [x + 6, y - 6]], ink: ACCENT, width: 2, halo: true });
  }
  if (inside && Math.abs(tip[2]) <= SLICE) drawn.push({ draw: "circle", at: view.toScreen(tip), r: 8, ink: ACCENT, width: 1.5, halo: true });
  return drawn;
}

/** From where to where a needle that goes on is within SLICE of the plane, mm from its tip. @param {number} off @param {number} by a mm of needle @returns {[number, number]} */
function nearPlane(off, by) {
  if (Math.abs(by) < 1e-9) return Math.abs(off) <= SLICE ? [0, FAR] : [0, 0];
  const [a, b] = [(-SLICE - off) / by, (SLICE - off) / by];
  return [Math.max(0, Math.min(a, b)), Math.min(FAR, Math.max(a, b))];
}

/** @param {View} view @param {number[] | null} plane @param {NonNullable<Live["expert"]>} expert @param {Say} say @returns {DrawCommand[]} */
function expertNeedle(view, plane, { entry, tip }, say) {
  const [a, b] = [view.toScreen(lowered(plane, entry)), view.toScreen(lowered(plane, tip))];
  return [
    { draw: "line", points: [a, b], ink: EXPERT, width: 2, halo: true, dash: [3, 4] },
    { draw: "circle", at: b, r: 4, ink: EXPERT, width: 2, halo: true },
    { draw: "text", at: [b[0] + 9, b[1] + 12], text: say("expert"), ink: EXPERT, size: 12 },
  ];
}

/** The needle above the skin: where it comes from, even when it is not in. @param {View} view @param {Seen} seen @returns {DrawCommand[]} */
function hub(view, { entry, axis: [dx, dy] }) {
  const [x, y] = view.toScreen(entry), side = view.flip ? -1 : 1;
  if (y < view.area.top - 1 || y > view.area.bottom || dy <= 0) return [];
  const length = Math.min(OUTSIDE * view.scale, Math.max(16, y - HUB_ROOM) / Math.max(dy, 0.35));
  /** @type {Point} */
  const end = [x - side * dx * length, y - dy * length];
  const [nx, ny] = [dy, -side * dx]; // across the shaft
  const grip = (/** @type {number} */ far, /** @type {number} */ wide) => /** @type {Point} */ ([end[0] + side * dx * far + nx * wide, end[1] + dy * far + ny * wide]);
  return [
    { draw: "clip", area: { left: 0, top: 0, right: 1e5, bottom: y } },
    { draw: "line", points: [[x, y], end], ink: "#dfe9ee", width: 3, halo: true },
    { draw: "shape", points: [grip(-2, 5), grip(14, 3.5), grip(14, -3.5), grip(-2, -5)], fill: ACCENT, ink: "rgba(0, 0, 0, 0.6)" },
    { draw: "clip", area: null },
    { draw: "shape", points: [[x, y - 1], [x - 5, y - 8], [x + 5, y - 8]], fill: "#ffffff", ink: "rgba(0, 0, 0, 0.7)" },
  ];
}

/** @param {View} view @param {State} state @returns {DrawCommand[]} */
function calipers(view, { calipers: kept, drawing, cursor }) {
  const [x, y] = cursor ? view.toScreen(cursor) : [0, 0];
  /** @type {DrawCommand[]} */
  const crosshair = cursor ? [{ draw: "line", points: [[x - 9, y], [x + 9, y]], ink: CALIPER, width: 1, halo: true }, { draw: "line", points: [[x, y - 9], [x, y + 9]], ink: CALIPER, width: 1, halo: true }] : [];
  return [...crosshair, ...[...kept, ...(drawing ? [drawing] : [])].flatMap(({ a, b }, k) => {
    const [p, q] = [view.toScreen(a), view.toScreen(b)];
    const cross = (/** @type {Point} */ [x, y]) => /** @type {DrawCommand[]} */ ([
      { draw: "line", points: [[x - 5, y], [x + 5, y]], ink: CALIPER, width: 1.5, halo: true }, { draw: "line", points: [[x, y - 5], [x, y + 5]], ink: CALIPER, width: 1.5, halo: true },
    ]);
    const length = `${k + 1}: ${Math.hypot(b[0] - a[0], b[1] - a[1]).toFixed(1)} mm`;
    return [
      /** @type {DrawCommand} */ ({ draw: "line", points: [p, q], ink: CALIPER, width: 1.25, dash: [2, 4], halo: true }), ...cross(p), ...cross(q),
      /** @type {DrawCommand} */ ({ draw: "text", at: [(p[0] + q[0]) / 2 + 8, (p[1] + q[1]) / 2 - 10], text: length, ink: CALIPER, size: 13, bold: true }),
    ];
  })];
}

/** @param {View} view @param {State} state @returns {DrawCommand[]} */
function notes(view, { notes: kept }) {
  return kept.map(({ at, text }) => ({ draw: "text", at: view.toScreen(at), text, ink: NOTE, size: 14, bold: true }));
}

/** Numbers at the upper right of the picture. @param {View} view @param {State} state @param {Live} live @param {Seen} seen @param {boolean} shown @param {boolean} toTarget @param {Say} say @returns {DrawCommand[]} */
function readouts(view, state, live, seen, shown, toTarget, say) {
  const right = view.area.right - 12;
  let y = view.area.top + 18;
  /** @type {DrawCommand[]} */
  const drawn = [];
  /** @param {string} text @param {string} ink @param {number} size @param {boolean} [bold] */
  const line = (text, ink, size, bold = false) => {
    drawn.push({ draw: "text", at: [right, y], text, ink, size, bold, align: "right" });
    y += size + 7;
  };
  if (state.run) {
    const left = secondsLeft(state);
    line(clock(left), left <= LOW_TIME ? VESSEL : INK, 22, true);
  }
  if (state.frozen) line(say(state.comparing ? "fem-shown" : "frozen"), TARGET, 13, true);
  if (!shown) return behind(drawn);
  const D = state.low.length, depth = Math.hypot(...state.low.map((_, d) => live.tip[d] - live.entry[d]));
  line(`${say("depth-short")} ${depth.toFixed(1)} mm`, INK, 13);
  line(`${state.needle.angle.toFixed(0)}°  ${(Math.abs(live.speed) < 0.05 ? 0 : live.speed).toFixed(0)} mm/s`, QUIET, 13);
  if (toTarget && live.watched.length >= D) line(`${say("to-target")} ${Math.hypot(...state.low.map((_, d) => live.tip[d] - live.watched[d])).toFixed(1)} mm`, TARGET, 13);
  if (state.held && seen.inside) line(`${say("off-plane")} ${Math.abs(seen.tip[2]).toFixed(1)} mm`, Math.abs(seen.tip[2]) > SLICE ? VESSEL : QUIET, 13);
  return behind(drawn);
}

/** Lines of text with a dark plate behind them, or they are lost on bright tissue. @param {DrawCommand[]} lines right-aligned @returns {DrawCommand[]} */
function behind(lines) {
  const texts = lines.flatMap((command) => (command.draw === "text" ? [command] : []));
  if (!texts.length) return lines;
  const wide = Math.max(...texts.map(({ text, size = 12, bold }) => text.length * size * (bold ? 0.62 : 0.56))), [right] = texts[0].at, sizes = texts.map(({ size = 12 }) => size);
  const area = { left: right - wide - 8, top: texts[0].at[1] - sizes[0] * 0.8, right: right + 7, bottom: texts[texts.length - 1].at[1] + 12 };
  return [{ draw: "bar", area, from: PLATE, to: PLATE, round: 6 }, ...lines];
}

/** How the picture is shown, at its lower left, as on a scanner. @param {View} view @param {State} state @param {Say} say @returns {DrawCommand[]} */
function settings(view, { look }, say) {
  const sign = look.gain > 0 ? "+" : "", bent = look.timeGain.some((dB) => dB !== 0);
  const text = `${say("gain-short")} ${sign}${look.gain.toFixed(0)} dB   ${say("range-short")} ${look.dynamicRange.toFixed(0)} dB${bent ? `   ${say("time-gain-short")}` : ""}`;
  return [{ draw: "text", at: [view.area.left + 10, view.area.bottom - 14], text, ink: QUIET, size: 11 }];
}

/** @param {number} seconds */
export function clock(seconds) {
  const whole = Math.ceil(seconds);
  return `${Math.floor(whole / 60)}:${String(whole % 60).padStart(2, "0")}`;
}
