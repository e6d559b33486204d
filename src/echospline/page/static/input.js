// Mouse, touch, keys and gamepad become actions; nothing here draws or steps.

import { bodyArea } from "./body.js";
import { lowered, turnedDown } from "./probe.js";
import { axisOf, helpsOf, isOut, planeOfState, steerable } from "./state.js";
import { viewOf } from "./view.js";

/** @import { Action, State } from "./state.js" */
/** @import { Point } from "./scene.js" */

const PUSH_RATE = 10, SLOW_PUSH = 2.5; // mm/s while a key is held, with Shift
const TURN_RATE = 25, SLOW_TURN = 6; // degrees/s
const SLIDE_RATE = 15; // mm/s of the entry while the needle is out
const WHEEL = 0.5; // mm a notch
const NEAR_SURFACE = 5; // mm; a press this near to the skin chooses the entry
const DEAD = 0.15; // of a gamepad's stick
const CURSOR = 60; // CSS pixels/s of the marks' cursor under arrow keys

const PROBE_SLIDE = 12, PROBE_TURN = 25; // mm/s and degrees/s of the probe under keys
const BODY_TURN = 0.5; // degrees of the probe a CSS pixel of a drag on the small drawing

/** What held keys do: [push, turn, slide, head]. @type {Record<string, [number, number, number, number]>} */
const HELD = {
  ArrowDown: [1, 0, 0, 0], ArrowUp: [-1, 0, 0, 0], ArrowLeft: [0, 1, 0, 0], ArrowRight: [0, -1, 0, 0], BracketLeft: [0, 0, -1, 0], BracketRight: [0, 0, 1, 0],
  Comma: [0, 0, 0, -1], Period: [0, 0, 0, 1],
};
/** What held keys do with the probe, plain and with Shift. @type {Record<string, [Record<string, number>, Record<string, number>]>} */
const PROBE_HELD = {
  KeyA: [{ slide: -1 }, { turn: -1 }], KeyD: [{ slide: 1 }, { turn: 1 }], KeyW: [{ across: -1 }, { tilt: -1 }], KeyS: [{ across: 1 }, { tilt: 1 }],
  KeyQ: [{ rock: 1 }, { rock: 1 }], KeyR: [{ rock: -1 }, { rock: -1 }],
};
/** Keys and what they ask for. @type {Record<string, string>} */
export const KEYS = {
  " ": "reset", c: "freeze", f: "flip", i: "invert", "+": "zoom-in", "=": "zoom-in", "-": "zoom-out", 0: "fit", g: "guide", o: "rings", u: "readouts",
  1: "model-0", 2: "model-1", 3: "model-2", 4: "model-3", m: "caliper", t: "note", Delete: "clear", p: "picture", v: "clip", e: "exercise", n: "another",
  "?": "help", l: "sessions", k: "body", j: "motion", x: "along", z: "across", Enter: "mark", Escape: "escape",
};
/** @type {Record<number, string>} */
const BUTTONS = { 0: "exercise", 1: "reset", 2: "freeze", 3: "another" };

/**
 * Whether a key belongs to the control that has the focus: Space and Enter to whatever they press, arrows to what they move, everything to
 * a field of text.
 * @param {{ tag: string, type: string }} control @param {string} key
 */
export function ownKey({ tag, type }, key) {
  if (tag === "textarea" || (tag === "input" && !["checkbox", "radio", "range", "button", "submit", "file"].includes(type))) return true;
  const pressed = key === " " || key === "Enter", arrow = key.startsWith("Arrow") || ["Home", "End", "PageUp", "PageDown"].includes(key);
  if (tag === "select") return true;
  if (tag === "input" && (type === "range" || type === "radio")) return pressed || arrow;
  return pressed && ["button", "summary", "a", "input", "label"].includes(tag);
}

/**
 * Actions of a drag with one pointer.
 * @param {State} state @param {string} mode @param {Point} before @param {Point} now CSS pixels @returns {Action[]}
 */
export function dragged(state, mode, before, now) {
  const view = viewOf(state.view, state.extent), dx = now[0] - before[0], dy = now[1] - before[1], side = view.flip ? -1 : 1;
  if (mode === "probe") {
    const wide = (state.high[0] - state.low[0]) / (0.7 * (bodyArea(state).right - bodyArea(state).left));
    return [{ do: "probe", slide: dx * wide, across: -dy * wide }];
  }
  if (mode === "probe-turn") return [{ do: "probe", turn: BODY_TURN * dx, tilt: -BODY_TURN * dy }];
  if (mode === "pan") return [{ do: "pan", by: [dx, dy] }];
  if (mode === "measure") return [{ do: "measure", a: state.drawing?.a ?? view.toMm(before), b: view.toMm(now) }];
  if (mode === "turn") {
    const [ex, ey] = view.toScreen(state.held ? seenEntry(state) : state.needle.entry);
    return [{ do: "turn", degrees: side * handed(state) * degreesBetween([before[0] - ex, before[1] - ey], [now[0] - ex, now[1] - ey]) }];
  }
  if (mode !== "push") return [];
  const [ax, ay] = turnedDown(planeOfState(state), axisOf(state.needle)), long = Math.hypot(ax, ay);
  const [ux, uy] = long < 0.2 ? [0, 1] : [ax / long, ay / long]; // across the picture: down is in
  return [{ do: "push", mm: (side * dx * ux + dy * uy) / view.scale }];
}

/** Where the needle enters, as the picture sees it. @param {State} state */
function seenEntry(state) {
  return lowered(planeOfState(state), state.needle.entry);
}

/** 1, or -1 where the picture sees the needle from behind. @param {State} state */
export function handed(state) {
  const h = (state.needle.heading * Math.PI) / 180;
  return state.held && turnedDown(planeOfState(state), [Math.cos(h), 0, Math.sin(h)])[0] < 0 ? -1 : 1;
}

/** Actions of a press: near the skin it chooses the entry, inside it aims. @param {State} state @param {Point} at CSS pixels @returns {Action[]} */
export function pressed(state, at) {
  const [x, y] = viewOf(state.view, state.extent).toMm(at);
  if (!steerable(state) || !isOut(state.needle)) return [];
  if (y < Math.max(state.extent.y0, 0) + NEAR_SURFACE) return [{ do: "entry", at: [x, state.held ? 0 : y] }];
  return state.needle.depth === 0 ? [{ do: "aim", at: [x, y] }] : [];
}

/** Actions of two pointers, of which one moved: turn and zoom. @param {State} state @param {Point} before @param {Point} now @param {Point} other @returns {Action[]} */
export function pinched(state, before, now, other) {
  const a = /** @type {Point} */ ([before[0] - other[0], before[1] - other[1]]), b = /** @type {Point} */ ([now[0] - other[0], now[1] - other[1]]);
  const side = state.view.flip ? -1 : 1;
  return [
    { do: "turn", degrees: side * handed(state) * degreesBetween(a, b) },
    { do: "zoom", factor: Math.hypot(...b) / Math.max(1, Math.hypot(...a)), about: [(now[0] + other[0]) / 2, (now[1] + other[1]) / 2] },
  ];
}

/** @param {Point} a @param {Point} b */
function degreesBetween(a, b) {
  const turned = Math.atan2(b[1], b[0]) - Math.atan2(a[1], a[0]);
  return (Math.atan2(Math.sin(turned), Math.cos(turned)) * 180) / Math.PI;
}

/** Whether a place of the screen is the small drawing, which then takes the probe. @param {State} state @param {Point} at */
function onBody(state, at) {
  const area = bodyArea(state);
  return state.held !== null && helpsOf(state).body && at[0] > area.left && at[0] < area.right && at[1] > area.top && at[1] < area.bottom;
}

export class Input {
  /**
   * @param {HTMLElement} stage
   * @param {() => State} state
   * @param {(action: Action) => void} act
   * @param {(command: string) => void} command what is not a change of the state alone
   */
  constructor(stage, state, act, command) {
    this.stage = stage;
    this.state = state;
    this.act = act;
    this.command = command;
    /** @type {Set<string>} */
    this.held = new Set();
    this.slow = false;
    /** @type {Map<number, Point>} */
    this.pointers = new Map();
    this.mode = "";
    /** Pointers that hold the probe in the small drawing, and how. @type {Map<number, string>} */
    this.onBody = new Map();
    /** Where the stage was when a press began: to ask costs a layout. */
    this.box = stage.getBoundingClientRect();
    /** @type {Set<number>} */
    this.padPressed = new Set();
    stage.addEventListener("pointerdown", (event) => this.down(event));
    stage.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) stage.addEventListener(name, (event) => this.up(/** @type {PointerEvent} */ (event)));
    stage.addEventListener("contextmenu", (event) => event.preventDefault());
    stage.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    addEventListener("keydown", (event) => this.key(event));
    addEventListener("keyup", (event) => {
      this.slow = event.shiftKey;
      this.held.delete(event.code);
    });
    addEventListener("blur", () => this.held.clear());
  }

  /** @param {PointerEvent | WheelEvent} event @returns {Point} */
  place(event) {
    if (this.pointers.size === 0) this.box = this.stage.getBoundingClientRect();
    return [event.clientX - this.box.left, event.clientY - this.box.top];
  }

  /** @param {PointerEvent} event */
  down(event) {
    if (/** @type {HTMLElement} */ (event.target).closest("button, input, select")) return;
    const at = this.place(event), state = this.state();
    this.stage.setPointerCapture(event.pointerId);
    this.stage.focus({ preventScroll: true });
    this.pointers.set(event.pointerId, at);
    if (onBody(state, at)) {
      this.onBody.set(event.pointerId, event.shiftKey || event.button === 2 ? "probe-turn" : "probe");
      return;
    }
    if (this.pointers.size - this.onBody.size > 1) this.mode = "two";
    else if (event.button === 1 || event.altKey) this.mode = "pan";
    else if (state.tool === "note") {
      this.mode = "";
      this.act({ do: "cursor", at: viewOf(state.view, state.extent).toMm(at) });
      this.command("write");
    } else if (state.tool === "caliper") this.mode = "measure";
    else if (event.button === 2 || event.shiftKey) this.mode = "turn";
    else {
      this.mode = "push";
      for (const action of pressed(state, at)) this.act(action);
    }
  }

  /** @param {PointerEvent} event */
  move(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const now = this.place(event), others = [...this.pointers].filter(([id]) => id !== event.pointerId && !this.onBody.has(id)), body = this.onBody.get(event.pointerId);
    this.pointers.set(event.pointerId, now);
    if (body) {
      for (const action of dragged(this.state(), body, before, now)) this.act(action);
      return;
    }
    const made = this.mode === "two" && others.length ? pinched(this.state(), before, now, others[0][1]) : dragged(this.state(), this.mode, before, now);
    for (const action of made) this.act(action);
  }

  /** @param {PointerEvent} event */
  up(event) {
    this.pointers.delete(event.pointerId);
    if (this.onBody.delete(event.pointerId)) return;
    if (this.mode === "measure") this.act({ do: "measured" });
    this.mode = this.pointers.size ? this.mode : "";
  }

  /** @param {WheelEvent} event */
  wheel(event) {
    event.preventDefault();
    const notches = Math.sign(event.deltaY) * Math.min(3, Math.max(1, Math.abs(event.deltaY) / 100));
    if (event.ctrlKey) this.act({ do: "zoom", factor: event.deltaY < 0 ? 1.15 : 1 / 1.15, about: this.place(event) });
    else if (event.shiftKey) this.act({ do: "turn", degrees: -notches });
    else this.act({ do: "push", mm: WHEEL * notches });
  }

  /** @param {KeyboardEvent} event */
  key(event) {
    this.slow = event.shiftKey;
    const target = /** @type {HTMLInputElement} */ (event.target);
    if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    if (ownKey({ tag: target.tagName?.toLowerCase() ?? "", type: target.type ?? "" }, event.key)) return;
    if (HELD[event.code] || (this.state().held && PROBE_HELD[event.code])) {
      this.held.add(event.code);
      event.preventDefault();
      return;
    }
    const wanted = KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!wanted || event.repeat || (wanted === "mark" && this.state().tool === "needle")) return;
    event.preventDefault();
    this.command(wanted);
  }

  /** Act on what is held. @param {number} dt s */
  tick(dt) {
    let [push, turn, slide, head] = [0, 0, 0, 0];
    /** @type {Record<string, number>} */
    const probe = {};
    for (const code of this.held) {
      for (const [name, way] of Object.entries(PROBE_HELD[code]?.[Number(this.slow)] ?? {})) probe[name] = (probe[name] ?? 0) + way * dt * (name === "slide" || name === "across" ? PROBE_SLIDE : PROBE_TURN);
      const [p, t, s, h] = HELD[code] ?? [0, 0, 0, 0];
      head += h * (this.slow ? SLOW_TURN : TURN_RATE);
      push += p * (this.slow ? SLOW_PUSH : PUSH_RATE);
      turn += t * (this.slow ? SLOW_TURN : TURN_RATE);
      slide += s * SLIDE_RATE;
    }
    if (this.state().tool !== "needle" && (push || turn)) {
      const step = (CURSOR * dt * (this.slow ? 0.25 : 1)) / viewOf(this.state().view, this.state().extent).scale;
      this.act({ do: "cursor", by: [-Math.sign(turn) * step * (this.state().view.flip ? -1 : 1), Math.sign(push) * step] });
      [push, turn] = [0, 0];
    }
    for (const pad of navigator.getGamepads?.() ?? []) {
      if (!pad?.connected) continue;
      const axis = (/** @type {number} */ k) => (Math.abs(pad.axes[k] ?? 0) > DEAD ? pad.axes[k] : 0);
      push += 2 * PUSH_RATE * axis(1);
      slide += SLIDE_RATE * axis(0);
      turn -= 2 * TURN_RATE * axis(2);
      const pressed = (/** @type {number} */ k) => Number(pad.buttons[k]?.pressed ?? false);
      const hand = { across: PROBE_SLIDE * axis(3) + PROBE_SLIDE * (pressed(13) - pressed(12)), slide: PROBE_SLIDE * (pressed(15) - pressed(14)), turn: PROBE_TURN * (pressed(5) - pressed(4)), tilt: PROBE_TURN * (pressed(7) - pressed(6)) };
      for (const [name, way] of Object.entries(hand)) if (way) probe[name] = (probe[name] ?? 0) + way * dt;
      pad.buttons.forEach((button, k) => {
        if (button.pressed && !this.padPressed.has(k) && BUTTONS[k]) this.command(BUTTONS[k]);
        if (button.pressed) this.padPressed.add(k);
        else this.padPressed.delete(k);
      });
    }
    const side = this.state().view.flip ? -1 : 1;
    if (push) this.act({ do: "push", mm: push * dt });
    if (turn) this.act({ do: "turn", degrees: side * handed(this.state()) * turn * dt });
    if (head) this.act({ do: "head", degrees: head * dt });
    if (slide) this.act(this.slow ? { do: "slide", mm: 0, across: slide * dt } : { do: "slide", mm: side * slide * dt });
    if (this.state().held && Object.keys(probe).length) this.act({ do: "probe", ...probe });
  }

  /** Hold a key from a button on the screen. @param {string} code @param {boolean} on */
  hold(code, on) {
    if (on) this.held.add(code);
    else this.held.delete(code);
  }
}
