// The small drawing of tissue, probe, plane and needle in space: a list of commands like the rest of the picture.

import { lowered, planeMatrix, raised } from "./probe.js";
import { axisOf } from "./state.js";
import { asideOf } from "./view.js";

/** @import { Area, DrawCommand, Live } from "./draw_list.js" */
/** @import { Exercise, Point } from "./scene.js" */
/** @import { State } from "./state.js" */
/** @typedef {{ low: number[], high: number[], area: Area }} Box tissue in mm, and where it is drawn */

const SHAPE = 0.78; // height over width
const LOOK_TURN = (-32 * Math.PI) / 180, LOOK_TILT = (24 * Math.PI) / 180; // how the body is looked at: from the front, a little from above and aside
const ABOVE = 30; // mm of needle and probe above the skin
const BODY = { line: "rgba(150, 175, 190, 0.55)", skin: "rgba(214, 160, 130, 0.20)", back: "rgba(10, 15, 19, 0.82)", plane: "rgba(95, 212, 224, 0.26)", edge: "#5fd4e0", probe: "#8fa3b0", needle: "#ffffff", hidden: "#8aa0ad" };

/** Where it is drawn, at the lower right of the stage; a drag there moves the probe. @param {State} state @returns {Area} CSS pixels */
export function bodyArea({ view }) {
  const { width, height } = view, wide = asideOf(view), high = SHAPE * wide;
  return { left: width - wide - 10, top: height - high - 10, right: width - 10, bottom: height - 10 };
}

/** Way from the scene to the drawing. @param {Box} box @returns {(p: ArrayLike<number>) => Point} */
export function projection({ low, high, area }) {
  const middle = low.map((from, d) => (from + high[d]) / 2), [c, s, ct, st] = [Math.cos(LOOK_TURN), Math.sin(LOOK_TURN), Math.cos(LOOK_TILT), Math.sin(LOOK_TILT)];
  const [w, h, l] = low.map((from, d) => high[d] - from), wide = w * c + l * Math.abs(s), tall = (h + ABOVE) * ct + (w * Math.abs(s) + l * c) * st;
  const scale = Math.min((area.right - area.left - 16) / wide, (area.bottom - area.top - 14) / tall);
  const [cx, cy] = [(area.left + area.right) / 2, (area.top + area.bottom) / 2 + (ABOVE * ct * scale) / 2];
  return (p) => {
    const [x, y, z] = [p[0] - middle[0], p[1] - middle[1], p[2] - middle[2]];
    return [cx + scale * (x * c + z * s), cy + scale * (y * ct + (x * s - z * c) * st)];
  };
}

/** @param {State} state @param {Live} live @param {Exercise | undefined} exercise @returns {DrawCommand[]} */
export function body(state, live, exercise) {
  const { low, high, probe, held, needle } = state;
  if (!probe || !held) return [];
  const area = bodyArea(state), to = projection({ low, high, area }), m = planeMatrix(held);
  const corner = (/** @type {number} */ k) => [k & 1 ? high[0] : low[0], k & 2 ? high[1] : low[1], k & 4 ? high[2] : low[2]];
  /** @type {DrawCommand[]} */
  const edges = [[0, 1], [0, 2], [1, 3], [2, 3], [4, 5], [4, 6], [5, 7], [6, 7], [0, 4], [1, 5], [2, 6], [3, 7]].map(([a, b]) => ({ draw: "line", points: [to(corner(a)), to(corner(b))], ink: BODY.line, width: 1 }));
  const half = -probe.origin[0], face = (/** @type {number} */ x, /** @type {number} */ y) => to(raised(m, [x, y]));
  const seen = probe.shape === "linear"
    ? [face(-half, 0), face(half, 0), face(half, probe.depth), face(-half, probe.depth)]
    : [...arc(probe, probe.radius), ...arc(probe, probe.radius + probe.depth).reverse()].map(([x, y]) => face(x, y));
  const top = probe.shape === "linear" ? half : probe.radius * Math.sin(((probe.opening / 2) * Math.PI) / 180), y0 = probe.shape === "linear" ? 0 : probe.origin[1];
  const axis = axisOf(needle), { entry, tip } = live, back = Array.from(entry, (value, d) => value - ABOVE * axis[d]), inside = Math.hypot(...Array.from(tip, (value, d) => value - entry[d])) > 0.2;
  const [, , off] = lowered(m, tip), ball = (/** @type {number} */ k, /** @type {string} */ ink, /** @type {number} */ radius) => /** @type {DrawCommand} */ ({ draw: "circle", at: to([live.watched[3 * k], live.watched[3 * k + 1], live.watched[3 * k + 2]]), r: Math.max(2.5, (radius * (to([1, 0, 0])[0] - to([0, 0, 0])[0])) / Math.cos(LOOK_TURN)), ink, width: 1.25, fill: `${ink}44` });
  return [
    { draw: "bar", area, from: BODY.back, to: BODY.back, round: 8 },
    { draw: "clip", area },
    { draw: "shape", points: [0, 1, 5, 4].map((k) => to(corner(k))), fill: BODY.skin },
    ...edges,
    ...(exercise && live.watched.length >= 3 ? [...exercise.vessels.map((vessel, k) => ball(k + 1, "#ff7b7b", vessel.radius)), ball(0, "#ffd166", exercise.target.radius)] : []),
    ...(off < 0 ? needleLines(to, back, entry, tip, inside) : []),
    { draw: "shape", points: seen, fill: BODY.plane, ink: BODY.edge },
    { draw: "shape", points: [face(-top, y0), face(top, y0), face(0.45 * top, y0 - 16), face(-0.45 * top, y0 - 16)], fill: BODY.probe, ink: "rgba(0, 0, 0, 0.5)" },
    { draw: "circle", at: face(-0.8 * top, y0 - 4), r: 2.5, ink: BODY.edge, width: 0, fill: BODY.edge },
    ...(off < 0 ? [] : needleLines(to, back, entry, tip, inside)),
    { draw: "clip", area: null },
  ];
}

/** @param {(p: ArrayLike<number>) => Point} to @param {ArrayLike<number>} back @param {ArrayLike<number>} entry @param {ArrayLike<number>} tip @param {boolean} inside @returns {DrawCommand[]} */
function needleLines(to, back, entry, tip, inside) {
  return [
    { draw: "line", points: [to(back), to(entry)], ink: BODY.needle, width: 2, halo: true },
    ...(inside ? /** @type {DrawCommand[]} */ ([{ draw: "line", points: [to(entry), to(tip)], ink: BODY.needle, width: 2, halo: true }, { draw: "circle", at: to(tip), r: 3, ink: BODY.edge, width: 1.5, fill: BODY.needle }]) : []),
  ];
}

/** Points of an arc about the apex of a curved probe, in its plane. @param {{ radius: number, opening: number }} probe @param {number} r mm @returns {[number, number][]} */
export function arc({ radius, opening }, r) {
  return Array.from({ length: 25 }, (_, k) => {
    const angle = ((k / 24 - 0.5) * opening * Math.PI) / 180;
    return [r * Math.sin(angle), r * Math.cos(angle) - radius];
  });
}
