// Packs and files of sessions that lie: each is refused in one sentence, and nothing of them is believed.

import assert from "node:assert/strict";
import { test } from "node:test";

import { PackError } from "../../src/echospline/page/static/checked.js";
import { readPack } from "../../src/echospline/page/static/scene.js";
import { Attempt, fileOf, posesOf, readSessions } from "../../src/echospline/page/static/training.js";
import { LANGUAGES, WORD_KEYS, printed, wordsOf } from "../../src/echospline/page/static/words.js";
import { EXERCISE, manifest, packed, speckle } from "../node/made_pack.mjs";

/** @param {(m: any) => any} change */
const changed = (change) => {
  const given = manifest();
  change(given);
  return packed(given);
};

test("a pack is read as it was written", () => {
  const pack = readPack(packed());
  assert.equal(pack.dimension, 2);
  assert.deepEqual(pack.array("pixels"), speckle(64 * 40));
  assert.deepEqual(pack.models.map((model) => model.name), ["tps", "elastic"]);
  const shifted = new Uint8Array(packed().length + 3);
  shifted.set(packed(), 3);
  assert.deepEqual(readPack(shifted.subarray(3)).array("pixels"), speckle(64 * 40), "at any place in memory");
});

/** @type {[string, () => Uint8Array][]} */
const LIES = [
  ["nothing", () => new Uint8Array(0)], ["other bytes", () => new TextEncoder().encode("<html>not a pack at all</html>")],
  ["cut in its description", () => packed().subarray(0, 60)], ["cut in its arrays", () => packed().subarray(0, packed().length - 8)],
  ["a description that is no JSON", () => packed().fill(33, 12, 20)],
  ["a later format", () => changed((m) => (m.format = 2))],
  ["an image of other size", () => changed((m) => (m.image.columns = 65))], ["an image of negative size", () => changed((m) => (m.image.columns = -64))],
  ["no spacing", () => changed((m) => (m.image.spacing = [0, 0.5]))], ["spacing that is no number", () => changed((m) => (m.image.spacing = ["0.5", 0.5]))],
  ["a mesh too large", () => changed((m) => (m.mesh.shape = [5000, 5000]))], ["a mesh of one node", () => changed((m) => (m.mesh.shape = [1, 10]))],
  ["no models", () => changed((m) => (m.models = []))], ["two models of one name", () => changed((m) => (m.models[1].name = "tps"))],
  ["an unknown kind of model", () => changed((m) => (m.models[0].kind = "magic"))], ["a model with an array that is not there", () => changed((m) => (m.models[0].arrays = { stiffness: "none" }))],
  ["a rate of nothing", () => changed((m) => (m.rate = 0))], ["a direction that is no direction", () => changed((m) => (m.needle.direction = [0, 0]))],
  ["an exercise without target", () => changed((m) => delete m.exercises[0].target)], ["a target of no size", () => changed((m) => (m.exercises[0].target.radius = 0))],
  ["an endless name", () => changed((m) => (m.exercises[0].title = "x".repeat(100000)))],
  ["an array of no type", () => packed(manifest(), undefined, (table) => ({ pixels: { ...table.pixels, dtype: "complex64" } }))],
  ["an array of a type of JavaScript's own", () => packed(manifest(), undefined, (table) => ({ pixels: { ...table.pixels, dtype: "constructor" } }))],
  ["an array beyond the end", () => packed(manifest(), undefined, (table) => ({ pixels: { ...table.pixels, offset: 1 << 20 } }))],
  ["an array at a crooked place", () => packed(manifest(), undefined, (table) => ({ pixels: { ...table.pixels, offset: 3 } }))],
  ["an array of endless shape", () => packed(manifest(), undefined, (table) => ({ pixels: { ...table.pixels, shape: [2 ** 30, 2 ** 30, 2 ** 30] } }))],
  ["another type for the image", () => packed(manifest(), { pixels: new Float32Array(64 * 40) })],
];
for (const [name, bytes] of LIES) {
  test(`a pack that lies is refused: ${name}`, () => assert.throws(() => readPack(bytes()), (error) => {
    assert.ok(error instanceof PackError, String(error));
    assert.ok(error.message.length < 300 && /[.]$/.test(error.message) && !error.message.includes("\n"), error.message);
    return true;
  }));
}

/** A session of a few steps. */
function session() {
  const attempt = new Attempt(EXERCISE, 120, "tps", false, 'Ann "<b>"', new Date(0));
  for (let k = 0; k < 30; ++k) attempt.add({ entry: [8, 0], tip: [8 + k / 5, k / 4], speed: 30 }, [18, 9, 11, 5]);
  return attempt.session("finished", 1, { version: "0.1.0", core: "c", title: "Small", pack: "p" });
}

test("sessions are read as they were written, one or several", () => {
  const one = session();
  assert.deepEqual(readSessions(JSON.stringify(one)), [JSON.parse(JSON.stringify(one))]);
  assert.equal(readSessions(fileOf([one, one])).length, 2);
  assert.deepEqual(Array.from(posesOf(readSessions(JSON.stringify(one))[0]).subarray(145, 150)), [8, 0, 8 + 29 / 5, 29 / 4, 30]);
});

/** @type {[string, (s: any) => any][]} */
const FALSE = [
  ["of another kind", (s) => (s.kind = "recipe")], ["of another format", (s) => (s.format = 7)], ["poses cut", (s) => (s.poses = s.poses.slice(0, -8))],
  ["poses that are no base64", (s) => (s.poses = "\u0000".repeat(s.poses.length))], ["steps that are not there", (s) => (s.steps = 1e6)], ["poses that are no numbers", (s) => (s.poses = Buffer.from(new Float64Array(150).fill(NaN).buffer).toString("base64"))],
  ["an end that there is not", (s) => (s.ended = "never")], ["a time that is none", (s) => (s.started = "soon")], ["a trainee without end", (s) => (s.trainee = "x".repeat(1000))],
  ["a score of words", (s) => (s.score.time = "fast")], ["an event of no kind", (s) => (s.events = [[1]])], ["an exercise that is a list", (s) => (s.exercise = [])], ["attempts in halves", (s) => (s.attempt = 1.5)],
];
for (const [name, change] of FALSE) {
  test(`a session that lies is refused: ${name}`, () => {
    const given = JSON.parse(JSON.stringify(session()));
    change(given);
    assert.throws(() => readSessions(JSON.stringify(given)), PackError);
  });
}

test("a file that is no JSON, or holds something else, is refused", () => {
  for (const text of ["", "{", "[]", "null", '{"format": 1, "kind": "echospline sessions", "sessions": {}}', '"a"']) assert.throws(() => readSessions(text), PackError);
});

test("both languages have every word, and none is left of a place to fill in", () => {
  assert.equal(LANGUAGES.length, 2);
  const values = new Proxy({}, { get: () => "7", has: () => true });
  for (const key of WORD_KEYS) {
    const [english, german] = LANGUAGES.map((language) => wordsOf(language)(key, values));
    assert.ok(english && german && !/[{}]/.test(english + german), key);
  }
  assert.throws(() => wordsOf("en")("no such key"), /no such key/);
});

test("numbers are printed with as many digits as they deserve", () => assert.deepEqual([0.001, 3, 2.345, 23.45, 2345.6].map(printed), ["0", "3", "2.35", "23.4", "2346"]));
