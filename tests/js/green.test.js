// Green's function in WebAssembly: a recorded session as Python computes it. tests/test_green_core.py writes the scenes.

import assert from "node:assert/strict";
import { existsSync, readFileSync } from "node:fs";
import { test } from "node:test";

import { CoreError, Status, load } from "../../src/echospline/_native/echospline.js";

const wasm = new URL("../../src/echospline/_native/echospline.wasm", import.meta.url);
const path = process.env.ECHOSPLINE_GREEN;
const skip = !existsSync(wasm) ? "echospline.wasm is not built: run make wasm" : path ? false : "run by tests/test_green_core.py";
const core = skip ? null : await load(readFileSync(wasm));
const { scenes, poses, points, tolerance } = skip ? { scenes: {} } : JSON.parse(readFileSync(path, "utf8"));

const difference = (a, b) => a.reduce((most, value, i) => Math.max(most, Math.abs(value - b[i])), 0);
const advance = (green, [x, y, tipX, tipY, dt]) => green.advance({ entry: [x, y], tip: [tipX, tipY], speed: 0, dt });

for (const [name, { tables, states }] of Object.entries(scenes)) {
  test(`${name}: a session is Python's`, { skip }, () => {
    const green = core.green({}, tables);
    let worst = 0;
    let next = 0;
    poses.forEach((pose, step) => {
      advance(green, pose);
      if (states[next]?.step !== step) return;
      const { displacement, at } = states[next++];
      worst = Math.max(worst, difference(displacement, green.displacementSingle()), difference(at, green.displacementAt(points)));
    });
    assert.equal(next, states.length);
    assert.ok(worst < tolerance, `differs by ${worst} mm`);
    green.destroy();
  });
}

test("a saved state goes on, and a picture follows without a copy", { skip }, () => {
  const { tables } = scenes["sliding top"];
  const [one, other] = [core.green({}, tables), core.green({}, tables)];
  for (const pose of poses.slice(0, 60)) advance(one, pose);
  other.restore(one.save());
  advance(one, poses[60]);
  advance(other, poses[60]);
  const field = Float32Array.from(one.displacementSingle());
  assert.equal(difference(field, other.displacementSingle()), 0);
  assert.ok(one.load().tip > 0);
  const options = {
    columns: 80, rows: 60, mesh_shape: tables.shape, mesh_spacing: tables.spacing, mesh_origin: tables.origin,
    spacing: [0.5, 0.5], origin: [0.25, 0.25],
  };
  const pixels = Uint8Array.from({ length: 4800 }, (_, i) => (i * 37) % 251);
  const [copied, followed] = [core.picture(options, pixels), core.picture(options, pixels)];
  copied.deform(field);
  followed.follow(one);
  const drawn = Uint8Array.from(copied.draw(null));
  assert.equal(difference(drawn, followed.draw(null)), 0);
  assert.notEqual(difference(drawn, pixels), 0);
  one.reset();
  assert.equal(difference(one.displacementSingle(), new Float32Array(field.length)), 0);
  for (const handle of [copied, followed, one, other]) handle.destroy();
});

test("tables that do not fit are refused", { skip }, () => {
  const { tables } = scenes.lesion;
  const refused = (changed, message) =>
    assert.throws(() => core.green({}, { ...tables, ...changed }), (error) => error instanceof CoreError && message.test(error.message));
  refused({ sides: tables.sides.slice(3) }, /numbers of sides/);
  refused({ sources: tables.sources.slice(1) }, /2 numbers per entry of sources/);
  refused({ sources: tables.sources.slice(2) }, /source_counts must add up/);
  refused({ wonder: 3 }, /wonder/);
  refused({ method: 5 }, /method must be/);
  refused({ left: [1] }, /got left/);
  refused({ source_count: 7 }, /got source_count/);
  refused({ shape: undefined }, /2 whole numbers of shape/);
  refused({ shape: [1.5, 30] }, /2 whole numbers of shape/);
  refused({ band_count: 0.5 }, /1 whole number of band_count/);
  refused({ radius: NaN }, /1 finite number of radius/);
  refused({ bodies: 4096 }, /2 numbers per entry of bodies/);
  refused({ depths: tables.depths.slice(1) }, /numbers of depths/);
  const green = core.green({ tip: 0.3 }, tables);
  assert.throws(() => green.displacementAt([100, 3]), (error) => error.status === Status.WRONG_VALUE);
  green.destroy();
});
