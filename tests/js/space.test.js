// Scenes in space in WebAssembly, against what Python made of the same scene by the native library (tests/test_space_js.py).

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";

import { CoreError, load } from "../../src/echospline/_native/echospline.js";

const given = process.env.ECHOSPLINE_SPACE_SCENE;
const skip = given ? false : "no scene is given: run tests/test_space_js.py";
const core = skip ? null : await load(readFileSync(new URL("../../src/echospline/_native/echospline.wasm", import.meta.url)));
const scene = skip ? null : JSON.parse(readFileSync(given, "utf8"));

const largest = (a) => a.reduce((most, value) => Math.max(most, Math.abs(value)), 0);
const gap = (a, b) => largest(a.map((value, i) => value - b[i]));

test("tissue moves under forces as Python says", { skip }, () => {
  const field = core.forceField(scene.field);
  const u = field.displacementAt(scene.points);
  assert.equal(u.length, scene.displacement.length);
  assert.ok(largest(u) > 0.1);
  assert.ok(gap(Array.from(u), scene.displacement) < 2e-5);
  assert.throws(() => field.displacementAt([NaN, 0, 0]), CoreError);
  field.destroy();
});

for (const kind of ["rest", "still", "moved"]) {
  test(`the picture of a plane is Python's: ${kind}`, { skip }, () => {
    const volume = core.volume(scene.volume, Uint8Array.from(scene.voxels));
    const { mask, spread, ...options } = scene.plane;
    const plane = core.plane(volume, { ...options, mask: Uint8Array.from(mask), spread: Float32Array.from(spread) });
    const field = kind === "moved" ? core.forceField(scene.field) : null;
    const grey = Array.from(plane.draw(scene.matrix, field, kind === "rest" ? null : scene.needle));
    const expected = scene.pictures[kind];
    assert.ok(largest(expected) > 100);
    assert.ok(gap(grey, expected) <= 1, `${gap(grey, expected)} grey levels`);
    const report = plane.traced();
    assert.ok(Math.abs(report.residual - scene.reports[kind].residual) < 1e-4);
    assert.equal(report.outside, scene.reports[kind].outside);
    assert.equal(report.folded, 0);
    const rgba = plane.shade({});
    assert.ok(rgba.every((value, i) => value === (i % 4 === 3 ? 255 : grey[i >> 2])));
    field?.destroy();
    plane.destroy();
    volume.destroy();
  });
}

test("a plane shows tissue that a spline in space moves", { skip }, () => {
  const volume = core.volume(scene.volume, Uint8Array.from(scene.voxels));
  const plane = core.plane(volume, { ...scene.plane, mask: undefined, spread: undefined });
  const tissue = core.scene(scene.spline).tissue();
  const still = Array.from(plane.draw(scene.matrix, null, null));
  tissue.advance({ entry: scene.needle.entry, tip: scene.needle.tip, speed: 10, dt: 0.2 });
  const moved = Array.from(plane.draw(scene.matrix, tissue, scene.needle));
  assert.ok(gap(still, moved) > 5);
  assert.ok(plane.traced().residual < 0.1);
  plane.destroy();
  volume.destroy();
});

test("sizes that do not fit are refused in one sentence", { skip }, () => {
  assert.throws(() => core.volume(scene.volume, new Uint8Array(7)), /expected Uint8Array of \d+ voxels/);
  assert.throws(() => core.volume({ ...scene.volume, spacing: [0, 1, 1] }, Uint8Array.from(scene.voxels)), /spacing must be three positive/);
  assert.throws(() => core.forceField({ ...scene.field, forces: [1] }), /three for each radius/);
});
