// What an instructor sees of a class, and a trainee of the own sessions: the server's answer, checked, and the tables and charts that follow. Pure.

import { LINES } from "./chart.js";
import { PackError, asList, asNumber, asRecord, asText, asWhole } from "./checked.js";
import { printed } from "./words.js";

/** @import { Chart, ChartLine } from "./chart.js" */
/** @typedef {(key: string, values?: Record<string, string | number>) => string} ClassWords */
/** Values of an attempt each; null is one without bound. @typedef {(number | null)[]} AttemptRow */
/** @typedef {{ trainee: string, sessions: number[], successes: boolean[], values: number[], passedAt: number | null, notCounted: number, metrics: Record<string, AttemptRow> }} TraineeCurve */
/**
 * Curves of an exercise in a scene.
 * @typedef {{
 *   scene: string, exercise: string, trainees: TraineeCurve[], median: { trainees: number[], values: AttemptRow, metrics: Record<string, AttemptRow> },
 *   expert: { sessions: number[], metrics: Record<string, number | null> }
 * }} ClassGroup
 */
/**
 * @typedef {{
 *   id: number, started: string, trainee: string, exercise: string, scene: string, model: string, attempt: number, ended: string, examination: boolean,
 *   verified: boolean | null, difference: string, expert: boolean, counts: boolean, success: boolean, passed: boolean, error: number | null, time: number
 * }} ClassSession
 */
/** @typedef {{ sessions: ClassSession[], threshold: number, unacceptable: number, attempts: number, risk: number, groups: ClassGroup[] }} ClassAnswer */

const MOST_CLASS_SESSIONS = 1_000_000, MOST_CLASS_TRAINEES = 10_000;
/** What a chart can show over the attempts: the curve of LC-CUSUM, and metrics with their units. */
export const CLASS_CHARTS = /** @type {[string, string][]} */ ([["cusum", ""], ["final_error", "mm"], ["time", "s"], ["path_length", "mm"], ["tissue_damage", "mm²"], ["redirections", ""], ["vessel_contacts", ""]]);

/** Read what the server says of a class, or to a trainee, who gets no median of others and experts apart. @param {unknown} value @returns {ClassAnswer} */
export function readClass(value) {
  const given = asRecord(value, "the class"), criterion = asRecord(given.criterion, "criterion");
  return {
    sessions: [...asList(given.sessions, "sessions", 0, MOST_CLASS_SESSIONS), ...asList(given.experts ?? [], "experts", 0, MOST_CLASS_SESSIONS)].map((entry, k) => readClassSession(asRecord(entry, `sessions[${k}]`), `sessions[${k}]`)),
    threshold: asNumber(criterion.threshold, "criterion.threshold", 0), unacceptable: asNumber(criterion.unacceptable, "criterion.unacceptable", 0, 1),
    attempts: asWhole(criterion.attempts, "criterion.attempts", 1, 1e6), risk: asNumber(criterion.risk, "criterion.risk", 0, 1),
    groups: asList(given.curves, "curves", 0, MOST_CLASS_SESSIONS).map((entry, k) => readClassGroup(asRecord(entry, `curves[${k}]`), `curves[${k}]`)),
  };
}

/** @param {Record<string, any>} s @param {string} what @returns {ClassSession} */
function readClassSession(s, what) {
  const score = asRecord(s.score, `${what}.score`), text = (/** @type {string} */ key) => asText(s[key], `${what}.${key}`, 2000);
  return {
    id: asWhole(s.id, `${what}.id`, 1, 2 ** 53), started: text("started"), trainee: text("trainee"), exercise: text("exercise"), scene: text("scene"), model: text("model"),
    attempt: asWhole(s.attempt, `${what}.attempt`, 0, 1e9), ended: text("ended"), examination: s.examination === true,
    verified: s.verified === null ? null : s.verified === true, difference: asText(s.difference, `${what}.difference`, 100_000), expert: s.expert === true,
    counts: s.counts === true, success: s.success === true, passed: score.passed === true,
    error: score.final_error === null ? null : asNumber(score.final_error, `${what}.score.final_error`), time: asNumber(score.time, `${what}.score.time`),
  };
}

/** @param {Record<string, any>} g @param {string} what @returns {ClassGroup} */
function readClassGroup(g, what) {
  const median = asRecord(g.median ?? { trainees: [], values: [], metrics: {} }, `${what}.median`), expert = asRecord(g.expert, `${what}.expert`);
  return {
    scene: asText(g.scene, `${what}.scene`, 2000), exercise: asText(g.exercise, `${what}.exercise`, 2000),
    trainees: asList(g.trainees, `${what}.trainees`, 0, MOST_CLASS_TRAINEES).map((entry, k) => readTraineeCurve(asRecord(entry, `${what}.trainees[${k}]`), `${what}.trainees[${k}]`)),
    median: { trainees: attemptRow(median.trainees, `${what}.median.trainees`).map(Number), values: attemptRow(median.values, `${what}.median.values`), metrics: metricRows(median.metrics, `${what}.median.metrics`) },
    expert: {
      sessions: attemptRow(expert.sessions, `${what}.expert.sessions`).map(Number),
      metrics: Object.fromEntries(Object.entries(asRecord(expert.metrics, `${what}.expert.metrics`)).map(([name, value]) => [name, attemptValue(value, `${what}.expert.metrics`)])),
    },
  };
}

/** @param {Record<string, any>} t @param {string} what @returns {TraineeCurve} */
function readTraineeCurve(t, what) {
  const sessions = attemptRow(t.sessions, `${what}.sessions`).map(Number), n = sessions.length;
  const values = attemptRow(t.values, `${what}.values`).map(Number), successes = asList(t.successes, `${what}.successes`, n, n).map((one) => one === true);
  const metrics = metricRows(t.metrics, `${what}.metrics`);
  if (values.length !== n || Object.values(metrics).some((row) => row.length !== n)) throw new PackError(`${what} has ${n} attempts, and curves of another length.`);
  return {
    trainee: asText(t.trainee, `${what}.trainee`, 200), sessions, successes, values, metrics,
    passedAt: t.passed_at === null ? null : asWhole(t.passed_at, `${what}.passed_at`, 1, n), notCounted: asWhole(t.not_counted, `${what}.not_counted`, 0, MOST_CLASS_SESSIONS),
  };
}

/** @param {unknown} value @param {string} what @returns {Record<string, AttemptRow>} */
function metricRows(value, what) {
  return Object.fromEntries(Object.entries(asRecord(value, what)).map(([name, row]) => [name, attemptRow(row, `${what}.${name}`)]));
}

/** @param {unknown} value @param {string} what @returns {AttemptRow} */
function attemptRow(value, what) {
  return asList(value, what, 0, MOST_CLASS_SESSIONS).map((one) => attemptValue(one, what));
}

/** @param {unknown} value @param {string} what */
function attemptValue(value, what) {
  return value === null ? null : asNumber(value, what, -1e15, 1e15);
}

/** Names of the trainees of a group, or of all. @param {ClassAnswer} answer @param {ClassGroup | null} group */
export function traineesOf(answer, group) {
  const names = (group ? [group] : answer.groups).flatMap((one) => one.trainees.map((curve) => curve.trainee));
  return [...new Set(names)].sort((a, b) => a.localeCompare(b));
}

/**
 * The chart of a group over attempts: every trainee, the group's median, the chosen trainee in front, the expert's level or the threshold.
 * @param {ClassAnswer} answer @param {ClassGroup} group @param {string} shown of CLASS_CHARTS @param {string | null} trainee @param {ClassWords} say @param {"dark" | "light"} theme @returns {Chart}
 */
export function classChart(answer, group, shown, trainee, say, theme) {
  const cusum = shown === "cusum", colours = LINES[theme], quiet = theme === "dark" ? "#4a5a66" : "#b9c4cb";
  const rowOf = (/** @type {{ values: AttemptRow, metrics: Record<string, AttemptRow> }} */ one) => (cusum ? one.values : (one.metrics[shown] ?? []));
  /** @param {string} label @param {string} colour @param {AttemptRow} row @param {boolean} [dots] @returns {ChartLine} */
  const line = (label, colour, row, dots) => {
    const points = row.flatMap((value, k) => (value === null ? [] : [{ x: k + 1, y: value }]));
    return { label, colour, x: points.map(({ x }) => x), y: points.map(({ y }) => y), ...(dots ? { dots } : {}) };
  };
  const chosen = group.trainees.find((one) => one.trainee === trainee);
  const others = group.trainees.filter((one) => one !== chosen).map((one) => line("", quiet, rowOf(one)));
  const level = cusum ? answer.threshold : group.expert.metrics[shown];
  return {
    lines: [
      ...others.filter(({ x }) => x.length), ...(group.median.values.length ? [line(say("class-median"), colours.two, rowOf(group.median))] : []),
      ...(chosen ? [line(chosen.trainee || say("nobody"), colours.one, rowOf(chosen), true)] : []),
    ],
    xLabel: say("plot-attempt"), yLabel: CLASS_CHARTS.find(([name]) => name === shown)?.[1] ?? "", counted: true,
    ...(typeof level === "number" ? { level, levelLabel: say(cusum ? "class-threshold" : "expert") } : {}),
  };
}

/** How far every trainee of a group is: name, attempts, passed, LC-CUSUM, since when proficient; as text. @param {ClassGroup} group @param {ClassWords} say */
export function standings(group, say) {
  return group.trainees.map((one) => ({
    trainee: one.trainee,
    cells: [
      one.trainee || say("nobody"), String(one.sessions.length) + (one.notCounted ? ` (+${one.notCounted})` : ""), String(one.successes.filter((success) => success).length),
      printed(one.values[one.values.length - 1] ?? 0), one.passedAt === null ? say("class-not-yet") : say("class-since", { attempt: one.passedAt }),
    ],
  }));
}

/** Sessions of a group, or all, and of a trainee, newest first. @param {ClassAnswer} answer @param {ClassGroup | null} group @param {string | null} trainee */
export function classSessions(answer, group, trainee) {
  const chosen = answer.sessions.filter((s) => (!group || (s.scene === group.scene && s.exercise === group.exercise)) && (trainee === null || s.trainee === trainee));
  return chosen.sort((a, b) => b.id - a.id);
}

/** Cells of a session's row. @param {ClassSession} s @param {ClassWords} say @param {string} language */
export function classCells(s, say, language) {
  const at = new Date(s.started), ended = s.ended === "finished" ? "" : ` · ${say(s.ended === "reset" ? "ended-reset" : "ended-time")}`;
  return [
    String(s.id), Number.isNaN(at.getTime()) ? s.started : at.toLocaleString(language, { dateStyle: "short", timeStyle: "short" }), s.trainee || say(s.expert ? "expert" : "nobody"), String(s.attempt),
    say(s.passed ? "passed" : "failed") + ended, s.error === null ? "–" : `${printed(s.error)} mm`, `${printed(s.time)} s`,
    s.verified === null ? "–" : s.verified ? say("class-verified") : `${say("class-differs")}: ${s.difference}`,
  ];
}
