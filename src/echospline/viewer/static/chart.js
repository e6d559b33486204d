// Small plots on a canvas: lines over time, and a score's progress.

const INK = "#b8c7d1", FAINT = "#2b3740";

/**
 * @typedef {object} Line
 * @property {string} label
 * @property {string} colour
 * @property {number[]} x
 * @property {number[]} y
 * @property {boolean} [dots]
 */

/**
 * @param {HTMLCanvasElement} canvas
 * @param {{ lines: Line[], xLabel: string, yLabel: string, level?: number, levelLabel?: string, counted?: boolean }} plot counted: x are whole numbers from 1
 */
export function drawChart(canvas, plot) {
  const width = canvas.clientWidth || 480, height = canvas.clientHeight || 200, ratio = devicePixelRatio || 1;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const c = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  c.clearRect(0, 0, width, height);
  c.font = "12px system-ui, sans-serif";
  const xs = plot.lines.flatMap((line) => line.x), ys = plot.lines.flatMap((line) => line.y);
  if (!xs.length) return;
  const x0 = plot.counted ? 1 : Math.min(0, ...xs), x1 = Math.max(...xs, x0 + (plot.counted ? 1 : 1e-6));
  const y1 = niceAbove(Math.max(...ys, plot.level ?? 0, 1e-6));
  const box = { left: 44, right: width - 12, top: 22, bottom: height - 34 };
  const px = (/** @type {number} */ x) => box.left + ((x - x0) / (x1 - x0)) * (box.right - box.left);
  const py = (/** @type {number} */ y) => box.bottom - (y / y1) * (box.bottom - box.top);
  c.textBaseline = "middle";
  c.lineWidth = 1;
  for (let k = 0; k <= 4; ++k) {
    const y = (y1 * k) / 4;
    c.strokeStyle = FAINT;
    c.beginPath();
    c.moveTo(box.left, py(y));
    c.lineTo(box.right, py(y));
    c.stroke();
    c.fillStyle = INK;
    c.textAlign = "right";
    c.fillText(short(y), box.left - 6, py(y));
  }
  c.textAlign = "center";
  const step = plot.counted ? Math.max(1, Math.ceil((x1 - x0) / 8)) : niceStep((x1 - x0) / 5);
  for (let x = x0; x <= x1 + 1e-9; x += step) c.fillText(short(x), px(x), box.bottom + 12);
  c.fillText(plot.xLabel, (box.left + box.right) / 2, height - 8);
  c.textAlign = "left";
  c.fillText(plot.yLabel, 4, 9);
  if (plot.level !== undefined) {
    c.setLineDash([5, 5]);
    c.strokeStyle = "#ffd166";
    c.beginPath();
    c.moveTo(box.left, py(plot.level));
    c.lineTo(box.right, py(plot.level));
    c.stroke();
    c.setLineDash([]);
    c.fillStyle = "#ffd166";
    c.textAlign = "left";
    c.fillText(plot.levelLabel ?? "", box.left + 6, py(plot.level) - 8);
  }
  let legend = box.right;
  for (const line of plot.lines) {
    c.strokeStyle = c.fillStyle = line.colour;
    c.lineWidth = 2;
    c.lineJoin = "round";
    c.beginPath();
    line.x.forEach((x, k) => (k ? c.lineTo(px(x), py(line.y[k])) : c.moveTo(px(x), py(line.y[k]))));
    c.stroke();
    if (line.dots) {
      line.x.forEach((x, k) => {
        c.beginPath();
        c.arc(px(x), py(line.y[k]), 3.5, 0, 2 * Math.PI);
        c.fill();
      });
    }
    c.textAlign = "right";
    c.fillText(line.label, legend, 9);
    legend -= c.measureText(line.label).width + 16;
  }
}

/** @param {number} value */
function niceAbove(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * ([1, 1.2, 1.6, 2, 2.4, 3.2, 4, 4.8, 6, 8, 10].find((step) => step * power >= value) ?? 10);
}

/** A round distance between ticks, at least as large. @param {number} value */
function niceStep(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * ([1, 2, 2.5, 5, 10].find((step) => step * power >= value) ?? 10);
}

/** @param {number} value */
function short(value) {
  return value === 0 ? "0" : String(Number(value.toPrecision(3)));
}
