// What is drawn over the image: probe, ruler, the needle outside the tissue, guide, targets, arrows, legend.

import { colourOf } from "./renderer.js";
import { splineAt } from "./spline.js";

/** @import { Frame, Point } from "./protocol.js" */
/** @import { View } from "./view.js" */

const INK = "#e8f1f5", HALO = "rgba(0, 0, 0, 0.75)", ACCENT = "#5fd4e0", TARGET = "#ffd166", VESSEL = "#ff7b7b";
const FONT = "12px system-ui, sans-serif";
const OUTSIDE = 34; // mm of shaft drawn above the skin

/**
 * @typedef {object} Extras
 * @property {boolean} guide
 * @property {boolean} arrows
 * @property {boolean} heat
 * @property {number} heatScale mm
 * @property {number} angle degrees, also when the needle is out
 * @property {any} exercise running, or null
 * @property {any} scene as Scene.describe
 */

export class Overlay {
  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    this.canvas = canvas;
    this.context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  }

  /**
   * @param {Frame} frame
   * @param {View} view
   * @param {Extras} extras
   */
  draw(frame, view, extras) {
    const c = this.context, ratio = this.canvas.width / view.width;
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, view.width, view.height);
    c.lineCap = "round";
    c.font = FONT;
    this.ruler(view);
    this.probe(view);
    if (extras.arrows) this.arrows(frame, view, extras.scene.mesh);
    if (extras.guide) this.guide(frame, view, extras.angle);
    if (extras.exercise) this.exercise(frame, view, extras.exercise);
    this.hub(frame, view, extras.angle);
    if (extras.heat) this.legend(view, extras.heatScale, frame.reference !== null);
  }

  /** A line with a dark halo, so that it shows on speckle. @param {() => void} path @param {string} ink @param {number} [width] */
  stroke(path, ink, width = 2) {
    const c = this.context;
    for (const [style, w] of /** @type {[string, number][]} */ ([[HALO, width + 2.5], [ink, width]])) {
      c.beginPath();
      path();
      c.strokeStyle = style;
      c.lineWidth = w;
      c.stroke();
    }
  }

  /** @param {string} words @param {number} x @param {number} y @param {string} ink @param {CanvasTextAlign} [align] */
  text(words, x, y, ink, align = "left") {
    const c = this.context;
    c.textAlign = align;
    c.textBaseline = "middle";
    c.strokeStyle = HALO;
    c.lineWidth = 3;
    c.lineJoin = "round";
    c.strokeText(words, x, y);
    c.fillStyle = ink;
    c.fillText(words, x, y);
  }

  /** Depth in cm on the right, ticks every 5 mm. @param {View} view */
  ruler(view) {
    const c = this.context, { x1, y0, y1 } = view.extent;
    const x = Math.min(view.toScreen([x1, 0])[0] + 8, view.width - 34);
    const [, top] = view.toScreen([0, y0]), [, bottom] = view.toScreen([0, y1]);
    c.strokeStyle = "#5b6b77";
    c.lineWidth = 1.5;
    c.beginPath();
    c.moveTo(x, top);
    c.lineTo(x, bottom);
    for (let mm = 0; mm <= y1 - y0 + 1e-6; mm += 5) {
      const [, y] = view.toScreen([0, y0 + mm]);
      c.moveTo(x, y);
      c.lineTo(x + (mm % 10 ? 5 : 9), y);
    }
    c.stroke();
    for (let mm = 0; mm <= y1 - y0 + 1e-6; mm += 10) {
      const [, y] = view.toScreen([0, y0 + mm]);
      if (y > 8 && y < view.height - 6) this.text(mm ? String(mm / 10) : "cm", x + 13, y, "#b8c7d1");
    }
  }

  /** The probe's face and the dot at its marked side. @param {View} view */
  probe(view) {
    const c = this.context, { x0, x1, y0 } = view.extent;
    const [left, y] = view.toScreen([x0, y0]), [right] = view.toScreen([x1, y0]);
    const face = c.createLinearGradient(0, y - 16, 0, y);
    face.addColorStop(0, "#27323b");
    face.addColorStop(1, "#4a5a66");
    c.fillStyle = face;
    c.beginPath();
    c.roundRect(left, y - 15, right - left, 13, [6, 6, 2, 2]);
    c.fill();
    c.fillStyle = ACCENT;
    c.beginPath();
    c.arc(left + 9, y - 8.5, 3.5, 0, 2 * Math.PI);
    c.fill();
  }

  /** The needle above the skin: where it comes from, even when it is not in. @param {Frame} frame @param {View} view @param {number} angle */
  hub(frame, view, angle) {
    const c = this.context, [dx, dy] = direction(angle);
    const [x, y] = view.toScreen(frame.entry);
    const reach = Math.min(OUTSIDE * view.scale, 90);
    const end = [x - dx * reach, y - dy * reach];
    c.save();
    c.beginPath();
    c.rect(0, 0, view.width, y - 1);
    c.clip();
    const metal = c.createLinearGradient(x, y, end[0], end[1]);
    metal.addColorStop(0, "#f4f8fa");
    metal.addColorStop(1, "#8fa3b0");
    c.strokeStyle = HALO;
    c.lineWidth = 6;
    c.beginPath();
    c.moveTo(x, y);
    c.lineTo(end[0], end[1]);
    c.stroke();
    c.strokeStyle = metal;
    c.lineWidth = 3;
    c.stroke();
    c.restore();
    c.fillStyle = "#fff";
    c.strokeStyle = HALO;
    c.lineWidth = 1.5;
    c.beginPath();
    c.moveTo(x, y - 1);
    c.lineTo(x - 5, y - 8);
    c.lineTo(x + 5, y - 8);
    c.closePath();
    c.fill();
    c.stroke();
  }

  /** Where the needle would go. @param {Frame} frame @param {View} view @param {number} angle */
  guide(frame, view, angle) {
    const c = this.context, [dx, dy] = direction(angle), far = 400;
    const [ax, ay] = view.toScreen(frame.tip), [bx, by] = view.toScreen([frame.tip[0] + far * dx, frame.tip[1] + far * dy]);
    const [left, top] = view.toScreen([view.extent.x0, view.extent.y0]);
    const [right, bottom] = view.toScreen([view.extent.x1, view.extent.y1]);
    c.save();
    c.beginPath();
    c.rect(left, top, right - left, bottom - top);
    c.clip();
    c.setLineDash([7, 7]);
    this.stroke(() => (c.moveTo(ax, ay), c.lineTo(bx, by)), ACCENT, 1.5);
    c.setLineDash([]);
    if (Math.hypot(frame.tip[0] - frame.entry[0], frame.tip[1] - frame.entry[1]) > 0.2) {
      this.stroke(() => c.arc(ax, ay, 8, 0, 2 * Math.PI), ACCENT, 1.5);
    }
    c.restore();
  }

  /** @param {Frame} frame @param {View} view @param {any} exercise */
  exercise(frame, view, exercise) {
    const c = this.context;
    const rings = [exercise.target, ...exercise.vessels];
    rings.forEach((ring, k) => {
      if (2 * k + 1 >= frame.watched.length) return;
      const [x, y] = view.toScreen([frame.watched[2 * k], frame.watched[2 * k + 1]]);
      const r = ring.radius * view.scale;
      if (k > 0) {
        c.fillStyle = "rgba(255, 90, 90, 0.16)";
        c.beginPath();
        c.arc(x, y, r, 0, 2 * Math.PI);
        c.fill();
      }
      this.stroke(() => c.arc(x, y, r, 0, 2 * Math.PI), k ? VESSEL : TARGET, 2);
      if (k === 0) this.stroke(() => (c.moveTo(x - 3, y), c.lineTo(x + 3, y), c.moveTo(x, y - 3), c.lineTo(x, y + 3)), TARGET, 1.5);
      this.text(k ? "vessel" : "target", x, y - r - 10, k ? VESSEL : TARGET, "center");
    });
  }

  /** Displacements, drawn longer than they are when small. @param {Frame} frame @param {View} view @param {any} mesh */
  arrows(frame, view, mesh) {
    const c = this.context, [nx, ny] = mesh.shape;
    const strideX = Math.max(1, Math.round((nx - 1) / 24)), strideY = Math.max(1, Math.round((ny - 1) / 24));
    const longest = Math.max(frame.largest, 1e-3);
    const stretch = Math.min(10, Math.max(1, 24 / view.scale / longest)) * view.scale;
    /** @type {[number, number, number, number][]} */
    const lines = [];
    for (let j = 0; j < ny; j += strideY) {
      for (let i = 0; i < nx; i += strideX) {
        /** @type {Point} */
        const rest = [mesh.origin[0] + i * mesh.spacing[0], mesh.origin[1] + j * mesh.spacing[1]];
        const k = 2 * (j * nx + i);
        const [ux, uy] = frame.displacement ? [frame.displacement[k], frame.displacement[k + 1]] : splineAt(frame.spline ?? new Float32Array(12), rest);
        if (Math.hypot(ux, uy) < 0.04 * longest || Math.hypot(ux, uy) < 0.005) continue;
        const [x, y] = view.toScreen(rest);
        lines.push([x, y, x + stretch * ux, y + stretch * uy]);
      }
    }
    this.stroke(() => lines.forEach(([ax, ay, bx, by]) => arrow(c, ax, ay, bx, by)), "#9be7a8", 1.5);
  }

  /** @param {View} view @param {number} scale mm @param {boolean} difference */
  legend(view, scale, difference) {
    const c = this.context, w = 140, h = 9;
    const [left, bottom] = view.toScreen([view.extent.x0, view.extent.y1]);
    const x = Math.max(12, left + 10), y = Math.min(view.height - 30, bottom - 30);
    c.fillStyle = "rgba(8, 12, 15, 0.78)";
    c.beginPath();
    c.roundRect(x - 8, y - 22, w + 16, 52, 6);
    c.fill();
    for (let k = 0; k < w; ++k) {
      c.fillStyle = `rgb(${colourOf(k / w).slice(0, 3).join(" ")})`;
      c.fillRect(x + k, y, 1.5, h);
    }
    this.text(difference ? "difference of models, mm" : "displacement, mm", x, y - 10, INK);
    this.text("0", x, y + h + 10, INK);
    this.text(scale.toPrecision(2), x + w, y + h + 10, INK, "right");
  }
}

/** @param {number} angle degrees @returns {Point} */
export function direction(angle) {
  return [Math.cos((angle * Math.PI) / 180), Math.sin((angle * Math.PI) / 180)];
}

/** @param {CanvasRenderingContext2D} c @param {number} ax @param {number} ay @param {number} bx @param {number} by */
function arrow(c, ax, ay, bx, by) {
  const a = Math.atan2(by - ay, bx - ax), r = Math.min(5, 0.4 * Math.hypot(bx - ax, by - ay));
  c.moveTo(ax, ay);
  c.lineTo(bx, by);
  c.moveTo(bx - r * Math.cos(a - 0.5), by - r * Math.sin(a - 0.5));
  c.lineTo(bx, by);
  c.lineTo(bx - r * Math.cos(a + 0.5), by - r * Math.sin(a + 0.5));
}
