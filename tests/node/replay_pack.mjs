// Runs recorded poses on a model of a pack by the core in WebAssembly, with echospline.js alone, and writes the field and picture after some of them.
// node replay_pack.mjs PACK POSES MODEL OUT: poses are rows of [entry, tip, speed], float64; out is the fields of every tenth step, then the watched
// points' displacements at every step (WATCHED, from the environment, JSON), then the last picture, in one file with a JSON head.

import { readFileSync, writeFileSync } from "node:fs";
import { load } from "../../src/echospline/_native/echospline.js";

const [packPath, posesPath, name, outPath] = process.argv.slice(2);
const bytes = new Uint8Array(readFileSync(packPath));
const length = new DataView(bytes.buffer, bytes.byteOffset).getUint32(8, true);
const pack = JSON.parse(new TextDecoder().decode(bytes.subarray(12, 12 + length)));
const start = 8 * Math.ceil((12 + length) / 8);
const types = { uint8: Uint8Array, float32: Float32Array, float64: Float64Array, int32: Int32Array };
const array = (key) => {
  const { dtype, shape, offset } = pack.arrays[key], type = types[dtype], count = shape.reduce((a, b) => a * b, 1);
  return new type(bytes.slice(start + offset, start + offset + count * type.BYTES_PER_ELEMENT).buffer);
};
const core = await load(readFileSync(new URL("../../src/echospline/_native/echospline.wasm", import.meta.url)));
const model = pack.models.find((one) => one.name === name);
const given = Object.fromEntries(Object.entries(model.arrays ?? {}).map(([role, key]) => [role, array(key)]));
const watched = JSON.parse(process.env.WATCHED);
const forced = model.kind === "forced";
const tissue = forced ? core.green(model.options, { ...model.response, ...given }) : core.scene({ ...model.options, ...given }).tissue();
const D = pack.mesh.shape.length, row = 2 * D + 1, file = readFileSync(posesPath);
const poses = new Float64Array(file.buffer.slice(file.byteOffset, file.byteOffset + file.byteLength));
const fields = [], places = [];
for (let k = 0; k < poses.length / row; ++k) {
  const at = row * k;
  tissue.advance({ entry: poses.slice(at, at + D), tip: poses.slice(at + D, at + 2 * D), speed: poses[at + 2 * D], dt: 1 / pack.rate });
  if (k % 10 === 9) fields.push(Float64Array.from(tissue.displacement()));
  places.push(Float64Array.from(tissue.displacementAt(watched)));
}
let drawn = new Uint8Array(0);
if (D === 2) {
  const { image, mesh, needle } = pack;
  const picture = core.picture({
    columns: image.columns, rows: image.rows, spacing: image.spacing, origin: image.origin,
    mesh_shape: mesh.shape, mesh_spacing: mesh.spacing, mesh_origin: mesh.origin,
  }, array(image.pixels));
  picture.deform(tissue.displacementSingle());
  const end = poses.length - row;
  drawn = picture.draw({ ...needle.echo, entry: poses.slice(end, end + D), tip: poses.slice(end + D, end + 2 * D) }).slice();
}
const parts = [...fields, ...places];
const numbers = new Float64Array(parts.reduce((sum, part) => sum + part.length, 0));
let at = 0;
for (const part of parts) {
  numbers.set(part, at);
  at += part.length;
}
writeFileSync(`${outPath}.f64`, numbers);
writeFileSync(`${outPath}.u8`, drawn);
