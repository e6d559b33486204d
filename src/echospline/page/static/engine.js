// The engine: a pack's scene in the core, stepped and drawn. It knows no document and runs in node too.

import { load } from "./../../_native/echospline.js";
import { planeMatrix, planeOptions, raised, turnedDown } from "./probe.js";
import { readPack } from "./scene.js";

/** @import { Core, Forced, Pose, Tissue } from "./../../_native/echospline.js" */
/** @import { ProbePose } from "./probe.js" */
/** @import { ModelEntry, Pack } from "./scene.js" */
/** @typedef {{ entry: ArrayLike<number>, tip: ArrayLike<number> }} Hand where the hand wants the needle, mm */
/**
 * How grey becomes colour: gain and each slider of time-gain in dB, dynamic range in dB. The reference picture is shown as it is at
 * gain 0 and RECORDED_RANGE.
 * @typedef {{ gain: number, timeGain: number[], dynamicRange: number, invert: boolean }} Look
 */
/**
 * What a model gives to the engine.
 * @typedef {{ readonly tissue: Tissue | Forced | Moving, reset: () => void, advance: (pose: Pose) => void, at: (points: number[]) => ArrayLike<number>, save: () => Uint8Array, load: (saved: Uint8Array) => void, destroy: () => void }} Solver
 */

/**
 * What shows the tissue: the deformed image, or the plane under the probe.
 * @typedef {{
 *   columns: number, rows: number, follow: (solver: Solver, other: Float32Array | null) => void, draw: (solver: Solver, plane: ProbePose | null, needle: Needle | null) => Uint8Array,
 *   shade: (look: CoreLook) => Uint8ClampedArray
 * }} Showing
 */
/** @import { GreenTables, Look as CoreLook, Moving, Needle, SpatialOptions } from "./../../_native/echospline.js" */

/** dB that the grey levels of a recorded picture are taken to span. */
export const RECORDED_RANGE = 60;
const MOTION_ACROSS = 16; // arrows over the width of the picture
const OUT_OF_TISSUE = 1e-9; // mm; a shorter needle is not drawn, as in Python
const STRAIGHT_SPEED = 10, STRAIGHT_STRIDE = 0.5; // mm/s and mm: how a new model is brought to the present pose

export class Engine {
  /** @param {Uint8Array | ArrayBuffer} coreBytes echospline.wasm @param {Uint8Array} packBytes */
  static async open(coreBytes, packBytes) {
    const pack = readPack(packBytes);
    return new Engine(await load(/** @type {BufferSource} */ (coreBytes)), pack);
  }

  /** @param {Core} core @param {Pack} pack */
  constructor(core, pack) {
    this.core = core;
    this.pack = pack;
    this.dt = 1 / pack.rate;
    this.model = pack.models[0];
    /** @type {Pose} */
    this.pose = home(pack);
    /** @type {Showing} */
    this.showing = pack.volume ? planeOf(core, pack) : imageOf(core, pack);
    this.columns = this.showing.columns;
    this.rows = this.showing.rows;
    /** @type {ProbePose | null} */
    this.held = pack.probe?.pose ?? null;
    /** @type {Solver} */
    this.solver = solverOf(core, pack, this.model);
    this.stale = true; // the picture's deformation is older than the tissue's
    /** Displacement of the mesh's nodes by another model, shown in place of this one's until the tissue moves again. @type {Float32Array | null} */
    this.other = null;
  }

  /** Change the model and keep the pose: the new one begins with a straight insertion to it. @param {string} name */
  choose(name) {
    const entry = this.pack.models.find((model) => model.name === name);
    if (!entry) throw new Error(`This scene has no model ${JSON.stringify(name)}; it has ${this.pack.models.map((model) => model.name).join(", ")}.`);
    const next = solverOf(this.core, this.pack, entry);
    this.solver.destroy();
    this.solver = next;
    this.model = entry;
    this.insert();
  }

  /** Bring tissue at rest to the present pose by a straight insertion. */
  insert() {
    this.stale = true;
    this.other = null;
    const { entry: from, tip } = this.pose, way = Array.from(tip, (value, d) => value - from[d]);
    const depth = Math.hypot(...way), steps = Math.ceil(depth / STRAIGHT_STRIDE);
    for (let k = 1; k <= steps; ++k) {
      const part = Array.from(from, (value, d) => value + (way[d] * k) / steps);
      this.solver.advance({ entry: from, tip: part, speed: STRAIGHT_SPEED, dt: depth / steps / STRAIGHT_SPEED });
    }
  }

  /** Needle out and home, tissue at rest. @param {ArrayLike<number>} [entry] where home is, mm */
  reset(entry = this.pack.needle.entry) {
    this.solver.reset();
    this.pose = { entry: Array.from(entry), tip: Array.from(entry), speed: 0, dt: this.dt };
    this.other = null;
    this.stale = true;
  }

  /** Where the probe is held; null in the plane. */
  get plane() {
    return this.held;
  }

  set plane(pose) {
    if (!this.held || !pose || pose === this.held || pose.every((value, k) => value === this.held?.[k])) return;
    this.held = pose;
    this.stale = true;
  }

  /** The needle appears at a place, as one that a tracker sees again. @param {Hand} hand */
  appear({ entry, tip }) {
    this.reset(entry);
    this.pose = { ...this.pose, tip: Array.from(tip) };
    this.insert();
  }

  /** Show another model's displacement of the mesh's nodes; says how far it is from this one's, mm. @param {Float32Array} field @returns {{ mean: number, most: number }} */
  compare(field) {
    const { tissue } = this.solver;
    if (!("displacement" in tissue)) throw new Error("This model has no displacement of a mesh.");
    const own = tissue.displacement(), D = this.pack.dimension;
    if (own.length !== field.length) throw new Error(`Expected ${own.length} numbers of displacement; got ${field.length}.`);
    let sum = 0, most = 0;
    for (let k = 0; k < own.length; k += D) {
      let square = 0;
      for (let d = 0; d < D; ++d) square += (own[k + d] - field[k + d]) ** 2;
      sum += Math.sqrt(square);
      most = Math.max(most, Math.sqrt(square));
    }
    this.other = field;
    this.stale = true;
    return { mean: (sum * D) / own.length, most };
  }

  /** Show this model's displacement again. */
  show() {
    this.other = null;
    this.stale = true;
  }

  /** One step of 1/rate s towards the hand. @param {Hand} hand @returns {Pose} */
  step(hand) {
    const { lag, fastest } = this.pack.needle;
    return this.take(this.core.follow(this.pose, { ...hand, lag, fastest }, this.dt));
  }

  /** One step to a recorded pose. @param {Pose} pose @returns {Pose} */
  take(pose) {
    this.solver.advance(pose);
    this.pose = pose;
    this.other = null;
    this.stale = true;
    return pose;
  }

  /** Tissue and needle now, to come back to. @returns {{ pose: Pose, tissue: Uint8Array }} */
  save() {
    return { pose: this.pose, tissue: this.solver.save() };
  }

  /** @param {{ pose: Pose, tissue: Uint8Array }} saved */
  load(saved) {
    this.solver.load(saved.tissue);
    this.pose = saved.pose;
    this.stale = true;
  }

  /**
   * Run recorded poses through a model of its own, from rest; the engine stays as it is.
   * @param {string} name @param {Float64Array} poses rows of [entry, tip, speed] @param {number} rate steps per second @param {number[]} places flat, mm
   * @returns {Float64Array} where the places lie after every row
   */
  retrace(name, poses, rate, places) {
    const entry = this.pack.models.find((model) => model.name === name);
    if (!entry) throw new Error(`This scene has no model ${JSON.stringify(name)}.`);
    const solver = solverOf(this.core, this.pack, entry), D = this.pack.dimension, rows = poses.length / (2 * D + 1), watched = new Float64Array(rows * places.length);
    try {
      for (let row = 0; row < rows; ++row) {
        solver.advance(poseOf(poses, row, 1 / rate, D));
        const moved = solver.at(places);
        for (let k = 0; k < places.length; ++k) watched[row * places.length + k] = places[k] + moved[k];
      }
    } finally {
      solver.destroy();
    }
    return watched;
  }

  /** Displacement of reference points, mm. @param {number[]} points flat @returns {ArrayLike<number>} flat */
  displacementAt(points) {
    return points.length ? this.solver.at(points) : [];
  }

  /** Places whose motion decides whether a new picture is needed: the needle, its surroundings, a coarse lattice. @param {{ low: number[], high: number[] }} tissue */
  samples({ low, high }) {
    const { entry, tip } = this.pose, points = [];
    const inside = (/** @type {number[]} */ p) => p.map((value, d) => Math.min(Math.max(value, low[d]), high[d]));
    for (const part of [0.33, 0.66, 1]) for (const side of [-2, 0, 2]) points.push(...inside(low.map((_, d) => entry[d] + part * (tip[d] - entry[d]) + (d === 0 ? side : 0))));
    for (let k = 0; k < 16; ++k) points.push(...low.map((from, d) => from + (d === 0 ? (k % 4) + 0.5 : d === 1 ? Math.floor(k / 4) + 0.5 : 2) * 0.25 * (high[d] - from)));
    return [...Array.from(entry), ...Array.from(tip), ...Array.from(this.displacementAt(points))];
  }

  /** Places of the picture and where they have moved, as it sees them: flat [x, y, to x, to y], mm. @param {{ x0: number, y0: number, x1: number, y1: number }} extent @param {{ low: number[], high: number[] }} tissue */
  motion({ x0, y0, x1, y1 }, { low, high }) {
    const m = this.held && planeMatrix(this.held), gap = (x1 - x0) / MOTION_ACROSS, places = [], points = [];
    for (let y = y0 + gap / 2; y < y1; y += gap) {
      for (let x = x0 + gap / 2; x < x1; x += gap) {
        const point = m ? raised(m, [x, y]) : [x, y];
        if (point.some((value, d) => value < low[d] || value > high[d])) continue;
        places.push([x, y]);
        points.push(...point);
      }
    }
    const moved = this.displacementAt(points), D = low.length;
    return places.flatMap(([x, y], k) => {
      const u = turnedDown(m, Array.from({ length: D }, (_, d) => moved[D * k + d]));
      return [x, y, x + u[0], y + u[1]];
    });
  }

  /** The picture now, grey. @returns {Uint8Array} a view, right until the next call into the core */
  grey() {
    if (this.stale) this.showing.follow(this.solver, this.other);
    this.stale = false;
    const { entry, tip } = this.pose;
    const inside = Math.hypot(...Array.from(tip, (value, d) => value - entry[d])) >= OUT_OF_TISSUE;
    return this.showing.draw(this.solver, this.held, inside ? { ...this.pack.needle.echo, entry, tip } : null);
  }

  /** The picture now in colour, (rows, columns, 4). @param {Look} look @returns {Uint8ClampedArray<ArrayBuffer>} a view, right until the next call into the core */
  draw({ gain, timeGain, dynamicRange, invert }) {
    if (this.stale) this.grey();
    const look = { gain, depth_gains: timeGain, dynamic_range: dynamicRange, recorded_range: RECORDED_RANGE, invert: Number(invert) };
    return /** @type {Uint8ClampedArray<ArrayBuffer>} */ (this.showing.shade(look));
  }
}

/** @param {Core} core @param {Pack} pack @returns {Showing} */
function imageOf(core, { image, mesh, array }) {
  if (!image) throw new Error("A scene has an image or a volume.");
  const { columns, rows, spacing, origin, pixels } = image;
  const picture = core.picture({ columns, rows, spacing, origin, mesh_shape: mesh.shape, mesh_spacing: mesh.spacing, mesh_origin: mesh.origin }, /** @type {Uint8Array} */ (array(pixels)));
  return {
    columns, rows, follow: ({ tissue }, other) => (other ? picture.deform(other) : picture.follow(/** @type {Tissue | Forced} */ (tissue))), draw: (_, __, needle) => /** @type {Uint8Array} */ (picture.draw(needle)),
    shade: (look) => picture.shade(look),
  };
}

/** @param {Core} core @param {Pack} pack @returns {Showing} */
function planeOf(core, { volume, probe, array }) {
  if (!volume || !probe) throw new Error("A scene in space has a volume and a probe.");
  const { columns, rows } = probe, apex = probe.shape === "curved" ? [0, -probe.radius] : undefined;
  const plane = core.plane(core.volume({ shape: volume.shape, spacing: volume.spacing, origin: volume.origin }, /** @type {Uint8Array} */ (array(volume.voxels))), planeOptions(probe));
  return {
    columns, rows, follow: () => {}, shade: (look) => plane.shade(look),
    draw: ({ tissue }, pose, needle) => plane.draw(planeMatrix(pose ?? probe.pose), /** @type {Moving} */ (tissue), needle && { ...needle, ...(apex ? { apex, curved: 1 } : {}) }),
  };
}

/** A recorded pose. @param {Float64Array} poses rows of [entry, tip, speed] @param {number} row @param {number} dt s @param {number} [dimension] @returns {Pose} */
export function poseOf(poses, row, dt, dimension = 2) {
  const k = (2 * dimension + 1) * row;
  return { entry: Array.from(poses.subarray(k, k + dimension)), tip: Array.from(poses.subarray(k + dimension, k + 2 * dimension)), speed: poses[k + 2 * dimension], dt };
}

/** The needle out of the tissue. @param {Pack} pack @returns {Pose} */
function home(pack) {
  return { entry: [...pack.needle.entry], tip: [...pack.needle.entry], speed: 0, dt: 1 / pack.rate };
}

/** @param {Core} core @param {Pack} pack @param {ModelEntry} model @returns {Solver} */
function solverOf(core, pack, model) {
  const given = Object.fromEntries(Object.entries(model.arrays).map(([name, array]) => [name, pack.array(array)]));
  if (model.kind === "forced" && pack.dimension === 3) {
    const tissue = core.spatial(/** @type {SpatialOptions} */ ({ ...model.options, ...model.response, ...given }));
    let moved = true; // the field is that of the state
    const now = () => {
      if (moved) tissue.move();
      moved = false;
      return tissue;
    };
    const after = (/** @type {() => void} */ change) => {
      change();
      moved = true;
    };
    return {
      get tissue() {
        return now();
      },
      reset: () => after(() => tissue.reset()), advance: (pose) => after(() => tissue.advance(pose)), at: (points) => now().displacementAt(points), save: () => tissue.save(),
      load: (saved) => after(() => tissue.restore(saved)), destroy: () => tissue.destroy(),
    };
  }
  if (model.kind === "forced") {
    const tissue = core.green(model.options, /** @type {GreenTables} */ ({ ...model.response, ...given }));
    return {
      tissue, reset: () => tissue.reset(), advance: (pose) => tissue.advance(pose), at: (points) => tissue.displacementAt(points), save: () => tissue.save(),
      load: (saved) => tissue.restore(saved), destroy: () => tissue.destroy(),
    };
  }
  const scene = core.scene({ ...model.options, ...given }), tissue = scene.tissue();
  return {
    tissue, reset: () => tissue.reset(), advance: (pose) => tissue.advance(pose), at: (points) => tissue.displacementAt(points), save: () => tissue.save(),
    load: (saved) => tissue.load(saved),
    destroy: () => {
      tissue.destroy();
      scene.destroy();
    },
  };
}
