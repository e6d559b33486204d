// Packs and states for the tests of the page's pure parts: a small scene in the plane.

import { readFileSync } from "node:fs";
import { Engine } from "../../src/echospline/page/static/engine.js";
import { readPack } from "../../src/echospline/page/static/scene.js";
import { initialState } from "../../src/echospline/page/static/state.js";

export const core = readFileSync(new URL("../../src/echospline/_native/echospline.wasm", import.meta.url));

export const EXERCISE = {
  name: "between", title: "Between", goal: "Reach it.", target: { centre: [18, 9], radius: 2 }, vessels: [{ centre: [11, 5], radius: 1.5 }],
  most_redirections: null, time_limit: 2, help: true, entry: null, entry_between: null, attempts: null,
};

/** Manifest of the small scene, without its arrays. */
export const manifest = () => ({
  format: 1, version: "0.1.0", title: "Small", language: "en", rate: 120,
  image: { columns: 64, rows: 40, spacing: [0.5, 0.5], origin: [0, 0], pixels: "pixels" },
  mesh: { shape: [16, 10], spacing: [2.1, 2.1667], origin: [0, 0] },
  models: ["tps", "elastic"].map((name, kernel) => ({
    name, label: name.toUpperCase(), sentence: { en: `${name} in English`, de: `${name} auf Deutsch` }, kind: "landmarks",
    options: { dimension: 2, kernel, shape: [16, 10], spacing: [2.1, 2.1667], origin: [0, 0] }, arrays: {},
  })),
  needle: { entry: [8, 0], direction: [Math.SQRT1_2, Math.SQRT1_2], lag: 0.02, fastest: 200, echo: {} },
  exercises: [structuredClone(EXERCISE)],
});

/** Speckle that is the same every time. @param {number} count */
export function speckle(count) {
  let seed = 12345;
  return Uint8Array.from({ length: count }, () => {
    seed = (Math.imul(seed, 1664525) + 1013904223) >>> 0;
    return seed >>> 25 << 1;
  });
}

/** Bytes of a pack. @param {any} given manifest without arrays @param {Record<string, any>} arrays typed arrays @param {(table: any) => any} [lie] changes what is said of them */
export function packed(given = manifest(), arrays = { pixels: speckle(64 * 40) }, lie = (table) => table) {
  const names = { Uint8Array: "uint8", Float32Array: "float32", Float64Array: "float64", Int32Array: "int32", BigInt64Array: "int64" };
  const table = {};
  let offset = 0;
  for (const [name, values] of Object.entries(arrays)) {
    table[name] = { dtype: names[values.constructor.name], shape: [values.length], offset };
    offset = 8 * Math.ceil((offset + values.byteLength) / 8);
  }
  const text = new TextEncoder().encode(JSON.stringify({ ...given, arrays: lie(table) }));
  const start = 8 * Math.ceil((12 + text.length) / 8), bytes = new Uint8Array(start + offset);
  bytes.set(new TextEncoder().encode("ECHOPACK"));
  new DataView(bytes.buffer).setUint32(8, text.length, true);
  bytes.set(text, 12);
  Object.entries(arrays).forEach(([name, values]) => {
    const at = start + (table[name].offset ?? 0);
    if (at + values.byteLength <= bytes.length) bytes.set(new Uint8Array(values.buffer, values.byteOffset, values.byteLength), at);
  });
  return bytes;
}

/** State of the small scene on a stage of 800 x 600. */
export function freshState(change = {}) {
  return { ...initialState(readPack(packed())), ...change };
}

export const engine = () => Engine.open(core, packed());

/** Manifest of a small scene in space, without its arrays. */
export const manifestInSpace = () => ({
  ...manifest(), image: undefined, volume: { shape: [20, 20, 20], spacing: [2, 2, 2], origin: [-19, 0, -19], voxels: "voxels" },
  probe: {
    shape: "linear", columns: 101, rows: 101, spacing: [0.3, 0.3], origin: [-15, 0], radius: 60, opening: 60, depth: 30, pose: [0, 0, 0, 0, 0, 0], elevation: 0.75,
    elevation_depth: 18, element_height: 5,
  },
  mesh: { shape: [7, 7, 7], spacing: [6, 6, 6], origin: [-18, 0, -18] },
  models: [{ name: "elastic", label: "Elastic", sentence: {}, kind: "landmarks", options: { dimension: 3, kernel: 1, shape: [7, 7, 7], spacing: [6, 6, 6], origin: [-18, 0, -18], anchor_spacing: 9, contact_spacing: 3 }, arrays: {} }],
  needle: { entry: [-8, 0, 0], direction: [0.6, 0.8, 0], lag: 0.02, fastest: 200, echo: {} },
  exercises: [{ ...structuredClone(EXERCISE), target: { centre: [4, 15, 1], radius: 3 }, vessels: [] }],
});

export const packedInSpace = (given = manifestInSpace()) => packed(given, { voxels: speckle(8000) });

/** State of the small scene in space on a stage of 800 x 600. */
export function stateInSpace() {
  return initialState(readPack(packedInSpace()));
}
