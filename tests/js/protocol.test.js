// The page's side of the wire, against the same golden bytes as the server's.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";

import { splineAt } from "../../src/echospline/viewer/static/spline.js";
import { FRAME_HEADER_BYTES, decodeFrame, encodeCommand } from "../../src/echospline/viewer/static/protocol.js";
import { View } from "../../src/echospline/viewer/static/view.js";
import { Needle } from "../../src/echospline/viewer/static/controls.js";

const golden = JSON.parse(readFileSync(new URL("../golden/viewer.json", import.meta.url), "utf8"));
const bytes = (hex) => Uint8Array.from(hex.replaceAll(" ", "").match(/../g), (pair) => parseInt(pair, 16)).buffer;
const plain = (value) => (value instanceof Float32Array ? [...value] : value);

for (const { fields, hex } of golden.filter((entry) => entry.what === "command")) {
  test(`command ${fields.number} has the golden bytes`, () => {
    const pose = fields.pose && { entry: fields.pose.slice(0, 2), angle: fields.pose[2], depth: fields.pose[3] };
    assert.deepEqual(new Uint8Array(encodeCommand(fields.drawn, fields.number, fields.sent, pose)), new Uint8Array(bytes(hex)));
  });
}

for (const { fields, hex } of golden.filter((entry) => entry.what === "frame")) {
  test(`frame with flags ${fields.flags} is read from the golden bytes`, () => {
    const frame = Object.fromEntries(Object.entries(decodeFrame(bytes(hex))).map(([name, value]) => [name, plain(value)]));
    assert.deepEqual(frame, fields);
  });

  test(`frame with flags ${fields.flags} cut or padded is refused`, () => {
    const whole = bytes(hex);
    for (const cut of [0, 1, FRAME_HEADER_BYTES - 1, whole.byteLength - 4]) assert.throws(() => decodeFrame(whole.slice(0, cut)));
    const padded = new Uint8Array(whole.byteLength + 4);
    padded.set(new Uint8Array(whole));
    assert.throws(() => decodeFrame(padded.buffer));
  });
}

test("an affine thin-plate spline is evaluated in conditioned coordinates", () => {
  const spline = new Float32Array([1, 0, 0, 20, 10, 5, 0.5, -0.25, 2, 0, 0, 4]);
  assert.deepEqual(splineAt(spline, [25, 15]), [2.5, 3.75]);
});

test("screen and millimetres are inverse to each other, zoomed and panned too", () => {
  const view = new View();
  view.resize(800, 600);
  view.extent = { x0: -3, x1: 47, y0: 0, y1: 40 };
  view.zoomBy(2.5, [300, 200]);
  view.pan = [view.pan[0] + 13, view.pan[1] - 7];
  const [x, y] = view.toMm(view.toScreen([12.25, 30.5]));
  assert.ok(Math.hypot(x - 12.25, y - 30.5) < 1e-9);
});

test("zooming keeps the point under the pointer", () => {
  const view = new View();
  view.resize(800, 600);
  view.extent = { x0: 0, x1: 50, y0: 0, y1: 40 };
  const before = view.toMm([310, 250]);
  view.zoomBy(3, [310, 250]);
  const after = view.toMm([310, 250]);
  assert.ok(Math.hypot(after[0] - before[0], after[1] - before[1]) < 1e-9);
});

test("the tip never leaves the image, whatever is asked", () => {
  const needle = new Needle();
  needle.extent = { x0: 0, x1: 50, y0: 0, y1: 40 };
  needle.setEntry(10);
  for (const angle of [8, 45, 90, 135, 172, 300, -20]) {
    needle.setAngle(angle);
    needle.setDepth(1000);
    const a = (needle.angle * Math.PI) / 180;
    const tip = [needle.entry[0] + needle.depth * Math.cos(a), needle.depth * Math.sin(a)];
    assert.ok(tip[0] >= 0 && tip[0] <= 50 && tip[1] >= 0 && tip[1] <= 40, String(tip));
    needle.setDepth(0);
  }
});

test("the entry stays while the needle is in the tissue", () => {
  const needle = new Needle();
  needle.extent = { x0: 0, x1: 50, y0: 0, y1: 40 };
  needle.setEntry(10);
  needle.setDepth(5);
  needle.setEntry(30);
  assert.equal(needle.entry[0], 10);
});
