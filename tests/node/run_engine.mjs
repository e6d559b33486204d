// Steers the page's engine as a hand does and writes what it made: node run_engine.mjs PACK MODEL HANDS OUT (hands: list of [entry, tip, steps], in space
// [entry, tip, steps, pose of the probe]).
// OUT.poses are rows of [entry, tip, speed]; OUT.fields the displacement of the mesh's nodes after every tenth step; OUT.grey the picture after each
// hand, all float64 but the last.

import { readFileSync, writeFileSync } from "node:fs";
import { Engine } from "../../src/echospline/page/static/engine.js";

const [packPath, model, hands, out] = process.argv.slice(2);
const core = readFileSync(new URL("../../src/echospline/_native/echospline.wasm", import.meta.url));
const engine = await Engine.open(core, new Uint8Array(readFileSync(packPath)));
engine.choose(model);
const { shape, spacing, origin } = engine.pack.mesh, D = engine.pack.dimension;
const nodes = Array.from({ length: shape.reduce((a, b) => a * b) }, (_, k) => {
  const [nx, ny] = shape, at = [k % nx, Math.floor(k / nx) % ny, Math.floor(k / (nx * ny))];
  return shape.map((_, d) => origin[d] + at[d] * spacing[d]);
}).flat();
const poses = [], fields = [], pictures = [];
for (const [entry, tip, steps, plane] of JSON.parse(hands)) {
  if (plane) engine.plane = plane;
  for (let k = 0; k < steps; ++k) {
    const pose = engine.step({ entry, tip });
    poses.push(...Array.from(pose.entry).slice(0, D), ...Array.from(pose.tip).slice(0, D), pose.speed);
    if (poses.length % (10 * (2 * D + 1)) === 0) fields.push(...engine.displacementAt(nodes));
  }
  pictures.push(Buffer.from(engine.grey()));
}
writeFileSync(`${out}.poses`, Float64Array.from(poses));
writeFileSync(`${out}.fields`, Float64Array.from(fields));
writeFileSync(`${out}.grey`, Buffer.concat(pictures));
