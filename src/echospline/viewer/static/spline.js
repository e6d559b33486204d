// A landmark spline evaluated in JavaScript: where the page itself needs the field (arrows).

/** @import { Point } from "./protocol.js" */

/**
 * Displacement at rest positions; the vertex shader computes the same.
 * @param {Float32Array} spline head of 12 values, then (x, y, weight x, weight y) per landmark
 * @param {Point} point mm
 * @returns {Point} mm
 */
export function splineAt(spline, point) {
  const [components, coupling, radius, cx, cy, scale, m0, m1, m2, m3, m4, m5] = spline;
  const x = (point[0] - cx) / scale, y = (point[1] - cy) / scale;
  let ux, uy;
  if (components === 1) {
    ux = m0 + m2 * x + m4 * y;
    uy = m1 + m3 * x + m5 * y;
  } else {
    ux = m0 - m2 * y;
    uy = m1 + m2 * x;
  }
  for (let k = 12; k < spline.length; k += 4) {
    const dx = x - spline[k], dy = y - spline[k + 1], wx = spline[k + 2], wy = spline[k + 3];
    const r2 = dx * dx + dy * dy;
    if (components === 1) {
      const u = r2 > 0 ? r2 * Math.log(r2) : 0;
      ux += u * wx;
      uy += u * wy;
    } else {
      const s = r2 + radius * radius;
      const same = -(4 - 2 * coupling) * (Math.log(s) + 1) - (4 * r2) / s;
      const along = (4 * coupling * (dx * wx + dy * wy)) / s;
      ux += same * wx + along * dx;
      uy += same * wy + along * dy;
    }
  }
  return [ux, uy];
}
