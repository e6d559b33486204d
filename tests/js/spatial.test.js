// The needle's law and Green's function in space in WebAssembly: a recorded session as Python steps it. tests/test_space_js.py writes it.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";

import { CoreError, Status, load } from "../../src/echospline/_native/echospline.js";

const given = process.env.ECHOSPLINE_SPATIAL;
const skip = given ? false : "no session is given: run tests/test_space_js.py";
const core = skip ? null : await load(readFileSync(new URL("../../src/echospline/_native/echospline.wasm", import.meta.url)));
const session = skip ? null : JSON.parse(readFileSync(given, "utf8"));
const { tables, poses, points, states } = session ?? { poses: [], states: [] };

const largest = (a) => a.reduce((most, value) => Math.max(most, Math.abs(value)), 0);
const gap = (a, b) => largest(Array.from(a, (value, i) => value - b[i]));
const advance = (spatial, [entry, tip]) => spatial.advance({ entry, tip, speed: 0, dt: 0.1 });

test("a session is Python's: forces, load and displacement", { skip }, () => {
  const spatial = core.spatial(tables);
  poses.forEach((pose, i) => {
    advance(spatial, pose);
    const { forces, load: expected, displacement } = states[i];
    assert.equal(spatial.forces().length, forces.length);
    assert.ok(gap(spatial.forces(), forces) < 2e-5);
    const found = spatial.load();
    for (const name of ["tip", "friction", "side", "cut"]) assert.ok(Math.abs(found[name] - expected[name]) < 2e-4, name);
    assert.ok(gap(found.force, expected.force) < 2e-4 && gap(found.torque, expected.torque) < 5e-3);
    assert.ok(gap(spatial.move().displacementAt(points), displacement) < 2e-4);
  });
  assert.ok(Math.max(...states.map(({ displacement }) => largest(displacement))) > 0.3);
  const stations = spatial.stations();
  assert.equal(3 * stations.length, spatial.forces().length);
  assert.deepEqual(stations.map(({ index }) => index), stations.map((_, i) => i));
  spatial.reset();
  assert.equal(spatial.forces().length, 0);
  assert.equal(largest(spatial.move().displacementAt(points)), 0);
  spatial.destroy();
});

test("a saved state goes on bit for bit", { skip }, () => {
  const [one, other] = [core.spatial(tables), core.spatial(tables)];
  for (const pose of poses.slice(0, 18)) advance(one, pose);
  other.restore(one.save());
  for (const spatial of [one, other]) advance(spatial, poses[18]);
  assert.deepEqual(other.forces(), one.forces());
  assert.deepEqual(other.move().displacementAt(points), one.move().displacementAt(points));
  assert.throws(() => other.restore(one.save().fill(7, 40, 41)), (error) => error.status === Status.WRONG_STATE);
  for (const spatial of [one, other]) spatial.destroy();
});

test("a host may answer instead, and says so where it does not", { skip }, () => {
  const { low, high } = tables;
  const stiff = core.spatial({ low, high }, ({ index }) => Array.from({ length: 9 * (index + 1) }, (_, i) => (i >= 9 * index && i % 4 === 0 ? 1e-6 : 0)));
  advance(stiff, poses[5]);
  assert.ok(stiff.load().tip > 0.39);
  assert.throws(() => stiff.move(), /created without sources/);
  const silent = core.spatial({ low, high });
  assert.throws(() => advance(silent, poses[5]), (error) => error instanceof CoreError && error.status === Status.NEEDS_STATION);
  stiff.destroy();
  silent.destroy();
});

test("a picture of a plane shows the tissue as the law moves it", { skip }, () => {
  const [x, y, z] = [60, 50, 56];
  const voxels = Uint8Array.from({ length: x * y * z }, (_, i) => 128 + 100 * Math.sin(i / 3) * Math.cos(i / 170));
  const volume = core.volume({ shape: [x, y, z], spacing: [0.6, 0.6, 0.6], origin: [-17.7, 0.3, -16.5] }, voxels);
  const plane = core.plane(volume, { columns: 60, rows: 60, spacing: [0.5, 0.5], origin: [-14.75, 0.25], step: 2 });
  const matrix = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, -1, 0, 0, 0, 1];
  const spatial = core.spatial(tables);
  const still = Array.from(plane.draw(matrix, null, null));
  for (const pose of poses.slice(0, 14)) advance(spatial, pose);
  const moved = Array.from(plane.draw(matrix, spatial.move(), null));
  assert.ok(gap(still, moved) > 20, `${gap(still, moved)} grey levels`);
  assert.equal(plane.traced().folded, 0);
  const [places, from] = [plane.places, plane.lattice].map((at) => new Float64Array(core.buffer, at, plane.numbers).slice());
  const u = spatial.displacementAt(from);
  assert.ok(gap(from.map((value, i) => value + u[i]), places) < 0.05 * 0.5 + 1e-5, "a place is a twentieth of a pixel off");
  for (const handle of [plane, spatial, volume]) handle.destroy();
});

test("options that do not fit are refused in one sentence", { skip }, () => {
  assert.throws(() => core.spatial({ ...tables, wonder: 3 }), /expected names of echospline_spatial_options; got wonder/);
  assert.throws(() => core.spatial({ ...tables, conditions: [1, 2] }), /three numbers of conditions/);
  assert.throws(() => core.spatial({ ...tables, answers: [1] }), /answers must hold/);
});
