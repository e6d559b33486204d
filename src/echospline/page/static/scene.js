// The scene that a page shows: a pack of bytes, read and checked. Nothing of it is believed before it has been looked at.

import { PackError, asList, asNumber, asNumbers, asRecord, asText, asWhole, shown } from "./checked.js";
import { codingOf } from "./codings.js";
import { readProbe } from "./probe.js";

/** @import { Probe } from "./probe.js" */

const MAGIC = "ECHOPACK";
const MOST_PIXELS = 4096 * 4096, MOST_VOXELS = 512 ** 3, MOST_NODES = 1_000_000, MOST_MODELS = 8, MOST_EXERCISES = 100, MOST_VESSELS = 20;
const LONGEST_MANIFEST = 4 << 20; // bytes
const ARRAY_TYPES = { uint8: Uint8Array, float32: Float32Array, float64: Float64Array, int32: Int32Array, int64: BigInt64Array };

/** @typedef {[number, number]} Point (x lateral, y depth), mm */
/** @typedef {{ centre: number[], radius: number, [extra: string]: any }} Ball round structure, a disc in the plane; mm */
/**
 * `help` false takes rings, guide and readouts away; `entry` is where the needle enters, `entry_between` where it is drawn by lot (mm); `attempts` a trainee has.
 * @typedef {{
 *   name: string, title: string, goal: string, target: Ball, vessels: Ball[], most_redirections: number | null, time_limit: number,
 *   help: boolean, entry: number[] | null, entry_between: number[] | null, attempts: number | null, [extra: string]: any
 * }} Exercise
 */
/**
 * @typedef {{
 *   name: string, label: string, sentence: Record<string, string>, kind: string, options: Record<string, any>,
 *   response: Record<string, any> | null, arrays: Record<string, string>
 * }} ModelEntry
 */
/** @typedef {{ shape: number[], spacing: number[], origin: number[] }} Lattice */
/** @typedef {Uint8Array | Float32Array | Float64Array | Int32Array | BigInt64Array} Values */
/**
 * A pack whose every size fits. `array` gives the values of a name.
 * @typedef {{
 *   dimension: 2 | 3, version: string, title: string, language: string, rate: number, mesh: Lattice, models: ModelEntry[],
 *   image: { columns: number, rows: number, spacing: Point, origin: Point, pixels: string } | null,
 *   volume: (Lattice & { voxels: string }) | null, probe: Probe | null,
 *   needle: { entry: number[], direction: number[], lag: number, fastest: number, echo: Record<string, any> },
 *   exercises: Exercise[], array: (name: string) => Values
 * }} Pack
 */

/** Read a pack. @param {Uint8Array} bytes @returns {Pack} */
export function readPack(bytes) {
  if (bytes.length < 16 || new TextDecoder("latin1").decode(bytes.subarray(0, 8)) !== MAGIC) {
    throw new PackError("These bytes hold no scene: they do not begin with ECHOPACK. Make the page anew: echospline page.");
  }
  const size = new DataView(bytes.buffer, bytes.byteOffset).getUint32(8, true);
  const start = 8 * Math.ceil((12 + size) / 8);
  if (size > LONGEST_MANIFEST || start > bytes.length) {
    throw new PackError(`This scene is cut short: its description takes ${size} bytes, and ${bytes.length - 12} follow. Make the page anew.`);
  }
  let m;
  try {
    m = JSON.parse(new TextDecoder("utf-8", { fatal: true }).decode(bytes.subarray(12, 12 + size)));
  } catch {
    throw new PackError("The description of this scene is damaged: it is no JSON. Make the page anew.");
  }
  const given = asRecord(m, "the description");
  if (given.format !== 1) throw new PackError(`This page reads scenes of format 1; got ${shown(given.format)}. Make the page anew with this version.`);
  const arrays = asRecord(given.arrays, "arrays");
  /** @type {Map<string, Values>} */
  const views = new Map();
  for (const [name, entry] of Object.entries(arrays)) views.set(name, arrayView(bytes, start, name, asRecord(entry, `array ${name}`)));
  /** @param {string} name */
  const array = (name) => {
    const found = views.get(name);
    if (!found) throw new PackError(`The scene names an array ${shown(name)} that it does not hold. Make the page anew.`);
    return found;
  };
  const space = given.volume !== undefined && given.volume !== null;
  const dimension = space ? 3 : 2;
  const image = space ? null : readImage(asRecord(given.image, "image"), array);
  const volume = space ? readVolume(asRecord(given.volume, "volume"), array) : null;
  const mesh = lattice(asRecord(given.mesh, "mesh"), "mesh", dimension, MOST_NODES, 2);
  const models = asList(given.models, "models", 1, MOST_MODELS).map((entry, k) => readModel(asRecord(entry, `models[${k}]`), k, array));
  if (new Set(models.map((model) => model.name)).size < models.length) throw new PackError("Two models of this scene have one name. Make the page anew.");
  const rate = asNumber(given.rate, "rate", 10, 2000);
  const exercises = asList(given.exercises ?? [], "exercises", 0, MOST_EXERCISES).map((entry, k) => readExercise(entry, `exercises[${k}]`, dimension));
  return {
    dimension, version: asText(given.version ?? "", "version", 80), title: asText(given.title ?? "", "title", 200),
    language: asText(given.language ?? "en", "language", 20), rate, mesh, models, image, volume,
    probe: space ? readProbe(given.probe) : null, needle: readNeedle(asRecord(given.needle, "needle"), dimension), exercises, array,
  };
}

/** Check an exercise, of a pack or of a session. @param {unknown} value @param {string} what @param {number} dimension @returns {Exercise} */
export function readExercise(value, what, dimension) {
  const entry = asRecord(value, what);
  const ball = (/** @type {unknown} */ at, /** @type {string} */ name) => {
    const b = asRecord(at, name);
    return { ...b, centre: asNumbers(b.centre, `${name}.centre`, dimension), radius: asNumber(b.radius, `${name}.radius`, 1e-6, 100) };
  };
  const most = entry.most_redirections ?? null, attempts = entry.attempts ?? null, help = entry.help ?? true;
  if (typeof help !== "boolean") throw new PackError(`Expected true or false for ${what}.help; got ${shown(help)}.`);
  const place = entry.entry ?? null, between = entry.entry_between ?? null;
  return {
    ...entry, name: asText(entry.name, `${what}.name`, 80), title: asText(entry.title, `${what}.title`, 80), goal: asText(entry.goal ?? "", `${what}.goal`, 400),
    target: ball(entry.target, `${what}.target`), vessels: asList(entry.vessels ?? [], `${what}.vessels`, 0, MOST_VESSELS).map((v, j) => ball(v, `${what}.vessels[${j}]`)),
    most_redirections: most === null ? null : asNumber(most, `${what}.most_redirections`, 0, 1e6), time_limit: asNumber(entry.time_limit ?? 120, `${what}.time_limit`, 0.01, 1800),
    help, entry: place === null ? null : asNumbers(place, `${what}.entry`, dimension), entry_between: between === null ? null : asNumbers(between, `${what}.entry_between`, 2),
    attempts: attempts === null ? null : asWhole(attempts, `${what}.attempts`, 1, 1000),
  };
}

/** Extent that the mesh covers in the picture's plane, mm. @param {Lattice} mesh */
export function extentOf(mesh) {
  const [x0, y0] = mesh.origin;
  return { x0, y0, x1: x0 + (mesh.shape[0] - 1) * mesh.spacing[0], y1: y0 + (mesh.shape[1] - 1) * mesh.spacing[1] };
}

/** @param {Record<string, any>} entry @param {(name: string) => Values} array */
function readImage(entry, array) {
  const columns = asWhole(entry.columns, "image.columns", 2, 4096), rows = asWhole(entry.rows, "image.rows", 2, 4096);
  const pixels = asText(entry.pixels, "image.pixels", 200);
  sized(array(pixels), Uint8Array, columns * rows, "the image");
  if (columns * rows > MOST_PIXELS) throw new PackError("The image of this scene is too large for a page.");
  const [spacing, origin] = [asNumbers(entry.spacing, "image.spacing", 2), asNumbers(entry.origin, "image.origin", 2)];
  if (Math.min(...spacing) <= 0) throw new PackError("The image's spacing must be positive, in mm. Make the page anew.");
  return { columns, rows, pixels, spacing: /** @type {Point} */ (spacing), origin: /** @type {Point} */ (origin) };
}

/** @param {Record<string, any>} entry @param {(name: string) => Values} array */
function readVolume(entry, array) {
  const grid = lattice(entry, "volume", 3, MOST_VOXELS, 2), voxels = asText(entry.voxels, "volume.voxels", 200);
  sized(array(voxels), Uint8Array, grid.shape.reduce((a, b) => a * b), "the volume");
  return { ...grid, voxels };
}

/** @param {Record<string, any>} entry @param {number} k @param {(name: string) => Values} array @returns {ModelEntry} */
function readModel(entry, k, array) {
  const what = `models[${k}]`, kind = asText(entry.kind, `${what}.kind`, 20);
  if (kind !== "landmarks" && kind !== "forced") throw new PackError(`A model of a scene is of kind landmarks or forced; got ${shown(kind)}. Make the page anew with this version.`);
  const arrays = asRecord(entry.arrays ?? {}, `${what}.arrays`);
  for (const name of Object.values(arrays)) array(asText(name, `${what}.arrays`, 200));
  const sentence = Object.fromEntries(Object.entries(asRecord(entry.sentence ?? {}, `${what}.sentence`)).map(([tongue, words]) => [tongue, asText(words, `${what}.sentence`, 400)]));
  return {
    name: asText(entry.name, `${what}.name`, 40), label: asText(entry.label, `${what}.label`, 40), sentence, kind, arrays,
    options: asRecord(entry.options, `${what}.options`), response: entry.response ? asRecord(entry.response, `${what}.response`) : null,
  };
}

/** @param {Record<string, any>} entry @param {number} dimension */
function readNeedle(entry, dimension) {
  const direction = asNumbers(entry.direction, "needle.direction", dimension);
  const size = Math.hypot(...direction);
  if (Math.abs(size - 1) > 1e-3) throw new PackError(`The needle's direction has length 1; got ${size.toPrecision(4)}. Make the page anew.`);
  return {
    entry: asNumbers(entry.entry, "needle.entry", dimension), direction, lag: asNumber(entry.lag, "needle.lag", 0, 10),
    fastest: asNumber(entry.fastest, "needle.fastest", 1e-3, 1e5), echo: asRecord(entry.echo ?? {}, "needle.echo"),
  };
}

/** @param {Record<string, any>} entry @param {string} what @param {number} dimension @param {number} most @param {number} least @returns {Lattice} */
function lattice(entry, what, dimension, most, least) {
  const shape = asList(entry.shape, `${what}.shape`, dimension, dimension).map((n) => asWhole(n, `${what}.shape`, least, 1e6));
  const spacing = asNumbers(entry.spacing, `${what}.spacing`, dimension), origin = asNumbers(entry.origin, `${what}.origin`, dimension);
  if (shape.reduce((a, b) => a * b) > most || Math.min(...spacing) <= 0) {
    throw new PackError(`The scene's ${what} is not one that a page can hold: ${shape.join(" x ")} points, spacing ${spacing.join(", ")} mm. Make the page anew.`);
  }
  return { shape, spacing, origin };
}

/** @param {Uint8Array} bytes @param {number} start @param {string} name @param {Record<string, any>} entry @returns {Values} */
function arrayView(bytes, start, name, entry) {
  const type = ARRAY_TYPES[/** @type {keyof typeof ARRAY_TYPES} */ (entry.dtype)];
  if (!Object.hasOwn(ARRAY_TYPES, entry.dtype) || !type) throw new PackError(`The scene's array ${shown(name)} is of a type that a page does not read: ${shown(entry.dtype)}.`);
  const shape = asList(entry.shape, `array ${name}`, 0, 8).map((n) => asWhole(n, `array ${name}`, 0, 2 ** 31));
  const offset = asWhole(entry.offset, `array ${name}`, 0, 2 ** 31), coded = (entry.coding ?? null) !== null;
  const coding = coded ? codingOf(entry.coding, `the coding of array ${name}`, entry.dtype, shape) : null;
  const count = coding?.count ?? shape.reduce((a, b) => a * b, 1), size = count * type.BYTES_PER_ELEMENT;
  if (offset % 8 || start + offset + size > bytes.length) {
    throw new PackError(`The scene is cut short: its array ${shown(name)} ends at byte ${start + offset + size} of ${bytes.length}. Make the page anew.`);
  }
  const at = bytes.byteOffset + start + offset;
  const values = at % type.BYTES_PER_ELEMENT === 0 ? new type(/** @type {ArrayBuffer} */ (bytes.buffer), at, count) : new type(bytes.slice(start + offset, start + offset + size).buffer, 0, count);
  return coding ? coding.read(values) : values;
}

/** @param {Values} values @param {Function} type @param {number} count @param {string} what */
function sized(values, type, count, what) {
  if (!(values instanceof type) || values.length !== count) {
    throw new PackError(`The scene says ${count} bytes for ${what}; its array holds ${values.length} of ${values.constructor.name}. Make the page anew.`);
  }
}
