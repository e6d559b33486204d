// The summary of an attempt, and the attempts that are kept, with the learning curve.

import { LINES, drawChart } from "./chart.js";
import { byId, element, inputOf, put } from "./panels.js";
import { plotOf } from "./training.js";
import { given, printed, wordsOf } from "./words.js";

/** @import { Session } from "./training.js" */
/** @import { Trace, Score } from "./scoring.js" */
/** @import { State } from "./state.js" */
/** @typedef {(key: string, values?: Record<string, string | number>) => string} Words */

const METRICS = /** @type {[keyof Score, string][]} */ ([
  ["final_error", "mm"], ["target_shift", "mm"], ["time", "s"], ["tissue_time", "s"], ["path_length", "mm"], ["path_inefficiency", "%"], ["tissue_damage", "mm²"],
  ["punctures", ""], ["redirections", ""], ["vessel_contacts", ""], ["picture_time", "s"], ["smoothness", "mm/s²·⁵"],
]);

/** Open a dialog that is not open. @param {string} id */
export function openDialog(id) {
  const dialog = /** @type {HTMLDialogElement} */ (byId(id));
  if (!dialog.open) {
    dialog.showModal();
    dialog.scrollTop = 0; // the button that has the focus can be below what a phone shows
  }
  return dialog;
}

/** Let every dialog close by its buttons and by a press beside it. */
export function closableDialogs() {
  for (const dialog of document.querySelectorAll("dialog")) {
    dialog.addEventListener("click", (event) => event.target === dialog && dialog.close());
    for (const button of dialog.querySelectorAll("[data-close]")) button.addEventListener("click", () => dialog.close());
  }
}

/** Why an attempt passed or did not, as sentences. @param {Session} session @param {Words} say */
export function reasonOf({ score, exercise, ended }, say) {
  if (!score) return "";
  const values = { error: printed(score.final_error ?? 0), radius: printed(exercise.target.radius) };
  const said = [score.final_error === null ? say("why-out") : say(score.final_error > exercise.target.radius ? "why-far" : "why-hit", values)];
  if (score.vessel_contacts) said.push(say("why-vessel", { count: score.vessel_contacts }));
  if (exercise.most_redirections !== null && score.redirections > exercise.most_redirections) said.push(say("why-turns", { count: score.redirections, most: exercise.most_redirections }));
  const text = said.join("; ");
  return `${ended === "finished" ? "" : `${say(`ended-${ended}`)} `}${text[0].toUpperCase()}${text.slice(1)}.`;
}

/**
 * Show an attempt.
 * @param {State} state @param {Session} session @param {Trace} trace @param {Trace | null} expert @param {Session[]} past attempts at this exercise, oldest first
 */
export function showSummary(state, session, trace, expert, past) {
  const say = wordsOf(state.language), colours = LINES[state.theme], { score, exercise } = session;
  if (!score) return;
  put(byId("summary-title"), given(exercise.title, state.language));
  const verdict = byId("verdict");
  put(verdict, say(score.passed ? "passed" : "failed"));
  verdict.className = score.passed ? "verdict passed" : "verdict failed";
  put(byId("why"), reasonOf(session, say));
  byId("metrics").replaceChildren(...METRICS.filter(([name]) => score[name] !== undefined).map(([name, unit]) => {
    const value = score[name];
    return element("tr", {}, element("th", { textContent: say(name), scope: "row" }), element("td", { textContent: value === null ? "–" : `${printed(Number(value))} ${unit}` }));
  }));
  byId("history").hidden = past.length < 2; // before anything is drawn: it changes the room
  openDialog("summary");
  const plot = plotOf(trace), other = expert && plotOf(expert);
  const marks = session.events.filter(([, kind]) => kind === "vessel").map(([step]) => ({ x: step / session.rate, colour: state.theme === "dark" ? "#ff8f8f" : "#b3261e" }));
  drawChart(/** @type {HTMLCanvasElement} */ (byId("summary-plot")), {
    lines: [
      { label: say("plot-distance"), colour: colours.one, x: plot.time, y: plot.distance }, { label: say("plot-depth"), colour: colours.two, x: plot.time, y: plot.depth },
      ...(other ? [{ label: say("plot-expert"), colour: colours.other, x: other.time, y: other.distance }] : []),
    ],
    xLabel: say("plot-time"), yLabel: "mm", level: exercise.target.radius, levelLabel: say("plot-radius"), marks,
  }, state.theme);
  if (past.length >= 2) drawProgress("history-plot", state, past);
}

/** Final error over attempts. @param {string} id @param {State} state @param {Session[]} past oldest first */
export function drawProgress(id, state, past) {
  const say = wordsOf(state.language), hits = past.map((session, k) => /** @type {const} */ ([k + 1, session.score?.final_error])).filter(([, error]) => typeof error === "number");
  drawChart(/** @type {HTMLCanvasElement} */ (byId(id)), {
    lines: [{ label: say("plot-distance"), colour: LINES[state.theme].one, x: hits.map(([k]) => k), y: hits.map(([, error]) => Number(error)), dots: true }],
    xLabel: say("plot-attempt"), counted: true, yLabel: "mm", ...(past.length ? { level: past[past.length - 1].exercise.target.radius, levelLabel: say("plot-radius") } : {}),
  }, state.theme);
}

/**
 * List the attempts, newest first.
 * @param {State} state @param {Session[]} sessions @param {Session | null} expert @param {{ replay: (session: Session) => void, expert: (session: Session) => void }} ask
 */
export function showAttempts(state, sessions, expert, ask) {
  const say = wordsOf(state.language);
  byId("no-sessions").hidden = sessions.length > 0;
  byId("progress").hidden = sessions.length === 0;
  /** @type {HTMLButtonElement} */ (byId("export-all")).disabled = /** @type {HTMLButtonElement} */ (byId("erase")).disabled = sessions.length === 0;
  const titles = new Map(sessions.map((session) => [session.exercise.name, given(session.exercise.title, state.language)])), trainees = [...new Set(sessions.map((session) => session.trainee))];
  options("progress-of", [...titles]);
  options("progress-who", [["", say("everybody")], ...trainees.filter((name) => name).map((name) => /** @type {[string, string]} */ ([name, name]))]);
  byId("session-rows").replaceChildren(...[...sessions].reverse().map((session) => {
    const replay = element("button", { type: "button", textContent: say("replay") });
    replay.addEventListener("click", () => ask.replay(session));
    const beside = element("button", { type: "button", textContent: say("as-expert"), title: say("as-expert-title") });
    beside.setAttribute("aria-pressed", String(session === expert));
    beside.addEventListener("click", () => ask.expert(session));
    const { score } = session, error = score?.final_error ?? null;
    const cells = [
      String(session.attempt), new Date(session.started).toLocaleString(state.language, { dateStyle: "short", timeStyle: "short" }), session.trainee || "–", given(session.exercise.title, state.language),
      score ? say(score.passed ? "passed" : "failed") : "–", error === null ? "–" : `${printed(error)} mm`, score ? `${printed(score.time)} s` : "–",
    ];
    return element("tr", {}, ...cells.map((text) => element("td", { textContent: text })), element("td", {}, replay, beside));
  }));
  openDialog("attempts");
  showCurve(state, sessions);
}

/** The learning curve of the chosen exercise and trainee. @param {State} state @param {Session[]} sessions */
export function showCurve(state, sessions) {
  const name = inputOf("progress-of").value, who = inputOf("progress-who").value;
  const past = sessions.filter((session) => session.exercise.name === name && (!who || session.trainee === who));
  put(byId("progress-count"), wordsOf(state.language)("attempts-shown", { passed: past.filter((session) => session.score?.passed).length, count: past.length }));
  if (past.length) drawProgress("progress-plot", state, past);
}

/** @param {string} id @param {[string, string][]} entries value and words */
function options(id, entries) {
  const select = /** @type {HTMLSelectElement} */ (byId(id)), before = select.value;
  select.replaceChildren(...entries.map(([value, text]) => element("option", { value, textContent: text })));
  if (entries.some(([value]) => value === before)) select.value = before;
}
