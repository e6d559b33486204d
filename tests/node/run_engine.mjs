// Steers the page's engine as a hand does and writes what it made: node run_engine.mjs PACK MODEL HANDS OUT (hands: list of [entry, tip, steps]).
// OUT.poses are rows of [entry, tip, speed]; OUT.fields the displacement of the mesh's nodes after every tenth step; OUT.grey the picture after each
// hand, all float64 but the last.

import { readFileSync, writeFileSync } from "node:fs";
import { Engine } from "../../src/echospline/page/static/engine.js";

const [packPath, model, hands, out] = process.argv.slice(2);
const core = readFileSync(new URL("../../src/echospline/_native/echospline.wasm", import.meta.url));
const engine = await Engine.open(core, new Uint8Array(readFileSync(packPath)));
engine.choose(model);
const { shape, spacing, origin } = engine.pack.mesh;
const nodes = Array.from({ length: shape[0] * shape[1] }, (_, k) => [origin[0] + (k % shape[0]) * spacing[0], origin[1] + Math.floor(k / shape[0]) * spacing[1]]).flat();
const poses = [], fields = [], pictures = [];
for (const [entry, tip, steps] of JSON.parse(hands)) {
  for (let k = 0; k < steps; ++k) {
    const pose = engine.step({ entry, tip });
    poses.push(...Array.from(pose.entry).slice(0, 2), ...Array.from(pose.tip).slice(0, 2), pose.speed);
    if (poses.length % 50 === 0) fields.push(...engine.displacementAt(nodes));
  }
  pictures.push(Buffer.from(engine.grey()));
}
writeFileSync(`${out}.poses`, Float64Array.from(poses));
writeFileSync(`${out}.fields`, Float64Array.from(fields));
writeFileSync(`${out}.grey`, Buffer.concat(pictures));
