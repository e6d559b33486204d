// The core in WebAssembly: its list of scenes, and agreement with the native library where its results are given.

import assert from "node:assert/strict";
import { existsSync, readFileSync, writeFileSync } from "node:fs";
import { test } from "node:test";

import { CoreError, LAYOUTS, Status, load } from "../../src/echospline/_native/echospline.js";

const wasm = new URL("../../src/echospline/_native/echospline.wasm", import.meta.url);
const skip = existsSync(wasm) ? false : "echospline.wasm is not built: run make wasm";
const core = skip ? null : await load(readFileSync(wasm));
const { scenes } = JSON.parse(readFileSync(new URL("../core/scenes.json", import.meta.url), "utf8"));
// written by tests/test_core_scenes.py: per scene, the displacement after every command; tolerance in mm by precision
const { results, tolerance } = process.env.ECHOSPLINE_NATIVE_RESULTS
  ? JSON.parse(readFileSync(process.env.ECHOSPLINE_NATIVE_RESULTS, "utf8"))
  : { results: null, tolerance: null };
const compared = {};

const largest = (a) => a.reduce((most, value) => Math.max(most, Math.abs(value)), 0);

for (const { name, options, start, dt, commands } of scenes) {
  test(`${name} runs${results ? " and agrees with the native core" : ""}`, { skip }, () => {
    const scene = core.scene(options);
    const tissue = scene.tissue();
    let pose = { ...start, speed: 0, dt };
    let worst = 0;
    commands.forEach(({ steps, ...command }, k) => {
      for (let i = 0; i < steps; ++i) {
        pose = core.follow(pose, command, dt);
        tissue.advance(pose);
      }
      const field = tissue.displacement();
      assert.ok(field.every(Number.isFinite));
      assert.ok(largest(field) > 0.01, "the tissue moves");
      if (results) worst = Math.max(worst, largest(results[name][k].map((value, i) => value - field[i])));
    });
    const { steps, allocations } = tissue.statistics();
    assert.equal(steps, commands.reduce((sum, command) => sum + command.steps, 0));
    assert.equal(allocations, 0);
    if (results) {
      compared[name] = worst;
      assert.ok(worst <= tolerance[options.precision], `differs by ${worst} mm`);
    }
    tissue.destroy();
    scene.destroy();
  });
}

test("a saved state comes back and goes on alike", { skip }, () => {
  const { options, start, dt, commands } = scenes[0];
  const scene = core.scene(options);
  const [one, other] = [scene.tissue(), scene.tissue()];
  let pose = { ...start, speed: 0, dt };
  const advance = (tissues) => {
    for (let i = 0; i < 10; ++i) {
      pose = core.follow(pose, commands[0], dt);
      for (const tissue of tissues) tissue.advance(pose);
    }
  };
  advance([one]);
  other.load(one.save());
  advance([one, other]);
  const field = Float64Array.from(one.displacement());
  assert.ok(largest(other.displacement().map((value, i) => value - field[i])) < 1e-9);
  assert.deepEqual(one.landmarks().map((landmark) => landmark.node), other.landmarks().map((landmark) => landmark.node));
  assert.throws(() => other.load(one.save().slice(0, 20)), (error) => error.status === Status.WRONG_STATE);
  one.reset();
  assert.equal(largest(one.displacement()), 0);
  for (const handle of [one, other, scene]) handle.destroy();
});

test("the displacement at a node is the node's", { skip }, () => {
  const { options, start, dt, commands } = scenes[0];
  const scene = core.scene(options);
  const tissue = scene.tissue();
  let pose = { ...start, speed: 0, dt };
  for (let i = 0; i < 30; ++i) tissue.advance((pose = core.follow(pose, commands[0], dt)));
  const node = 7 * options.shape[0] + 13;
  const at = tissue.displacementAt([13 * options.spacing[0], 7 * options.spacing[1]]);
  const field = tissue.displacement();
  assert.ok(Math.hypot(at[0] - field[2 * node], at[1] - field[2 * node + 1]) < 1e-9);
  const single = Float32Array.from(tissue.displacementSingle()); // both views are of the same memory
  const double = tissue.displacement();
  assert.ok(largest(single.map((value, i) => value - double[i])) < 1e-6);
  tissue.destroy();
  scene.destroy();
});

test("a wrong option is refused in one sentence", { skip }, () => {
  assert.throws(() => core.scene({ ...scenes[0].options, shape: [1, 30] }), (error) => {
    assert.ok(error instanceof CoreError);
    assert.match(error.message, /shape/);
    return true;
  });
});

test("anchors and sources are counted as they are listed", { skip }, () => {
  const scene = core.scene(scenes[0].options);
  assert.equal(scene.anchors().length, scene.anchorCount * scene.dimension);
  assert.equal(scene.sources().length, scene.sourceCount);
  scene.destroy();
});

test("a picture is drawn deformed and with a needle", { skip }, () => {
  const [columns, rows] = [120, 90];
  const pixels = Uint8Array.from({ length: columns * rows }, (_, i) => 40 + ((i % columns) ^ Math.floor(i / columns)) % 64);
  const options = { columns, rows, spacing: [0.2, 0.2], mesh_shape: [13, 10], mesh_spacing: [2, 2] };
  const picture = core.picture(options, pixels);
  assert.deepEqual(Uint8Array.from(picture.draw(null)), pixels, "undeformed is the reference");
  const field = Float32Array.from({ length: 2 * 13 * 10 }, (_, i) => (i % 2 ? 0 : 0.4));
  picture.deform(field);
  const shifted = Uint8Array.from(picture.draw(null));
  assert.equal(shifted[45 * columns + 62], pixels[45 * columns + 60], "0.4 mm are two pixels");
  const { x } = picture.inverse();
  assert.ok(Math.abs(x[45 * columns + 62] - 60) < 1e-3);
  const needle = { entry: [5, 0, 0], tip: [17, 12, 0] };
  assert.notDeepEqual(Uint8Array.from(picture.draw(needle)), shifted);
  assert.ok(picture.report().residual < 0.1);
  const { power, transmission } = picture.echo(needle, [11, 6, 11, 9, 21, 9]); // on it, in its shadow, beside both
  assert.ok(power[0] > power[1] && transmission[1] < 0.5 && transmission[2] > 0.9);
  assert.throws(() => picture.deform(new Float32Array(3)), /expected 260 numbers/);
  assert.throws(() => core.picture(options, new Uint8Array(5)), /expected Uint8Array of 10800/);
  picture.destroy();
});

test("a picture follows a tissue of its mesh", { skip }, () => {
  const mesh = { shape: [13, 10, 1], spacing: [2, 2, 1] };
  const scene = core.scene({ dimension: 2, ...mesh });
  const tissue = scene.tissue();
  tissue.advance({ entry: [10, 0, 0], tip: [12, 8, 0], speed: 10, dt: 0.1 });
  const options = { columns: 60, rows: 45, spacing: [0.4, 0.4], mesh_shape: [13, 10], mesh_spacing: [2, 2] };
  const pixels = Uint8Array.from({ length: 60 * 45 }, (_, i) => (7 * i) % 251);
  const picture = core.picture(options, pixels);
  picture.deform(Float32Array.from(tissue.displacement()));
  const deformed = Uint8Array.from(picture.draw(null));
  assert.notDeepEqual(deformed, pixels);
  picture.deform(new Float32Array(2 * 13 * 10));
  picture.follow(tissue);
  const followed = picture.draw(null);
  assert.ok(deformed.every((value, i) => Math.abs(value - followed[i]) <= 1));
  const other = core.picture({ ...options, mesh_shape: [12, 10] }, pixels);
  assert.throws(() => other.follow(tissue), /mesh must be the tissue's/);
  for (const thing of [other, picture, tissue, scene]) thing.destroy();
});

test("a picture is shaded for a display", { skip }, () => {
  const pixels = Uint8Array.from({ length: 30 * 20 }, (_, i) => (7 * i) % 256);
  const options = { columns: 30, rows: 20, spacing: [1, 1], mesh_shape: [4, 3], mesh_spacing: [10, 10] };
  const picture = core.picture(options, pixels);
  const grey = Uint8Array.from(picture.draw(null));
  const plain = picture.shade({});
  assert.ok(plain instanceof Uint8ClampedArray);
  assert.ok(plain.every((value, i) => value === (i % 4 === 3 ? 255 : grey[i >> 2])));
  // 6 dB of 60 at the first row falling to none at the last, over 40 dB: 255 (1 + (60 (g/255 - 1) + gain) / 40)
  const shown = picture.shade({ depth_gains: [6, 0], dynamic_range: 40, flip: 1, invert: 1 });
  for (let i = 0; i < grey.length; ++i) {
    const [row, column] = [Math.floor(i / 30), i % 30];
    const level = 60 * (grey[i] / 255 - 1) + 6 * (1 - row / 19);
    const expected = 255 - Math.min(Math.max(255 * (1 + level / 40), 0), 255);
    assert.ok(Math.abs(shown[4 * (row * 30 + 29 - column)] - expected) <= 0.55 || grey[i] < 8);
  }
  assert.throws(() => picture.shade({ gain: NaN }), (error) => error instanceof CoreError && error.status === Status.WRONG_VALUE);
  picture.destroy();
  const coloured = core.picture({ ...options, channels: 3 }, new Uint8Array(3 * 600));
  assert.throws(() => coloured.shade({}), /expected a picture of grey/);
  coloured.destroy();
});

test("structs are laid out as the compiler lays them out", { skip: process.env.ECHOSPLINE_WASM_LAYOUTS ? false : "no layouts given" }, () => {
  const given = JSON.parse(readFileSync(process.env.ECHOSPLINE_WASM_LAYOUTS, "utf8"));
  const ours = Object.fromEntries(Object.entries(LAYOUTS).map(([name, { size, fields }]) => [
    name, { size, offsets: Object.fromEntries(fields.map((field) => [field.name, field.offset])) },
  ]));
  assert.deepEqual(ours, given);
});

test("what was compared is written down", { skip: results ? false : "no native results given" }, () => {
  writeFileSync(process.env.ECHOSPLINE_NATIVE_RESULTS + ".compared", JSON.stringify(compared));
});
