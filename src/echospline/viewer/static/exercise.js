// Training: choose an exercise, do it, read the score, look at old sessions.

import { drawChart } from "./chart.js";

/** @import { Link } from "./link.js" */

const METRICS = /** @type {[string, string, string][]} */ ([
  ["final_error", "Tip to target", "mm"],
  ["target_shift", "Target moved by the tissue", "mm"],
  ["time", "Time", "s"],
  ["path_length", "Path length", "mm"],
  ["path_inefficiency", "Path inefficiency", "%"],
  ["tissue_damage", "Tissue damage (area swept)", "mm²"],
  ["punctures", "Punctures", ""],
  ["redirections", "Redirections", ""],
  ["vessel_contacts", "Vessel contacts", ""],
  ["smoothness", "Smoothness (less is smoother)", "mm/s²·⁵"],
]);

export class Training {
  /**
   * @param {Link} link
   * @param {(text: string) => void} notice
   */
  constructor(link, notice) {
    this.link = link;
    this.notice = notice;
    /** @type {any[]} */
    this.exercises = [];
    /** @type {any} */
    this.running = null;
    this.replaying = false;
    this.started = 0;
    this.chosen = "";
    this.list = /** @type {HTMLElement} */ (byId("exercises"));
    this.trainee = /** @type {HTMLInputElement} */ (byId("trainee"));
    this.trainee.value = localStorage.getItem("trainee") ?? "";
    this.trainee.addEventListener("change", () => localStorage.setItem("trainee", this.trainee.value));
    byId("start").addEventListener("click", () => this.toggle());
    byId("abandon").addEventListener("click", () => this.abandon());
    byId("show-sessions").addEventListener("click", () => this.showSessions());
    byId("export-sessions").addEventListener("click", () => this.save("/api/sessions.csv", "echospline-sessions.csv"));
    byId("progress-of").addEventListener("change", () => this.drawProgress());
    byId("again").addEventListener("click", () => {
      this.summary.close();
      this.start();
    });
    byId("watch").addEventListener("click", () => {
      this.summary.close();
      this.link.ask({ do: "replay", session: Number(this.summary.dataset.session) });
    });
    byId("save-trace").addEventListener("click", () => {
      const number = this.summary.dataset.session;
      this.save(`/api/sessions/${number}.csv`, `echospline-session-${number}.csv`);
    });
    this.summary = /** @type {HTMLDialogElement} */ (byId("summary"));
    this.sessions = /** @type {HTMLDialogElement} */ (byId("sessions"));
    /** @type {any[]} */
    this.stored = [];
  }

  /** @param {any[]} exercises @param {string | null} running */
  setExercises(exercises, running) {
    this.exercises = exercises;
    this.list.replaceChildren(
      ...exercises.map((exercise) => {
        const label = element("label", { className: "exercise" });
        const radio = /** @type {HTMLInputElement} */ (element("input", { type: "radio", name: "exercise", value: exercise.name }));
        radio.addEventListener("change", () => this.choose(exercise.name));
        label.append(radio, element("strong", { textContent: exercise.title }), element("span", { textContent: exercise.goal }));
        return label;
      }),
    );
    byId("training").hidden = exercises.length === 0;
    if (exercises.length) this.choose(exercises.some((e) => e.name === this.chosen) ? this.chosen : exercises[0].name);
    this.running = exercises.find((exercise) => exercise.name === running) ?? null;
    this.replaying = false;
    this.show();
  }

  /** @param {string} name */
  choose(name) {
    this.chosen = name;
    for (const radio of /** @type {NodeListOf<HTMLInputElement>} */ (this.list.querySelectorAll("input"))) radio.checked = radio.value === name;
  }

  next() {
    const k = this.exercises.findIndex((exercise) => exercise.name === this.chosen);
    if (this.exercises.length && !this.running) this.choose(this.exercises[(k + 1) % this.exercises.length].name);
  }

  toggle() {
    if (this.running) this.link.ask({ do: "finish", keep: true });
    else this.start();
  }

  start() {
    if (this.chosen) this.link.ask({ do: "start", exercise: this.chosen, trainee: this.trainee.value.slice(0, 80) });
  }

  abandon() {
    if (this.running) this.link.ask({ do: "finish", keep: false });
  }

  /** @param {any} told a "running" message */
  begin(told) {
    this.replaying = told.replay;
    this.running = told.replay ? told.exercise : this.exercises.find((exercise) => exercise.name === told.exercise) ?? null;
    this.started = performance.now();
    this.show();
  }

  /**
   * @param {string | null} running name of the exercise that the server records for this page now
   * @returns {string} title of the exercise that this page was recording and the server knows nothing of; empty if there is none
   */
  lost(running) {
    return this.running && !this.replaying && this.running.name !== running ? this.running.title : "";
  }

  end() {
    this.running = null;
    this.replaying = false;
    this.show();
  }

  show() {
    const start = byId("start");
    start.textContent = this.running ? (this.replaying ? "Stop replay" : "Finish") : "Start";
    start.classList.toggle("primary", true);
    byId("abandon").hidden = !this.running || this.replaying;
    document.body.classList.toggle("recording", Boolean(this.running) && !this.replaying);
    for (const radio of /** @type {NodeListOf<HTMLInputElement>} */ (this.list.querySelectorAll("input"))) radio.disabled = Boolean(this.running);
    const status = byId("exercise-status");
    status.textContent = this.running ? `${this.replaying ? "Replay" : "Recording"}: ${this.running.title}` : "";
  }

  /** @param {any} told a "summary" message */
  summarise(told) {
    this.end();
    const { score, exercise, plot, history } = told;
    this.summary.dataset.session = told.session;
    byId("summary-title").textContent = `${exercise.title}${told.replayed ? " (replayed and scored again)" : ""}`;
    const verdict = byId("verdict");
    verdict.textContent = score.passed ? "Passed" : "Not passed";
    verdict.className = score.passed ? "verdict passed" : "verdict failed";
    byId("why").textContent = why(score, exercise);
    byId("metrics").replaceChildren(
      ...METRICS.map(([name, label, unit]) => {
        const row = element("tr", {});
        const value = score[name];
        row.append(element("th", { textContent: label, scope: "row" }), element("td", { textContent: value === null ? "–" : `${number(value)} ${unit}` }));
        return row;
      }),
    );
    if (!this.summary.open) this.summary.showModal();
    drawChart(/** @type {HTMLCanvasElement} */ (byId("summary-plot")), {
      lines: [
        { label: "tip to target", colour: "#5fd4e0", x: plot.time, y: plot.distance },
        { label: "depth", colour: "#9be7a8", x: plot.time, y: plot.depth },
      ],
      xLabel: "time, s", yLabel: "mm", level: exercise.target.radius, levelLabel: "target radius",
    });
    const past = [...history].reverse().filter((session) => session.score.final_error !== null);
    const progress = /** @type {HTMLCanvasElement} */ (byId("history-plot"));
    byId("history").hidden = past.length < 2;
    if (past.length >= 2) {
      drawChart(progress, {
        lines: [{ label: "tip to target", colour: "#5fd4e0", x: past.map((_, k) => k + 1), y: past.map((s) => s.score.final_error), dots: true }],
        xLabel: "session", counted: true, yLabel: "mm", level: exercise.target.radius, levelLabel: "target radius",
      });
    }
  }

  async showSessions() {
    try {
      this.stored = await (await this.link.fetch("/api/sessions")).json();
    } catch (error) {
      this.notice(String(error));
      return;
    }
    const select = /** @type {HTMLSelectElement} */ (byId("progress-of"));
    const before = select.value;
    const names = [...new Set(this.stored.map((session) => session.exercise))];
    select.replaceChildren(...names.map((name) => element("option", { value: name, textContent: name })));
    if (names.includes(before)) select.value = before;
    byId("no-sessions").hidden = this.stored.length > 0;
    byId("session-table").hidden = byId("progress").hidden = this.stored.length === 0;
    byId("session-rows").replaceChildren(
      ...this.stored.map((session) => {
        const row = element("tr", {});
        const show = /** @type {HTMLButtonElement} */ (element("button", { textContent: "Replay", type: "button" }));
        show.addEventListener("click", () => {
          this.sessions.close();
          this.link.ask({ do: "replay", session: session.id });
        });
        const error = session.score.final_error;
        const cells = [
          String(session.id), session.started.replace("T", " ").slice(0, 16), session.trainee || "–", session.exercise, session.model,
          session.score.passed ? "passed" : "not passed", error === null ? "–" : `${number(error)} mm`, `${number(session.score.time)} s`,
        ];
        row.append(...cells.map((text) => element("td", { textContent: text })));
        const last = element("td", {});
        last.append(show);
        row.append(last);
        return row;
      }),
    );
    if (!this.sessions.open) this.sessions.showModal();
    this.drawProgress();
  }

  drawProgress() {
    const name = /** @type {HTMLSelectElement} */ (byId("progress-of")).value;
    const past = this.stored.filter((session) => session.exercise === name && session.score.final_error !== null).reverse();
    drawChart(/** @type {HTMLCanvasElement} */ (byId("progress-plot")), {
      lines: [{ label: "tip to target", colour: "#5fd4e0", x: past.map((_, k) => k + 1), y: past.map((s) => s.score.final_error), dots: true }],
      xLabel: "session", counted: true, yLabel: "mm",
    });
  }

  /** @param {string} path @param {string} name */
  async save(path, name) {
    try {
      const url = URL.createObjectURL(await (await this.link.fetch(path)).blob());
      /** @type {HTMLAnchorElement} */ (element("a", { href: url, download: name })).click();
      setTimeout(() => URL.revokeObjectURL(url), 10_000);
    } catch (error) {
      this.notice(String(error));
    }
  }
}

/** @param {any} score @param {any} exercise */
function why(score, exercise) {
  const said = [];
  if (score.final_error === null) said.push("the needle was not in the tissue at the end");
  else if (score.final_error > exercise.target.radius) said.push(`the tip ended ${number(score.final_error)} mm from the target's centre (its radius is ${number(exercise.target.radius)} mm)`);
  else said.push(`the tip ended ${number(score.final_error)} mm from the target's centre`);
  if (score.vessel_contacts) said.push(`a vessel was touched ${score.vessel_contacts === 1 ? "once" : `${score.vessel_contacts} times`}`);
  if (exercise.most_redirections !== null && score.redirections > exercise.most_redirections) said.push(`${score.redirections} redirections, ${exercise.most_redirections} allowed`);
  const text = said.join("; ");
  return text[0].toUpperCase() + text.slice(1) + ".";
}

/** @param {number} value */
export function number(value) {
  if (Math.abs(value) < 0.005) return "0";
  return Number.isInteger(value) ? String(value) : value.toFixed(Math.abs(value) < 10 ? 2 : Math.abs(value) < 1000 ? 1 : 0);
}

/** @param {string} id */
export function byId(id) {
  const found = document.getElementById(id);
  if (!found) throw new Error(`no element ${id}`);
  return found;
}

/** @param {string} tag @param {Record<string, any>} properties */
function element(tag, properties) {
  return Object.assign(document.createElement(tag), properties);
}
