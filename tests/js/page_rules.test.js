// Rules that an exercise gives its attempts: entry, help, number.

import assert from "node:assert/strict";
import { test } from "node:test";

import { readExercise } from "../../src/echospline/page/static/scene.js";
import { helpsOf, next } from "../../src/echospline/page/static/state.js";
import { attemptsLeft, attemptsMade } from "../../src/echospline/page/static/training.js";
import { freshState } from "../node/made_pack.mjs";

const started = (rules, lot = 0.25, before = []) => {
  const state = freshState(), exercises = state.exercises.map((one) => (one.name === state.chosen ? { ...one, ...rules } : one));
  return [...before, { do: "start", lot }].reduce(next, { ...state, exercises });
};
const plain = () => ({ name: "a", title: "A", target: { centre: [5, 5], radius: 1 } });

test("an entry that an exercise gives is taken and stays", () => {
  const state = started({ entry: [9, 0] });
  assert.deepEqual(state.needle.entry, [9, 0]);
  assert.deepEqual(next(state, { do: "slide", mm: 3 }).needle.entry, [9, 0]);
});

test("an entry that is drawn lies where the exercise says, and stays", () => {
  for (const [lot, x] of [[0, 6], [0.25, 7], [1, 10]]) {
    const state = started({ entry_between: [6, 10] }, lot);
    assert.equal(state.needle.entry[0], x);
    assert.equal(state.needle.entry[1], state.extent.y0);
    assert.equal(next(state, { do: "entry", x: 20 }).needle.entry[0], x);
  }
});

test("what the exercise says of the entry comes before the examination's rule", () => {
  const state = started({ entry_between: [6, 10] }, 0.5, [{ do: "examination" }, { do: "entryRule", rule: "fixed" }]);
  assert.equal(state.needle.entry[0], 8);
});

test("help is taken away while the exercise is recorded, and comes back", () => {
  const state = started({ help: false });
  assert.deepEqual(helpsOf(state), { guide: false, rings: false, readouts: false, motion: false, body: false });
  assert.deepEqual(helpsOf(next(state, { do: "stop" })), state.help);
});

test("attempts are counted per exercise and trainee, by the highest number", () => {
  const made = (trainee, attempt, name = "a") => ({ exercise: { name }, trainee, attempt });
  const kept = [made("Ann", 1), made("Ann", 5), made("Ben", 1), made("Ann", 9, "b"), made("Ben", 0), made("Ben", 0)];
  assert.equal(attemptsMade(kept, "a", "Ann"), 5);
  assert.equal(attemptsMade(kept, "a", "Ben"), 3);
  assert.equal(attemptsMade(kept, "a", "Eve"), 0);
  assert.equal(attemptsLeft({ ...plain(), attempts: 4 }, kept, "Ben"), 1);
  assert.equal(attemptsLeft({ ...plain(), attempts: 4 }, kept, "Ann"), 0);
  assert.equal(attemptsLeft({ ...plain(), attempts: null }, kept, "Ann"), null);
});

test("rules of an exercise are read with care", () => {
  const read = readExercise({ ...plain(), entry_between: [2, 4], attempts: 3, help: false }, "exercise", 2);
  assert.deepEqual([read.entry, read.entry_between, read.attempts, read.help], [null, [2, 4], 3, false]);
  const bare = readExercise(plain(), "exercise", 2);
  assert.deepEqual([bare.entry, bare.entry_between, bare.attempts, bare.help], [null, null, null, true]);
  for (const wrong of [{ help: "no" }, { attempts: 0 }, { attempts: 1.5 }, { entry: [1] }, { entry: "here" }, { entry_between: [1, 2, 3] }, { entry_between: [null, 2] }]) {
    assert.throws(() => readExercise({ ...plain(), ...wrong }, "exercise", 2), { name: "PackError" }, JSON.stringify(wrong));
  }
});
