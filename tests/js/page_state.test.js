// The page's state: what a person does changes it, and nothing else does.

import assert from "node:assert/strict";
import { test } from "node:test";

import { deepestOf, helpsOf, isOut, next, secondsLeft, tipOf } from "../../src/echospline/page/static/state.js";
import { viewOf } from "../../src/echospline/page/static/view.js";
import { freshState } from "../node/made_pack.mjs";

/** @param {any} state @param {any[]} actions */
const after = (state, ...actions) => actions.reduce(next, state);

test("a state is never changed in place", () => {
  const state = freshState(), frozen = deepFreeze(structuredClone({ ...state }));
  for (const action of [
    { do: "push", mm: 5 }, { do: "turn", degrees: 3 }, { do: "zoom", factor: 2 }, { do: "gain", dB: 4 }, { do: "timeGain", k: 2, dB: 3 }, { do: "start", lot: 0.5 },
    { do: "cursor" }, { do: "tool", name: "caliper" }, { do: "note", at: [3, 3], text: "a" }, { do: "flip" }, { do: "theme" },
  ]) assert.notEqual(next(frozen, action), frozen);
});

test("an action that is not known is refused", () => assert.throws(() => next(freshState(), { do: "nonsense" }), /expected an action/));

test("a needle stays in the picture, whatever is asked", () => {
  const { extent } = freshState();
  for (const degrees of [-80, -30, 0, 20, 60, 100]) {
    const state = after(freshState(), { do: "turn", degrees }, { do: "push", mm: 1e6 }), [x, y] = tipOf(state.needle);
    assert.ok(x >= extent.x0 && x <= extent.x1 && y >= extent.y0 && y <= extent.y1, `${x} ${y}`);
    assert.equal(after(state, { do: "push", mm: -1e6 }).needle.depth, 0);
  }
});

test("the entry moves only while the needle is out", () => {
  assert.equal(after(freshState(), { do: "enter", x: 12 }).needle.entry[0], 12);
  assert.equal(after(freshState(), { do: "push", mm: 5 }, { do: "enter", x: 12 }).needle.entry[0], 8);
  assert.equal(after(freshState(), { do: "enter", x: 1e9 }).needle.entry[0], freshState().extent.x1 - 1);
});

test("turning deep inside shortens the needle where the picture ends", () => {
  const deep = after(freshState(), { do: "push", mm: 1e6 }), turned = after(deep, { do: "angle", degrees: 20 });
  assert.ok(turned.needle.depth <= deepestOf(turned.needle, turned) + 1e-12);
});

test("an attempt begins with the needle out and counts its time", () => {
  const state = after(freshState(), { do: "push", mm: 4 }, { do: "start", lot: 0.5 });
  assert.ok(isOut(state.needle) && state.run);
  assert.equal(secondsLeft(state), 2);
  assert.equal(secondsLeft(after(state, { do: "stepped", steps: 120 })), 1);
  assert.equal(after(state, { do: "freeze" }).frozen, false, "an attempt cannot be frozen");
  assert.equal(after(state, { do: "model", name: "elastic" }).model, "tps", "nor change its model");
  assert.equal(after(state, { do: "choose", name: "other" }).chosen, "between");
  assert.equal(after(state, { do: "stop" }).run, null);
});

test("an examination shows no help, and an exercise can take help away", () => {
  const none = { guide: false, rings: false, readouts: false, motion: false, body: false };
  const examined = after(freshState(), { do: "examination" }, { do: "start", lot: 0 });
  assert.deepEqual(helpsOf(examined), none);
  assert.deepEqual(helpsOf(after(examined, { do: "help", name: "rings" })), none, "and it cannot be asked back");
  assert.notDeepEqual(helpsOf(freshState()), none);
  const strict = freshState();
  strict.exercises = [{ ...strict.exercises[0], help: false }];
  assert.deepEqual(helpsOf(after(strict, { do: "start", lot: 0 })), none);
});

test("the entry of an examination is free, fixed or drawn by lot", () => {
  const asked = (rule, lot) => after(freshState(), { do: "enter", x: 20 }, { do: "examination" }, { do: "entryRule", rule }, { do: "start", lot });
  assert.equal(asked("free", 0.5).needle.entry[0], 20);
  assert.equal(asked("fixed", 0.5).needle.entry[0], 8);
  const drawn = [0, 0.5, 1].map((lot) => asked("drawn", lot).needle.entry[0]);
  assert.ok(drawn[0] < drawn[1] && drawn[1] < drawn[2]);
  assert.equal(after(asked("drawn", 0.2), { do: "enter", x: 9 }).needle.entry[0], asked("drawn", 0.2).needle.entry[0], "and stays");
});

test("a replay cannot be steered, and stops at its end", () => {
  const { exercises } = freshState();
  const state = after(freshState(), { do: "replay", replay: { exercise: exercises[0], model: "tps", length: 100, events: [], expert: false } });
  assert.equal(after(state, { do: "push", mm: 3 }).needle.depth, 0);
  const ended = after(state, { do: "played", rows: 1000 });
  assert.deepEqual([ended.replay.at, ended.replay.paused], [100, true]);
  assert.equal(after(ended, { do: "pause" }).replay.at, 0, "played again from the start");
  assert.equal(after(state, { do: "scrub", at: 1e9 }).replay.at, 100);
  assert.equal(after(state, { do: "speed", value: 99 }).replay.speed, 1);
  assert.equal(after(state, { do: "leave" }).replay, null);
});

test("calipers measure, are limited in number, and too short ones are dropped", () => {
  const one = after(freshState(), { do: "measure", a: [1, 1], b: [4, 5] }, { do: "measured" });
  assert.deepEqual(one.calipers, [{ a: [1, 1], b: [4, 5] }]);
  assert.equal(after(freshState(), { do: "measure", a: [1, 1], b: [1.01, 1] }, { do: "measured" }).calipers.length, 0);
  let many = freshState();
  for (let k = 0; k < 9; ++k) many = after(many, { do: "measure", a: [1, 1], b: [4, 5 + k] }, { do: "measured" });
  assert.ok(many.calipers.length < 9);
  assert.equal(after(many, { do: "clear" }).calipers.length, 0);
});

test("a caliper is set by the keys as by the pointer", () => {
  const first = after(freshState(), { do: "tool", name: "caliper" }, { do: "mark" }, { do: "cursor", by: [3, 4] }, { do: "mark" }).calipers[0];
  assert.ok(Math.abs(Math.hypot(first.b[0] - first.a[0], first.b[1] - first.a[1]) - 5) < 1e-9, "Enter before any arrow marks the middle");
  const state = after(freshState(), { do: "tool", name: "caliper" }, { do: "cursor", at: [5, 5] }, { do: "mark" }, { do: "cursor", by: [3, 4] }, { do: "mark" });
  assert.deepEqual(state.calipers, [{ a: [5, 5], b: [8, 9] }]);
});

test("labels are cut to a length and empty ones are not written", () => {
  assert.equal(after(freshState(), { do: "note", at: [1, 1], text: "   " }).notes.length, 0);
  assert.equal(after(freshState(), { do: "note", at: [1, 1], text: "x".repeat(500) }).notes[0].text.length, 60);
});

test("millimetres and the screen are inverse, zoomed, panned or exchanged", () => {
  for (const actions of [[], [{ do: "flip" }], [{ do: "zoom", factor: 3, about: [200, 300] }, { do: "pan", by: [31, -17] }], [{ do: "flip" }, { do: "zoom", factor: 2 }], [{ do: "seen", mm: 12 }]]) {
    const state = after(freshState(), ...actions), view = viewOf(state.view, state.extent);
    for (const mm of [[0, 0], [13.3, 7.7], [30, 18]]) {
      const back = view.toMm(view.toScreen(mm));
      assert.ok(Math.hypot(back[0] - mm[0], back[1] - mm[1]) < 1e-9);
    }
  }
});

test("a point stays where it is when the picture is zoomed about it", () => {
  const state = freshState(), about = [260, 330], place = viewOf(state.view, state.extent).toMm(about);
  const zoomed = after(state, { do: "zoom", factor: 2.5, about }), now = viewOf(zoomed.view, zoomed.extent).toScreen(place);
  assert.ok(Math.hypot(now[0] - about[0], now[1] - about[1]) < 1e-9);
});

test("less depth shows the same tissue larger", () => {
  const [whole, half] = [freshState(), after(freshState(), { do: "seen", mm: 10 })].map((s) => viewOf(s.view, s.extent));
  assert.ok(half.scale >= whole.scale);
});

/** @param {any} value */
function deepFreeze(value) {
  if (value && typeof value === "object") Object.values(Object.freeze(value)).forEach(deepFreeze);
  return value;
}
