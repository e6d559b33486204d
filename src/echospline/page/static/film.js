// The film of a kept attempt: its poses run again by the engine, to any row, with states on the way to go back to.

import { poseOf } from "./engine.js";
import { anglesOf } from "./state.js";
import { heldAt } from "./training.js";

/** @import { Engine } from "./engine.js" */
/** @import { NeedleState } from "./state.js" */

const CHECKPOINT = 240; // rows between states to go back to

export class Film {
  /** @param {Engine} engine @param {Float64Array} poses @param {Float64Array | null} beside poses of the expert @param {number} rate rows per second @param {Float64Array | null} [planes] where the probe was held */
  constructor(engine, poses, beside, rate, planes = null) {
    this.planes = planes;
    this.engine = engine;
    this.poses = poses;
    this.beside = beside;
    this.rate = rate;
    this.dimension = engine.pack.dimension;
    this.row = 0; // rows that have been taken
    /** @type {Map<number, ReturnType<Engine["save"]>>} */
    this.saved = new Map();
    this.rewind();
  }

  rewind() {
    this.engine.reset(Array.from(this.poses.subarray(0, this.dimension)));
    this.row = 0;
  }

  /** Take rows until as many are taken as wanted. @param {number} wanted */
  seek(wanted) {
    if (wanted < this.row) {
      const from = Math.max(0, ...[...this.saved.keys()].filter((row) => row <= wanted)), state = this.saved.get(from);
      if (state) {
        this.engine.load(state);
        this.row = from;
      } else this.rewind();
    }
    for (; this.row < wanted; ++this.row) {
      if (this.row % CHECKPOINT === 0 && !this.saved.has(this.row)) this.saved.set(this.row, this.engine.save());
      this.engine.take(poseOf(this.poses, this.row, 1 / this.rate, this.dimension));
    }
  }

  /** Where the needle is now, as the hand would say it. @param {NeedleState} before its angles hold for a needle that is out @returns {NeedleState} */
  needle({ angle, heading }) {
    const { entry, tip } = this.engine.pose, way = Array.from(tip, (value, d) => value - entry[d]), depth = Math.hypot(...way);
    return { entry: Array.from(entry), depth, ...(depth > 0.01 ? anglesOf(way) : { angle, heading }) };
  }

  /** How the probe was held at this moment; null in the plane. */
  held() {
    return this.planes && heldAt(this.planes, Math.max(0, this.row - 1));
  }

  /** The expert's needle at this moment. */
  expert() {
    return this.beside && poseOf(this.beside, Math.min(this.beside.length / (2 * this.dimension + 1) - 1, Math.max(0, this.row - 1)), 1, this.dimension);
  }
}
