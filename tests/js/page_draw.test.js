// The draw list and what the renderer does with it, on a canvas that records every call.

import assert from "node:assert/strict";
import { test } from "node:test";

import { clock, drawList } from "../../src/echospline/page/static/draw_list.js";
import { Renderer } from "../../src/echospline/page/static/renderer.js";
import { next } from "../../src/echospline/page/static/state.js";
import { viewOf } from "../../src/echospline/page/static/view.js";
import { wordsOf } from "../../src/echospline/page/static/words.js";
import { freshState } from "../node/made_pack.mjs";

const say = wordsOf("en"), after = (state, ...actions) => actions.reduce(next, state);
const live = (more = {}) => ({
  entry: [8, 0], tip: [13, 5], speed: 10, watched: [18.5, 9.25, 11, 5], expert: null, motion: [10, 5, 10, 5, 12, 6, 13, 8],
  picture: { columns: 64, rows: 40, spacing: [0.5, 0.5], origin: [0, 0] }, ...more,
});
const texts = (list) => list.filter((command) => command.draw === "text").map((command) => command.text);
const circles = (list, ink) => list.filter((command) => command.draw === "circle" && command.ink === ink);

/** A canvas that writes down what is asked of it. */
function recorder() {
  const calls = [], state = {};
  const context = new Proxy(state, {
    get: (_, name) => name in state ? state[name] : (...args) => {
      calls.push([name, ...args]);
      return name === "createLinearGradient" ? { addColorStop: () => {} } : undefined;
    },
    set: (_, name, value) => {
      calls.push([`${String(name)} =`, value]);
      return true;
    },
  });
  return { calls, canvas: { width: 0, height: 0, getContext: () => context } };
}

/** @param {any[]} list @param {number} ratio */
function rendered(list, ratio = 1) {
  const big = recorder(), small = recorder();
  const renderer = new Renderer(big.canvas, (width, height) => Object.assign(small.canvas, { width, height }));
  renderer.resize(800, 600, ratio);
  renderer.picture({ width: 64, height: 40, data: new Uint8ClampedArray(4 * 64 * 40) });
  renderer.draw(list);
  return { big, small };
}

test("a ring lies where the deformed target is, exactly", () => {
  const state = freshState(), view = viewOf(state.view, state.extent), [ring] = circles(drawList(state, live(), say), "#ffd166");
  assert.deepEqual(ring.at, view.toScreen([18.5, 9.25]));
  assert.equal(ring.r, 2 * view.scale);
});

test("the picture's pixels are squares about their centres", () => {
  const state = freshState(), view = viewOf(state.view, state.extent), picture = drawList(state, live(), say).find((command) => command.draw === "picture");
  assert.ok(Math.abs(picture.left - view.toScreen([-0.25, 0])[0]) < 1e-9);
  assert.ok(Math.abs(picture.width - 32 * view.scale) < 1e-9 && Math.abs(picture.height - 20 * view.scale) < 1e-9);
});

test("an examination draws no ring, no guide, no number: the same as if there were no exercise", () => {
  const examined = after(freshState(), { do: "examination" }, { do: "start", lot: 0 }), list = drawList(examined, live(), say);
  assert.equal(circles(list, "#ffd166").length + circles(list, "#ff7b7b").length, 0);
  assert.equal(list.filter((command) => command.draw === "line" && command.dash).length, 0);
  assert.ok(!texts(list).some((text) => /mm\/s|in \d|to target/.test(text)));
  const moved = drawList(examined, live({ watched: [3, 3, 4, 4] }), say);
  assert.deepEqual(moved, list, "nothing of it depends on where the target is");
  assert.ok(texts(list).includes("0:02"), "but time is shown");
});

test("a target that no picture shows is seen in an examination until the needle is in, an imaged one never", () => {
  const examined = after(freshState(), { do: "examination" }, { do: "start", lot: 0 }), out = live({ tip: [8, 0] });
  assert.equal(circles(drawList(examined, out, say), "#ffd166").length, 1);
  assert.equal(circles(drawList(examined, out, say), "#ff7b7b").length, 0);
  examined.run.exercise = { ...examined.run.exercise, target: { ...examined.run.exercise.target, imaged: true } };
  assert.equal(circles(drawList(examined, out, say), "#ffd166").length, 0);
});

test("helps are drawn or not, one by one", () => {
  const of = (name) => drawList(after(freshState(), { do: "help", name }), live(), say);
  assert.equal(circles(of("rings"), "#ffd166").length, 0);
  assert.ok(!of("guide").some((command) => command.draw === "line" && command.dash?.[0] === 7));
  assert.ok(!texts(of("readouts")).some((text) => text.includes("mm/s")));
});

test("motion is drawn from where tissue lay to where it is, and only where it has moved", () => {
  const state = after(freshState(), { do: "help", name: "motion" }), view = viewOf(state.view, state.extent), drawn = drawList(state, live(), say).filter((command) => command.ink === "#ffb36b");
  assert.equal(drawn.length, 2);
  assert.deepEqual(drawn[0].points, [view.toScreen([12, 6]), view.toScreen([13, 8])]);
  assert.equal(drawList(freshState(), live(), say).filter((command) => command.ink === "#ffb36b").length, 0);
});

test("flipping mirrors everything but the writing, and the dot goes to the other side", () => {
  const state = freshState(), flipped = after(state, { do: "flip" }), [plain, mirrored] = [state, flipped].map((s) => viewOf(s.view, s.extent));
  for (const mm of [[3, 2], [20, 15]]) {
    const middle = (plain.toScreen([state.extent.x0, 0])[0] + plain.toScreen([state.extent.x1, 0])[0]) / 2;
    assert.ok(Math.abs(plain.toScreen(mm)[0] + mirrored.toScreen(mm)[0] - 2 * middle) < 1e-9);
  }
  const dot = (list) => circles(list, "#5fd4e0").find((command) => command.width === 0).at[0];
  assert.ok(dot(drawList(state, live(), say)) < 200 && dot(drawList(flipped, live(), say)) > 600);
});

test("a caliper says its length in millimetres whatever the zoom", () => {
  for (const factor of [1, 3]) {
    const state = after(freshState(), { do: "zoom", factor }, { do: "measure", a: [4, 4], b: [7, 8] }, { do: "measured" });
    assert.ok(texts(drawList(state, live(), say)).includes("1: 5.0 mm"));
  }
});

test("names are drawn as text, whatever they hold", () => {
  const state = after(freshState(), { do: "note", at: [3, 3], text: "<img src=x onerror=alert(1)>" }), { big } = rendered(drawList(state, live(), say));
  assert.ok(big.calls.some(([name, text]) => name === "fillText" && text === "<img src=x onerror=alert(1)>"));
});

test("the expert's needle lies beside", () => {
  const list = drawList(freshState(), live({ expert: { entry: [5, 0], tip: [9, 9] } }), say), view = viewOf(freshState().view, freshState().extent);
  assert.ok(list.some((command) => command.draw === "line" && JSON.stringify(command.points) === JSON.stringify([view.toScreen([5, 0]), view.toScreen([9, 9])])));
});

test("every line of words exists in both languages", () => {
  for (const language of ["en", "de"]) assert.ok(texts(drawList(after(freshState(), { do: "freeze" }), live(), wordsOf(language))).length > 4);
});

test("the renderer leaves the canvas as it was: every save has its restore, dashes end", () => {
  const state = after(freshState(), { do: "measure", a: [4, 4], b: [7, 8] }, { do: "measured" });
  const { big, small } = rendered(drawList(state, live({ expert: { entry: [5, 0], tip: [9, 9] } }), say), 3), count = (name) => big.calls.filter(([called]) => called === name).length;
  assert.ok(count("save") > 0);
  assert.equal(count("save"), count("restore"));
  assert.deepEqual(big.calls.filter(([name]) => name === "setLineDash").at(-1), ["setLineDash", []]);
  assert.deepEqual([big.canvas.width, big.canvas.height], [2400, 1800]);
  assert.deepEqual([small.canvas.width, small.canvas.height], [64, 40]);
  assert.equal(big.calls.filter(([name]) => name === "drawImage").length, 1);
  assert.equal(big.calls.find(([name]) => name === "setTransform")[1], 3);
});

test("all that the list asks for is drawn, in its order", () => {
  const { big } = rendered([
    { draw: "text", at: [1, 2], text: "first", ink: "#fff" }, { draw: "clip", area: { left: 0, top: 0, right: 9, bottom: 9 } },
    { draw: "circle", at: [5, 5], r: 2, ink: "#fff", width: 1 }, { draw: "clip", area: null }, { draw: "text", at: [1, 2], text: "last", ink: "#fff" },
  ]);
  const order = big.calls.map(([name, first]) => (name === "fillText" ? first : name)).filter((name) => ["first", "last", "clip", "arc", "restore"].includes(name));
  assert.deepEqual(order, ["first", "clip", "arc", "restore", "last"]);
});

test("a countdown never shows more than is left in whole seconds", () => assert.deepEqual([0, 0.2, 59.5, 60, 119.01].map(clock), ["0:00", "0:01", "1:00", "1:00", "2:00"]));
