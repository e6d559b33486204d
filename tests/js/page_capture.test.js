// What leaves the page: pictures at a pace that a file can say.

import assert from "node:assert/strict";
import { test } from "node:test";

import { Reel } from "../../src/echospline/page/static/capture.js";

/** A reel whose picture k is grey of k, kept at times in ms. @param {number[]} times @param {number} [columns] @param {number} [rows] */
function reelOf(times, columns = 2, rows = 2) {
  const reel = new Reel();
  times.forEach((at, k) => reel.add(at, new Uint8ClampedArray(4 * columns * rows).fill(k), columns, rows));
  return reel;
}

test("an even pace holds the picture where nothing moved, and keeps every moment", () => {
  const moved = Array.from({ length: 16 }, (_, k) => (k * 1000) / 15), { frames, rate } = reelOf([...moved, 5000]).even();
  assert.ok(Math.abs(rate - 15) < 1e-9);
  assert.equal(frames.length, 76);
  frames.forEach(({ colours }, n) => assert.equal(colours[0], n <= 15 ? n : n < 75 ? 15 : 16, String(n)));
});

test("the screen's uneven pace neither drops nor doubles pictures", () => {
  const { frames } = reelOf(Array.from({ length: 60 }, (_, k) => (k * 1000) / 15 + (k % 2))).even();
  assert.deepEqual(frames.map(({ colours }) => colours[0]), Array.from({ length: 60 }, (_, k) => k));
});

test("large pictures come at a slower pace, so that a server takes them", () => {
  const reel = reelOf([0, 1000, 2000, 3000], 2048, 2048), { frames, rate } = reel.even();
  assert.ok(frames.length * 2048 * 2048 < 64 << 20);
  assert.ok(Math.abs((frames.length - 1) / rate - 3) < 1e-9);
  assert.equal(frames[frames.length - 1].colours[0], 3);
});
