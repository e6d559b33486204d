// Executes draw lists on a 2-D canvas. It knows no scene, no state and no tissue.

/** @import { Area, DrawCommand } from "./draw_list.js" */

const HALO = "rgba(0, 0, 0, 0.72)"; // under lines and text, or they vanish on speckle
const FONT = 'system-ui, "Segoe UI", Roboto, "Helvetica Neue", sans-serif';

export class Renderer {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {(columns: number, rows: number) => HTMLCanvasElement} makeCanvas for the picture at its own size
   */
  constructor(canvas, makeCanvas) {
    this.canvas = canvas;
    this.context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d", { alpha: false }));
    this.makeCanvas = makeCanvas;
    /** @type {HTMLCanvasElement | null} */
    this.small = null;
    this.ratio = 1;
  }

  /** @param {number} width @param {number} height CSS pixels @param {number} ratio device pixels per CSS pixel */
  resize(width, height, ratio) {
    this.ratio = ratio;
    const [columns, rows] = [Math.max(1, Math.round(width * ratio)), Math.max(1, Math.round(height * ratio))];
    if (this.canvas.width !== columns) this.canvas.width = columns;
    if (this.canvas.height !== rows) this.canvas.height = rows;
  }

  /** Take the picture's colours. @param {ImageData} colours */
  picture(colours) {
    if (!this.small || this.small.width !== colours.width || this.small.height !== colours.height) this.small = this.makeCanvas(colours.width, colours.height);
    /** @type {CanvasRenderingContext2D} */ (this.small.getContext("2d", { alpha: false })).putImageData(colours, 0, 0);
  }

  /** @param {DrawCommand[]} commands */
  draw(commands) {
    const c = this.context;
    c.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    c.lineCap = c.lineJoin = "round";
    let clipped = false;
    for (const command of commands) {
      if (command.draw === "clip") {
        if (clipped) c.restore();
        clipped = command.area !== null;
        if (command.area) clipTo(c, command.area);
      } else this.one(command);
    }
    if (clipped) c.restore();
  }

  /** @param {Exclude<DrawCommand, { draw: "clip" }>} command */
  one(command) {
    const c = this.context;
    if (command.draw === "fill") {
      c.fillStyle = command.ink;
      c.fillRect(0, 0, this.canvas.width / this.ratio, this.canvas.height / this.ratio);
    } else if (command.draw === "picture") {
      if (!this.small) return;
      clipTo(c, command.area);
      if (command.flip) {
        c.translate(2 * command.left + command.width, 0);
        c.scale(-1, 1);
      }
      c.drawImage(this.small, command.left, command.top, command.width, command.height);
      c.restore();
    } else if (command.draw === "line") {
      c.setLineDash(command.dash ?? []);
      this.stroke(command, () => command.points.forEach(([x, y], k) => (k ? c.lineTo(x, y) : c.moveTo(x, y))));
      c.setLineDash([]);
    } else if (command.draw === "circle") {
      if (command.fill) {
        c.fillStyle = command.fill;
        c.beginPath();
        c.arc(command.at[0], command.at[1], command.r, 0, 2 * Math.PI);
        c.fill();
      }
      if (command.width) this.stroke(command, () => c.arc(command.at[0], command.at[1], command.r, 0, 2 * Math.PI));
    } else if (command.draw === "shape") {
      c.beginPath();
      command.points.forEach(([x, y], k) => (k ? c.lineTo(x, y) : c.moveTo(x, y)));
      c.closePath();
      c.fillStyle = command.fill;
      c.fill();
      if (!command.ink) return;
      c.strokeStyle = command.ink;
      c.lineWidth = 1.5;
      c.stroke();
    } else if (command.draw === "bar") {
      const { left, top, right, bottom } = command.area, fade = c.createLinearGradient(0, top, 0, bottom);
      fade.addColorStop(0, command.from);
      fade.addColorStop(1, command.to);
      c.fillStyle = fade;
      c.beginPath();
      c.roundRect(left, top, right - left, bottom - top, [command.round, command.round, 2, 2]);
      c.fill();
    } else {
      c.font = `${command.bold ? "600 " : ""}${command.size ?? 12}px ${FONT}`;
      c.textAlign = command.align ?? "left";
      c.textBaseline = "middle";
      if (command.halo !== false) {
        c.strokeStyle = HALO;
        c.lineWidth = 3;
        c.strokeText(command.text, command.at[0], command.at[1]);
      }
      c.fillStyle = command.ink;
      c.fillText(command.text, command.at[0], command.at[1]);
    }
  }

  /** @param {{ ink: string, width: number, halo?: boolean }} command @param {() => void} path */
  stroke(command, path) {
    const c = this.context;
    c.beginPath();
    path();
    if (command.halo) {
      c.strokeStyle = HALO;
      c.lineWidth = command.width + 2.5;
      c.stroke();
    }
    c.strokeStyle = command.ink;
    c.lineWidth = command.width;
    c.stroke();
  }
}

/** Draw inside an area until restore. @param {CanvasRenderingContext2D} c @param {Area} area */
function clipTo(c, { left, top, right, bottom }) {
  c.save();
  c.beginPath();
  c.rect(left, top, right - left, bottom - top);
  c.clip();
}
