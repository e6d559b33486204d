// Steps and frames of the core in WebAssembly: prints one line of JSON; run by wasm.py, which times the native core beside it.
import { readFileSync } from "node:fs";

import { load } from "../src/echospline/_native/echospline.js";

const [wasm, meshes] = [process.argv[2], JSON.parse(process.argv[3])];
const core = await load(readFileSync(wasm));
const SIZE = 512;
const median = (times) => times.sort((a, b) => a - b)[times.length >> 1];
const rows = [];
for (const shape of meshes) {
  const spacing = [40 / (shape[0] - 1), 30 / (shape[1] - 1), 1];
  const scene = core.scene({ shape: [...shape, 1], spacing, delta: 1.1, contact_spacing: 1 });
  const tissue = scene.tissue();
  const pixels = Uint8Array.from({ length: SIZE * SIZE }, (_, i) => (i * 2654435761) >>> 24);
  const side = [40 / (SIZE - 1), 30 / (SIZE - 1)];
  const picture = core.picture(
    { columns: SIZE, rows: SIZE, spacing: side, mesh_shape: shape, mesh_spacing: spacing.slice(0, 2) },
    pixels,
  );
  const steps = [];
  const frames = [];
  const dt = 1 / 60;
  for (let i = 1; i <= 156; ++i) {
    const depth = i * dt * 10;
    const tip = [12.3 + 0.4 * depth, Math.sqrt(1 - 0.16) * depth, 0];
    const begin = performance.now();
    tissue.advance({ entry: [12.3, 0, 0], tip, speed: 10, dt });
    const between = performance.now();
    picture.follow(tissue);
    picture.draw({ entry: [12.3, 0, 0], tip });
    if (i > 117) steps.push(between - begin), frames.push(performance.now() - begin);
  }
  rows.push({ step: median(steps), frame: median(frames) });
}
console.log(JSON.stringify(rows));
