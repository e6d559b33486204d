// Mouse, touch, keys and gamepad move one needle.

import { direction } from "./overlay.js";

/** @import { Point, Pose } from "./protocol.js" */
/** @import { View } from "./view.js" */

const PUSH = 10, SLOW_PUSH = 2.5; // mm/s while a key is held, with Shift
const TURN = 25, SLOW_TURN = 6; // degrees/s
const SLIDE = 15; // mm/s of the entry while the needle is out
const WHEEL = 0.5; // mm a notch
const NEAR_SURFACE = 5; // mm; a press this near to the skin chooses the entry
const OUT = 0.3; // mm; a needle less deep is out and its entry can move
const DEAD = 0.15; // of a gamepad's stick

/**
 * What held keys do: [push, turn, slide].
 * @type {Record<string, [number, number, number]>}
 */
const HELD = {
  ArrowDown: [1, 0, 0], ArrowUp: [-1, 0, 0],
  ArrowLeft: [0, 1, 0], ArrowRight: [0, -1, 0],
  BracketLeft: [0, 0, -1], BracketRight: [0, 0, 1],
};

export class Needle {
  constructor() {
    /** @type {Point} */
    this.entry = [0, 0];
    this.angle = 90;
    this.depth = 0;
    this.extent = { x0: 0, x1: 1, y0: 0, y1: 1 };
    this.changed = false;
  }

  get out() {
    return this.depth < OUT;
  }

  /** Deepest that the tip may go and still be in the image, mm. */
  get deepest() {
    const [dx, dy] = direction(this.angle), { x0, x1, y1 } = this.extent, margin = 1;
    const down = dy > 1e-6 ? (y1 - margin - this.entry[1]) / dy : Infinity;
    const side = Math.abs(dx) < 1e-6 ? Infinity : dx > 0 ? (x1 - margin - this.entry[0]) / dx : (x0 + margin - this.entry[0]) / dx;
    return Math.max(0, Math.min(down, side));
  }

  /** @param {number} depth mm */
  setDepth(depth) {
    const next = Math.min(Math.max(depth, 0), this.deepest);
    if (next !== this.depth) this.changed = true;
    this.depth = next;
  }

  /** @param {number} angle degrees */
  setAngle(angle) {
    const next = Math.min(Math.max(angle, 8), 172);
    if (next === this.angle) return;
    this.angle = next;
    this.changed = true;
    this.setDepth(this.depth);
  }

  /** Move the entry along the skin, if the needle is out. @param {number} x mm */
  setEntry(x) {
    if (!this.out) return;
    this.entry = [Math.min(Math.max(x, this.extent.x0 + 1), this.extent.x1 - 1), this.extent.y0];
    this.changed = true;
    this.setDepth(this.depth);
  }

  /** @returns {Pose} */
  get pose() {
    return { entry: this.entry, angle: this.angle, depth: this.depth };
  }
}

export class Controls {
  /**
   * @param {HTMLElement} stage
   * @param {View} view
   * @param {Needle} needle
   * @param {(action: string) => void} act
   */
  constructor(stage, view, needle, act) {
    this.stage = stage;
    this.view = view;
    this.needle = needle;
    this.act = act;
    /** @type {Set<string>} */
    this.held = new Set();
    this.slow = false;
    /** @type {Map<number, Point>} */
    this.pointers = new Map();
    this.mode = "";
    /** @type {Set<number>} */
    this.pressed = new Set();
    this.enabled = true;
    stage.addEventListener("pointerdown", (event) => this.down(event));
    stage.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) stage.addEventListener(name, (event) => this.up(/** @type {PointerEvent} */ (event)));
    stage.addEventListener("contextmenu", (event) => event.preventDefault());
    stage.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    addEventListener("keydown", (event) => this.key(event, true));
    addEventListener("keyup", (event) => this.key(event, false));
    addEventListener("blur", () => this.held.clear());
  }

  /** @param {PointerEvent | WheelEvent} event @returns {Point} */
  place(event) {
    const box = this.stage.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  /** @param {PointerEvent} event */
  down(event) {
    if (/** @type {HTMLElement} */ (event.target).closest("button")) return;
    const place = this.place(event);
    this.stage.setPointerCapture(event.pointerId);
    this.stage.focus({ preventScroll: true });
    this.pointers.set(event.pointerId, place);
    if (this.pointers.size > 1) this.mode = "two";
    else if (event.button === 1 || event.altKey) this.mode = "pan";
    else if (event.button === 2 || event.shiftKey) this.mode = "turn";
    else {
      this.mode = "push";
      const [x, y] = this.view.toMm(place);
      if (this.enabled && this.needle.out && y < this.view.extent.y0 + NEAR_SURFACE) this.needle.setEntry(x);
      else if (this.enabled && this.needle.out && this.needle.depth === 0) this.aim([x, y]);
    }
  }

  /** Point the needle at a place. @param {Point} mm */
  aim([x, y]) {
    const [ex, ey] = this.needle.entry;
    if (y > ey + 1) this.needle.setAngle((Math.atan2(y - ey, x - ex) * 180) / Math.PI);
  }

  /** @param {PointerEvent} event */
  move(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const now = this.place(event);
    const others = [...this.pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    this.pointers.set(event.pointerId, now);
    const dx = now[0] - before[0], dy = now[1] - before[1], s = this.view.scale;
    if (this.mode === "pan") this.view.pan = [this.view.pan[0] + dx, this.view.pan[1] + dy];
    else if (this.mode === "two" && others.length) {
      const [o] = others;
      const turned = Math.atan2(now[1] - o[1], now[0] - o[0]) - Math.atan2(before[1] - o[1], before[0] - o[0]);
      if (this.enabled) this.needle.setAngle(this.needle.angle + (Math.atan2(Math.sin(turned), Math.cos(turned)) * 180) / Math.PI);
      const wide = Math.hypot(now[0] - o[0], now[1] - o[1]) / Math.max(1, Math.hypot(before[0] - o[0], before[1] - o[1]));
      this.view.zoomBy(wide, [(now[0] + o[0]) / 2, (now[1] + o[1]) / 2]);
    } else if (this.enabled && this.mode === "turn") {
      const [ex, ey] = this.view.toScreen(this.needle.entry);
      const turned = Math.atan2(now[1] - ey, now[0] - ex) - Math.atan2(before[1] - ey, before[0] - ex);
      this.needle.setAngle(this.needle.angle + (Math.atan2(Math.sin(turned), Math.cos(turned)) * 180) / Math.PI);
    } else if (this.enabled && this.mode === "push") {
      const [ax, ay] = direction(this.needle.angle);
      this.needle.setDepth(this.needle.depth + (dx * ax + dy * ay) / s);
    }
    this.act("moved");
  }

  /** @param {PointerEvent} event */
  up(event) {
    this.pointers.delete(event.pointerId);
    this.mode = this.pointers.size ? this.mode : "";
  }

  /** @param {WheelEvent} event */
  wheel(event) {
    event.preventDefault();
    const notches = Math.sign(event.deltaY) * Math.min(3, Math.max(1, Math.abs(event.deltaY) / 100));
    if (event.ctrlKey) this.view.zoomBy(event.deltaY < 0 ? 1.15 : 1 / 1.15, this.place(event));
    else if (this.enabled && event.shiftKey) this.needle.setAngle(this.needle.angle - notches);
    else if (this.enabled) this.needle.setDepth(this.needle.depth + WHEEL * notches);
    this.act("moved");
  }

  /** @param {KeyboardEvent} event @param {boolean} pressed */
  key(event, pressed) {
    this.slow = event.shiftKey;
    if (!pressed) {
      this.held.delete(event.code);
      return;
    }
    const target = /** @type {HTMLElement} */ (event.target);
    const typing = target.matches("input:not([type=checkbox]):not([type=radio]), select, textarea");
    if (typing || event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    if (HELD[event.code] && !target.matches("input[type=radio]")) {
      this.held.add(event.code);
      event.preventDefault();
      return;
    }
    if (target.matches("button, summary, a") && (event.key === " " || event.key === "Enter")) return;
    const action = ACTIONS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (action && !event.repeat) {
      event.preventDefault();
      this.act(action);
    }
  }

  /**
   * Move the needle by what is held.
   * @param {number} dt s
   */
  tick(dt) {
    let [push, turn, slide] = [0, 0, 0];
    for (const code of this.held) {
      const [p, t, s] = HELD[code] ?? [0, 0, 0];
      push += p * (this.slow ? SLOW_PUSH : PUSH);
      turn += t * (this.slow ? SLOW_TURN : TURN);
      slide += s * SLIDE;
    }
    for (const pad of navigator.getGamepads?.() ?? []) {
      if (!pad?.connected) continue;
      const axis = (/** @type {number} */ k) => (Math.abs(pad.axes[k] ?? 0) > DEAD ? pad.axes[k] : 0);
      push += 2 * PUSH * axis(1);
      slide += SLIDE * axis(0);
      turn -= 2 * TURN * axis(2);
      pad.buttons.forEach((button, k) => {
        if (button.pressed && !this.pressed.has(k) && PAD_ACTIONS[k]) this.act(PAD_ACTIONS[k]);
        if (button.pressed) this.pressed.add(k);
        else this.pressed.delete(k);
      });
    }
    if (!this.enabled || !(push || turn || slide)) return;
    if (push) this.needle.setDepth(this.needle.depth + push * dt);
    if (turn) this.needle.setAngle(this.needle.angle + turn * dt);
    if (slide) this.needle.setEntry(this.needle.entry[0] + slide * dt);
    this.act("moved");
  }

  /** Hold a key from a button on the screen. @param {string} code @param {boolean} on */
  hold(code, on) {
    if (on) this.held.add(code);
    else this.held.delete(code);
  }
}

/** @type {Record<string, string>} */
export const ACTIONS = {
  " ": "reset", c: "freeze", i: "invert", "+": "zoom-in", "=": "zoom-in", "-": "zoom-out", 0: "fit",
  m: "mesh", a: "arrows", t: "heat", g: "guide", 1: "model-0", 2: "model-1", 3: "model-2", 4: "model-3", k: "compare",
  e: "exercise", x: "abandon", n: "next-exercise", "?": "help", l: "sessions",
};
/** @type {Record<number, string>} */
const PAD_ACTIONS = { 0: "exercise", 1: "reset", 2: "freeze", 3: "next-exercise" };
