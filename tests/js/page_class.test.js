// The instructor's view: what the server says is read with care, and becomes charts and tables.

import assert from "node:assert/strict";
import { test } from "node:test";

import { LINES } from "../../src/echospline/page/static/chart.js";
import { CLASS_CHARTS, classCells, classChart, classSessions, readClass, standings, traineesOf } from "../../src/echospline/page/static/class.js";
import { WORD_KEYS, wordsOf } from "../../src/echospline/page/static/words.js";

const say = wordsOf("en");
const session = (id, trainee, more = {}) => ({
  id, started: `2026-03-0${id}T10:00:00+00:00`, trainee, exercise: "between", scene: "S", model: "tps", attempt: 1, ended: "finished", examination: false,
  verified: true, difference: "", expert: false, counts: true, success: true, score: { passed: true, final_error: 1.25, time: 8 }, ...more,
});
const curve = (trainee, sessions, values, errors, more = {}) => ({
  trainee, sessions, successes: values.map((value, k) => value > (values[k - 1] ?? 0)), values, passed_at: null, not_counted: 0, metrics: { final_error: errors, time: errors.map(() => 8) }, ...more,
});
const answered = () => ({
  sessions: [session(1, "Ann"), session(2, "Ben", { score: { passed: false, final_error: null, time: 3 }, ended: "reset" }), session(3, "Ann", { verified: false, difference: "time is 4, the page said 3", counts: false }),
    session(4, "", { expert: true }), session(5, "Ann", { scene: "T" })],
  criterion: { threshold: 4.12, unacceptable: 0.4, attempts: 30, risk: 0.05 },
  curves: [
    {
      scene: "S", exercise: "between", trainees: [curve("Ann", [1, 6], [0.4, 0.8], [2, 1], { passed_at: 2, not_counted: 1 }), curve("Ben", [2], [0], [null])],
      median: { trainees: [2, 1], values: [0.2, 0.8], metrics: { final_error: [null, 1], time: [8, 8] } }, expert: { sessions: [4], metrics: { final_error: 0.5, time: null } },
    },
    { scene: "T", exercise: "between", trainees: [curve("Ann", [5], [0.4], [3])], median: { trainees: [1], values: [0.4], metrics: {} }, expert: { sessions: [], metrics: {} } },
  ],
});

test("the curve of LC-CUSUM shows every trainee, the median, the chosen one in front and the threshold", () => {
  const answer = readClass(answered()), chart = classChart(answer, answer.groups[0], "cusum", "Ann", say, "dark");
  assert.deepEqual(chart.lines.map(({ label }) => label), ["", "median of the class", "Ann"]);
  assert.deepEqual(chart.lines.map(({ x, y }) => [x, y]), [[[1], [0]], [[1, 2], [0.2, 0.8]], [[1, 2], [0.4, 0.8]]]);
  assert.equal(chart.lines[2].colour, LINES.dark.one);
  assert.equal(chart.lines[2].dots, true);
  assert.deepEqual([chart.level, chart.levelLabel, chart.counted], [4.12, "proficient", true]);
  const all = classChart(answer, answer.groups[0], "cusum", null, say, "light");
  assert.deepEqual(all.lines.map(({ label }) => label), ["", "", "median of the class"]);
});

test("a metric is shown with its unit and the expert's level, and attempts without a bound leave a gap", () => {
  const answer = readClass(answered()), chart = classChart(answer, answer.groups[0], "final_error", "Ben", say, "dark");
  assert.deepEqual(chart.lines.map(({ x, y }) => [x, y]), [[[1, 2], [2, 1]], [[2], [1]], [[], []]]);
  assert.deepEqual([chart.level, chart.levelLabel, chart.yLabel], [0.5, "expert", "mm"]);
  assert.equal(classChart(answer, answer.groups[0], "time", null, say, "dark").level, undefined, "an expert without a bound has no level");
  assert.equal(classChart(answer, answer.groups[1], "final_error", null, say, "dark").level, undefined, "nor has a group without experts");
});

test("every curve that can be chosen has its words, in every language", () => {
  for (const [name] of CLASS_CHARTS) assert.ok(WORD_KEYS.includes(name), name);
  const answer = readClass(answered());
  for (const language of ["en", "de"]) {
    const words = wordsOf(language);
    for (const [name] of CLASS_CHARTS) classChart(answer, answer.groups[0], name, "", words, "dark");
    for (const one of answer.sessions) assert.ok(classCells(one, words, language).every((text) => text && !text.includes("undefined")));
  }
});

test("standings say how far a trainee is", () => {
  const [ann, ben] = standings(readClass(answered()).groups[0], say);
  assert.deepEqual(ann.cells, ["Ann", "2 (+1)", "2", "0.80", "since attempt 2"]);
  assert.deepEqual(ben.cells, ["Ben", "1", "0", "0", "not yet"]);
});

test("sessions are listed by exercise, scene and trainee, newest first, with why one does not count", () => {
  const answer = readClass(answered()), [group] = answer.groups;
  assert.deepEqual(classSessions(answer, group, null).map(({ id }) => id), [4, 3, 2, 1]);
  assert.deepEqual(classSessions(answer, group, "Ann").map(({ id }) => id), [3, 1]);
  assert.deepEqual(classSessions(answer, null, "Ann").map(({ id }) => id), [5, 3, 1]);
  assert.deepEqual(traineesOf(answer, group), ["Ann", "Ben"]);
  const cells = answer.sessions.map((one) => classCells(one, say, "en"));
  assert.equal(cells[0][7], "same numbers");
  assert.match(cells[2][7], /does not count: time is 4/);
  assert.match(cells[1][4], /^Not passed · Ended by Reset/);
  assert.equal(cells[1][5], "–");
  assert.equal(cells[3][2], "expert");
});

test("a trainee's answer has no median of others, and experts without a name", () => {
  const given = answered(), [group] = given.curves, { median, ...alone } = { ...group, trainees: group.trainees.slice(0, 1) };
  assert.ok(median);
  const answer = readClass({ ...given, sessions: given.sessions.filter(({ trainee }) => trainee === "Ann"), experts: [session(4, "", { expert: true })], curves: [alone] });
  const chart = classChart(answer, answer.groups[0], "final_error", "Ann", say, "dark");
  assert.deepEqual(chart.lines.map(({ label }) => label), ["Ann"]);
  assert.equal(chart.level, 0.5);
  assert.deepEqual(classSessions(answer, answer.groups[0], null).map((one) => classCells(one, say, "en")[2]), ["expert", "Ann", "Ann"]);
});

test("an answer that is no class is refused in a sentence", () => {
  /** @type {((answer: any) => unknown)[]} */
  const damages = [
    () => null, () => [], () => ({}), (a) => ({ ...a, curves: 1 }), (a) => ({ ...a, criterion: { threshold: "4" } }), (a) => ({ ...a, sessions: [{}] }),
    (a) => (a.curves[0].trainees[0].values.push(1), a), (a) => (a.curves[0].trainees[0].successes.pop(), a), (a) => (a.curves[0].trainees[0].passed_at = 9, a),
    (a) => (a.curves[0].median.values = ["x"], a), (a) => (a.curves[0].trainees[0].trainee = { toString: 1 }, a), (a) => (a.sessions[0].score = null, a),
  ];
  for (const damage of damages) assert.throws(() => readClass(damage(answered())), { name: "PackError" }, String(damage));
});

// readClass of what Python answered: tests/test_class.py gives it
test("Python's own answer is read", { skip: !process.env.ECHOSPLINE_CLASS && "run by tests/test_class.py" }, () => {
  const answer = readClass(JSON.parse(process.env.ECHOSPLINE_CLASS ?? ""));
  assert.deepEqual(answer.groups.map((group) => group.trainees.map(({ trainee, sessions }) => [trainee, sessions])), [[["=cmd", [9]], ["Ann", [1, 3]], ["Ben", [2, 4]], ["Eve", [6]]]]);
  assert.equal(answer.sessions.length, 9);
  for (const [name] of CLASS_CHARTS) assert.equal(classChart(answer, answer.groups[0], name, null, say, "dark").lines.filter(({ label }) => label).length, 1);
});
