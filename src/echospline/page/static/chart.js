// Small plots on a canvas: lines over time, and a score's progress.

/**
 * @typedef {{ label: string, colour: string, x: number[], y: number[], dots?: boolean }} ChartLine
 * @typedef {{ lines: ChartLine[], xLabel: string, yLabel: string, level?: number, levelLabel?: string, counted?: boolean, marks?: { x: number, colour: string }[] }} Chart
 *   counted: x are whole numbers from 1; marks: vertical lines
 */

const CHART_INKS = { dark: { ink: "#b8c7d1", faint: "#26323b", level: "#ffd166" }, light: { ink: "#45545e", faint: "#dbe3e8", level: "#8a5a00" } };
/** Colours of lines, by theme. */
export const LINES = { dark: { one: "#5fd4e0", two: "#9be7a8", other: "#c9a4ff" }, light: { one: "#0b7285", two: "#1f7a3a", other: "#6b3fa0" } };

/** @param {HTMLCanvasElement} canvas @param {Chart} chart @param {"dark" | "light"} theme */
export function drawChart(canvas, chart, theme) {
  const width = canvas.clientWidth || 480, height = canvas.clientHeight || 200, ratio = devicePixelRatio || 1, inks = CHART_INKS[theme];
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const c = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  c.clearRect(0, 0, width, height);
  c.font = "12px system-ui, sans-serif";
  const xs = chart.lines.flatMap((line) => line.x), ys = chart.lines.flatMap((line) => line.y);
  if (!xs.length) return;
  const x0 = chart.counted ? 1 : Math.min(0, ...xs), x1 = Math.max(...xs, x0 + (chart.counted ? 1 : 1e-6));
  const y1 = niceAbove(Math.max(...ys, chart.level ?? 0, 1e-6));
  const box = { left: 44, right: width - 12, top: 26, bottom: height - 36 };
  const px = (/** @type {number} */ x) => box.left + ((x - x0) / (x1 - x0)) * (box.right - box.left);
  const py = (/** @type {number} */ y) => box.bottom - (y / y1) * (box.bottom - box.top);
  const line = (/** @type {[number, number][]} */ points, /** @type {string} */ ink, /** @type {number} */ wide) => {
    c.strokeStyle = ink;
    c.lineWidth = wide;
    c.beginPath();
    points.forEach(([x, y], k) => (k ? c.lineTo(x, y) : c.moveTo(x, y)));
    c.stroke();
  };
  c.textBaseline = "middle";
  c.lineJoin = "round";
  for (let k = 0; k <= 4; ++k) {
    const y = (y1 * k) / 4;
    line([[box.left, py(y)], [box.right, py(y)]], inks.faint, 1);
    label(c, shortNumber(y), box.left - 6, py(y), inks.ink, "right");
  }
  const step = chart.counted ? Math.max(1, Math.ceil((x1 - x0) / 8)) : niceStep((x1 - x0) / 5);
  for (let x = x0; x <= x1 + 1e-9; x += step) label(c, shortNumber(x), px(x), box.bottom + 12, inks.ink, "center");
  label(c, chart.xLabel, (box.left + box.right) / 2, height - 9, inks.ink, "center");
  label(c, chart.yLabel, 4, 9, inks.ink, "left");
  for (const mark of chart.marks ?? []) line([[px(mark.x), box.top], [px(mark.x), box.bottom]], mark.colour, 1.5);
  if (chart.level !== undefined) {
    c.setLineDash([5, 5]);
    line([[box.left, py(chart.level)], [box.right, py(chart.level)]], inks.level, 1.5);
    c.setLineDash([]);
    label(c, chart.levelLabel ?? "", box.left + 6, py(chart.level) - 8, inks.level, "left");
  }
  let legend = box.right;
  for (const { label: name, colour, x, y, dots } of chart.lines) {
    line(x.map((value, k) => [px(value), py(y[k])]), colour, 2);
    c.fillStyle = colour;
    if (dots || x.length === 1) {
      x.forEach((value, k) => {
        c.beginPath();
        c.arc(px(value), py(y[k]), 3.5, 0, 2 * Math.PI);
        c.fill();
      });
    }
    if (!name) continue;
    label(c, name, legend, 9, colour, "right");
    legend -= c.measureText(name).width + 16;
  }
}

/** @param {CanvasRenderingContext2D} c @param {string} words @param {number} x @param {number} y @param {string} ink @param {CanvasTextAlign} align */
function label(c, words, x, y, ink, align) {
  c.fillStyle = ink;
  c.textAlign = align;
  c.fillText(words, x, y);
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
function shortNumber(value) {
  return value === 0 ? "0" : String(Number(value.toPrecision(3)));
}
