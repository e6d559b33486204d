// Where millimetres lie on the screen: fit, zoom, pan.

/** @import { Point } from "./protocol.js" */

const MARGIN = { top: 46, right: 46, bottom: 18, left: 18 }; // CSS pixels for probe, ruler and air

export class View {
  constructor() {
    this.width = 1;
    this.height = 1;
    this.extent = { x0: 0, x1: 1, y0: 0, y1: 1 };
    this.zoom = 1;
    /** @type {Point} CSS pixels */
    this.pan = [0, 0];
  }

  /** Size in CSS pixels. @param {number} width @param {number} height */
  resize(width, height) {
    this.width = Math.max(width, 1);
    this.height = Math.max(height, 1);
  }

  fit() {
    this.zoom = 1;
    this.pan = [0, 0];
  }

  /** CSS pixels per mm */
  get scale() {
    const { x0, x1, y0, y1 } = this.extent;
    const across = (this.width - MARGIN.left - MARGIN.right) / (x1 - x0);
    const down = (this.height - MARGIN.top - MARGIN.bottom) / (y1 - y0);
    return Math.max(0.1, Math.min(across, down)) * this.zoom;
  }

  /** @returns {Point} CSS pixels of (0, 0) mm */
  get offset() {
    const { x0, x1, y0, y1 } = this.extent, s = this.scale;
    const freeX = this.width - MARGIN.left - MARGIN.right - s * (x1 - x0);
    const freeY = this.height - MARGIN.top - MARGIN.bottom - s * (y1 - y0);
    return [
      MARGIN.left + freeX / 2 - s * x0 + this.pan[0],
      MARGIN.top + (this.zoom > 1 ? freeY / 2 : Math.max(0, freeY / 2)) - s * y0 + this.pan[1],
    ];
  }

  /** @param {Point} mm @returns {Point} CSS pixels */
  toScreen(mm) {
    const [ox, oy] = this.offset, s = this.scale;
    return [ox + s * mm[0], oy + s * mm[1]];
  }

  /** @param {Point} pixel CSS pixels @returns {Point} mm */
  toMm(pixel) {
    const [ox, oy] = this.offset, s = this.scale;
    return [(pixel[0] - ox) / s, (pixel[1] - oy) / s];
  }

  /** Zoom about a point on the screen. @param {number} factor @param {Point} [about] */
  zoomBy(factor, about = [this.width / 2, this.height / 2]) {
    const before = this.toMm(about);
    this.zoom = Math.min(12, Math.max(1, this.zoom * factor));
    if (this.zoom === 1) this.pan = [0, 0];
    const after = this.toScreen(before);
    this.pan = [this.pan[0] + about[0] - after[0], this.pan[1] + about[1] - after[1]];
  }

  /** @returns {[number, number, number, number]} scale x y and offset x y, mm to clip coordinates */
  toClip() {
    const [ox, oy] = this.offset, s = this.scale;
    return [(2 * s) / this.width, (-2 * s) / this.height, (2 * ox) / this.width - 1, 1 - (2 * oy) / this.height];
  }
}
