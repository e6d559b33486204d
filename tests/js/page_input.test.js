// From presses, drags and keys to actions.

import assert from "node:assert/strict";
import { test } from "node:test";

import { KEYS, dragged, ownKey, pinched, pressed } from "../../src/echospline/page/static/input.js";
import { next } from "../../src/echospline/page/static/state.js";
import { viewOf } from "../../src/echospline/page/static/view.js";
import { freshState } from "../node/made_pack.mjs";

const after = (state, ...actions) => actions.reduce(next, state);
const screen = (state, mm) => viewOf(state.view, state.extent).toScreen(mm);

test("a press near the skin chooses the entry, a press deeper aims, and neither moves a needle that is in", () => {
  const state = freshState();
  assert.deepEqual(pressed(state, screen(state, [20, 1]))[0].do, "entry");
  const aimed = after(state, ...pressed(state, screen(state, [8, 15])));
  assert.ok(Math.abs(aimed.needle.angle - 90) < 1e-9);
  assert.deepEqual(pressed(after(state, { do: "push", mm: 5 }), screen(state, [20, 1])), []);
});

test("a drag along the needle pushes as far as the pointer went, flipped or zoomed", () => {
  for (const actions of [[], [{ do: "flip" }], [{ do: "zoom", factor: 2 }], [{ do: "flip" }, { do: "zoom", factor: 3 }]]) {
    const state = after(freshState(), { do: "angle", degrees: 60 }, ...actions), way = [Math.cos(Math.PI / 3), Math.sin(Math.PI / 3)];
    const from = screen(state, [10, 5]), to = screen(state, [10 + 4 * way[0], 5 + 4 * way[1]]), [push] = dragged(state, "push", from, to);
    assert.equal(push.do, "push");
    assert.ok(Math.abs(push.mm - 4) < 1e-9);
    const [across] = dragged(state, "push", from, [from[0] + (to[1] - from[1]), from[1] - (to[0] - from[0])]);
    assert.ok(Math.abs(across.mm) < 1e-9, "across the needle nothing is pushed");
  }
});

test("a turning drag turns the needle under the pointer", () => {
  for (const actions of [[], [{ do: "flip" }]]) {
    const state = after(freshState(), { do: "angle", degrees: 60 }, ...actions), at = (degrees) => screen(state, [8 + 9 * Math.cos((degrees * Math.PI) / 180), 9 * Math.sin((degrees * Math.PI) / 180)]);
    const [turn] = dragged(state, "turn", at(60), at(75));
    assert.ok(Math.abs(turn.degrees - 15) < 1e-9);
  }
});

test("two fingers zoom about their middle and turn", () => {
  const [turn, zoom] = pinched(freshState(), [300, 200], [200, 300], [200, 200]);
  assert.ok(Math.abs(turn.degrees - 90) < 1e-9);
  assert.ok(Math.abs(zoom.factor - 1) < 1e-9);
  assert.deepEqual(zoom.about, [200, 250]);
  assert.equal(pinched(freshState(), [300, 200], [400, 200], [200, 200])[1].factor, 2);
});

test("a measuring drag goes from press to pointer in millimetres", () => {
  const state = after(freshState(), { do: "tool", name: "caliper" }), [action] = dragged(state, "measure", screen(state, [3, 4]), screen(state, [6, 8]));
  assert.ok(Math.hypot(action.a[0] - 3, action.a[1] - 4, action.b[0] - 6, action.b[1] - 8) < 1e-9);
});

test("a control with the focus keeps the keys that are its own", () => {
  for (const type of ["checkbox", "radio", "range"]) assert.ok(ownKey({ tag: "input", type }, " "), `Space on a ${type} is its own`);
  assert.ok(ownKey({ tag: "button", type: "button" }, " ") && ownKey({ tag: "button", type: "button" }, "Enter"));
  assert.ok(ownKey({ tag: "input", type: "text" }, "c") && ownKey({ tag: "select", type: "" }, "ArrowDown"));
  assert.ok(ownKey({ tag: "input", type: "range" }, "ArrowDown") && ownKey({ tag: "input", type: "radio" }, "ArrowUp"));
  assert.ok(!ownKey({ tag: "section", type: "" }, " ") && !ownKey({ tag: "button", type: "button" }, "ArrowDown") && !ownKey({ tag: "input", type: "checkbox" }, "c"));
});

test("no key asks for two things", () => {
  const keys = Object.keys(KEYS);
  assert.equal(new Set(keys.map((key) => key.toLowerCase())).size, keys.length);
});
