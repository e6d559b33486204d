// The engine without a document: it keeps, goes back, changes models, and a film of it shows what happened.

import assert from "node:assert/strict";
import { test } from "node:test";

import { digest, sha256 } from "../../src/echospline/page/static/bytes.js";
import { Film } from "../../src/echospline/page/static/film.js";
import { Attempt, landmarksOf, posesOf } from "../../src/echospline/page/static/training.js";
import { EXERCISE, core, engine } from "../node/made_pack.mjs";
import { createHash } from "node:crypto";

const LOOK = { gain: 0, timeGain: [0, 0, 0, 0, 0, 0], dynamicRange: 60, invert: false };
const hand = (k) => ({ entry: [8, 0], tip: k < 90 ? [8 + k / 15, k / 10] : [14, 9] });

/** @param {any} made @param {number} steps */
function insert(made, steps, attempt = null) {
  for (let k = 0; k < steps; ++k) {
    const pose = made.step(hand(k));
    if (attempt) attempt.add(pose, attempt.places.map((at, i) => at + made.displacementAt(attempt.places)[i]));
  }
}

test("at rest the picture is the recorded one", async () => {
  const made = await engine();
  assert.deepEqual(Array.from(made.grey()), Array.from(made.pack.array("pixels")));
});

test("the needle lags behind the hand and arrives", async () => {
  const made = await engine();
  made.step({ entry: [8, 0], tip: [12, 6] });
  assert.ok(made.pose.tip[1] < 3);
  for (let k = 0; k < 120; ++k) made.step({ entry: [8, 0], tip: [12, 6] });
  assert.ok(Math.hypot(made.pose.tip[0] - 12, made.pose.tip[1] - 6) < 0.01);
});

test("a state that was saved is come back to, bit for bit", async () => {
  const made = await engine();
  insert(made, 60);
  const saved = made.save(), then = Array.from(made.grey());
  insert(made, 100);
  assert.notDeepEqual(Array.from(made.grey()), then);
  made.load(saved);
  assert.deepEqual(Array.from(made.grey()), then);
});

test("reset is rest", async () => {
  const made = await engine();
  insert(made, 90);
  made.reset();
  assert.deepEqual(Array.from(made.displacementAt([10, 5, 20, 8])), [0, 0, 0, 0]);
  assert.deepEqual(Array.from(made.grey()), Array.from(made.pack.array("pixels")));
});

test("another model begins with the needle where it is, and moves tissue otherwise", async () => {
  const made = await engine();
  insert(made, 120);
  const before = Array.from(made.displacementAt([14, 9])), { tip } = made.pose;
  made.choose("elastic");
  assert.deepEqual(made.pose.tip, tip);
  const after = Array.from(made.displacementAt([14, 9]));
  assert.ok(Math.hypot(...after) > 0.1 && Math.hypot(after[0] - before[0], after[1] - before[1]) > 0.01);
  assert.throws(() => made.choose("none"), /has no model/);
  assert.equal(made.model.name, "elastic", "and stays with what it has");
});

test("a film of an attempt shows every moment as it was, forwards and backwards", async () => {
  const made = await engine(), attempt = new Attempt(EXERCISE, 120, "tps", false, "", new Date(0)), pictures = new Map();
  for (let k = 0; k < 620; ++k) {
    const pose = made.step(hand(k % 200));
    attempt.add(pose, landmarksOf(EXERCISE));
    if ([99, 300, 619].includes(k)) pictures.set(k + 1, Array.from(made.grey()));
  }
  const film = new Film(made, posesOf(attempt.session("finished", 1, { version: "", core: "", title: "", pack: "" })), null, 120);
  for (const row of [620, 100, 301, 100, 620]) {
    film.seek(row);
    assert.deepEqual(Array.from(made.grey()), pictures.get(row), `row ${row}`);
  }
  film.seek(0);
  assert.deepEqual(Array.from(made.grey()), Array.from(made.pack.array("pixels")));
  assert.equal(film.expert(), null);
});

test("an attempt that is traced again watches the same places", async () => {
  const made = await engine(), attempt = new Attempt(EXERCISE, 120, "tps", false, "", new Date(0));
  insert(made, 150, attempt);
  const again = made.retrace("tps", attempt.trace.poses, 120, attempt.places);
  assert.deepEqual(Array.from(again), attempt.watched);
});

test("gain brightens, the time gain where it is set, and inversion inverts", async () => {
  const made = await engine(), mean = (colours, from, to) => colours.slice(4 * 64 * from, 4 * 64 * to).reduce((sum, value, k) => sum + (k % 4 === 3 ? 0 : value), 0);
  const plain = made.draw(LOOK).slice(), bright = made.draw({ ...LOOK, gain: 6 }).slice(), deep = made.draw({ ...LOOK, timeGain: [0, 0, 0, 0, 0, 12] }).slice();
  const inverted = made.draw({ ...LOOK, invert: true }).slice();
  assert.ok(mean(bright, 0, 40) > mean(plain, 0, 40));
  assert.equal(mean(deep, 0, 20), mean(plain, 0, 20));
  assert.ok(mean(deep, 35, 40) > mean(plain, 35, 40));
  assert.ok(plain.every((value, k) => k % 4 === 3 ? value === 255 : value + inverted[k] === 255));
  assert.ok(plain.every((value, k) => k % 4 === 3 || value === made.grey()[k >> 2]), "gain 0 shows what was recorded");
});

test("the name of bytes is their SHA-256", () => {
  for (const bytes of [new Uint8Array(0), new TextEncoder().encode("abc"), new Uint8Array(core)]) {
    assert.equal(sha256(bytes), createHash("sha256").update(bytes).digest("hex"));
  }
  for (const length of [55, 56, 63, 64, 65]) assert.equal(sha256(new Uint8Array(length).fill(7)), createHash("sha256").update(new Uint8Array(length).fill(7)).digest("hex"));
});

test("the browser's own digest gives the same name", async () => {
  const bytes = new Uint8Array(core);
  assert.equal(await digest(bytes), sha256(bytes));
});
