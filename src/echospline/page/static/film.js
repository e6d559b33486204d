// The film of a kept attempt: its poses run again by the engine, to any row, with states on the way to go back to.

import { poseOf } from "./engine.js";

/** @import { Engine } from "./engine.js" */
/** @import { Point } from "./scene.js" */
/** @import { NeedleState } from "./state.js" */

const CHECKPOINT = 240; // rows between states to go back to

export class Film {
  /** @param {Engine} engine @param {Float64Array} poses @param {Float64Array | null} beside poses of the expert @param {number} rate rows per second */
  constructor(engine, poses, beside, rate) {
    this.engine = engine;
    this.poses = poses;
    this.beside = beside;
    this.rate = rate;
    this.row = 0; // rows that have been taken
    /** @type {Map<number, ReturnType<Engine["save"]>>} */
    this.saved = new Map();
    this.rewind();
  }

  rewind() {
    this.engine.reset([this.poses[0], this.poses[1]]);
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
      this.engine.take(poseOf(this.poses, this.row, 1 / this.rate));
    }
  }

  /** Where the needle is now, as the hand would say it. @param {number} angle degrees, for a needle that is out @returns {NeedleState} */
  needle(angle) {
    const { entry, tip } = this.engine.pose, [dx, dy] = [tip[0] - entry[0], tip[1] - entry[1]], depth = Math.hypot(dx, dy);
    return { entry: /** @type {Point} */ ([entry[0], entry[1]]), depth, angle: depth > 0.01 ? (Math.atan2(dy, dx) * 180) / Math.PI : angle };
  }

  /** The expert's needle at this moment. */
  expert() {
    return this.beside && poseOf(this.beside, Math.min(this.beside.length / 5 - 1, Math.max(0, this.row - 1)), 1);
  }
}
