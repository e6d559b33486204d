// The instructor's view of a class, and a trainee's of the own sessions: a dialog filled from the server. It draws what class.js says.

import { download } from "./capture.js";
import { drawChart } from "./chart.js";
import { CLASS_CHARTS, classCells, classChart, classSessions, readClass, standings, traineesOf } from "./class.js";
import { element, put } from "./panels.js";
import { readSession } from "./training.js";
import { wordsOf } from "./words.js";

/** @import { ClassAnswer } from "./class.js" */
/** @import { Session } from "./training.js" */
/**
 * What the view needs of the page: a fetch that carries the token, how the page looks, and what to do with a session of the class.
 * @typedef {{
 *   ask: (path: string, init?: RequestInit) => Promise<Response>, look: () => { language: string, theme: "dark" | "light" },
 *   replay: (session: Session) => void, expert: (session: Session) => void
 * }} ClassPage
 */

const MOST_CLASS_ROWS = 500; // of the list; the table for a spreadsheet has all

/** Opens on demand; nothing of it is in the document before. */
export class ClassView {
  /** @param {ClassPage} page */
  constructor(page) {
    this.page = page;
    /** @type {ClassAnswer | null} */
    this.answer = null;
    this.chosen = 0;
    this.shown = "cusum";
    /** @type {string | null} all where null */
    this.trainee = null;
    /** Name of the trainee who looks; null for the instructor. @type {string | null} */
    this.own = null;
    this.dialog = /** @type {HTMLDialogElement} */ (element("dialog", { id: "class", className: "class" }));
    this.dialog.setAttribute("aria-labelledby", "class-title");
    this.dialog.addEventListener("click", (event) => event.target === this.dialog && this.dialog.close());
    this.said = element("p", { className: "said" });
    this.said.setAttribute("role", "alert");
  }

  /** Read the class, or the sessions of a trainee, anew and show them. @param {string | null} [own] */
  async open(own = null) {
    this.own = this.trainee = own;
    if (!this.dialog.isConnected) document.body.append(this.dialog);
    await this.read();
    if (!this.dialog.open) this.dialog.showModal();
    this.chart(); // it has a size only now
  }

  async read() {
    put(this.said, "");
    try {
      const answer = await this.page.ask(this.own === null ? "api/class" : `api/sessions?${new URLSearchParams({ trainee: this.own })}`);
      if (!answer.ok) throw new Error(await answer.text());
      this.answer = readClass(await answer.json());
    } catch (error) {
      this.tell(error);
    }
    this.fill();
  }

  /** @param {unknown} error */
  tell(error) {
    put(this.said, error instanceof Error ? error.message : String(error));
  }

  get group() {
    return this.answer?.groups[this.chosen] ?? null;
  }

  fill() {
    const say = this.say, answer = this.answer, group = this.group;
    const close = element("button", { type: "button", className: "primary", textContent: say("close") });
    close.addEventListener("click", () => this.dialog.close());
    const again = element("button", { type: "button", textContent: say("class-again") });
    again.addEventListener("click", () => void this.read());
    this.canvas = /** @type {HTMLCanvasElement} */ (element("canvas", { className: "chart" }));
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", say("class-plot"));
    const choices = element("div", { className: "row" },
      this.select(say("exercise"), (answer?.groups ?? []).map((one, k) => [String(k), several(answer, one.exercise) ? `${one.exercise} · ${one.scene}` : one.exercise]), String(this.chosen), (value) => {
        this.chosen = Number(value);
        this.trainee = this.own;
      }),
      ...(this.own !== null ? [] : [this.select(say("trainee"), [["*", say("everybody")], ...(answer ? traineesOf(answer, group) : []).map((name) => /** @type {[string, string]} */ ([`=${name}`, name || say("nobody")]))], this.trainee === null ? "*" : `=${this.trainee}`, (value) => {
        this.trainee = value === "*" ? null : value.slice(1);
      })]),
      this.select(say("class-shown"), CLASS_CHARTS.map(([name]) => [name, say(name)]), this.shown, (value) => {
        this.shown = value;
      }),
    );
    const meaning = answer ? say("class-meaning", { threshold: answer.threshold.toFixed(2), risk: Math.round(100 * answer.risk), rate: Math.round(100 * answer.unacceptable), attempts: answer.attempts }) : "";
    const empty = !answer?.sessions.length;
    this.dialog.replaceChildren(
      element("h2", { id: "class-title", textContent: say(this.own === null ? "class-title" : "own-title") }), this.said,
      ...(empty ? [element("p", { textContent: answer ? say("no-sessions") : "" })] : [
        choices, this.canvas, element("p", { className: "count", textContent: meaning }),
        ...(group ? [this.table(["trainee", "class-attempts", "class-passed", "cusum", "class-proficient"], standings(group, say).map(({ cells }) => element("tr", {}, ...cells.map((text) => element("td", { textContent: text })))))] : []),
        this.list(),
      ]),
      element("div", { className: "row" }, ...(this.own !== null ? [] : [this.csv("api/class.csv", "echospline-sessions.csv", say("class-csv")), this.csv("api/class/curves.csv", "echospline-curves.csv", say("class-curves-csv"))]), again, element("span", { className: "spring" }), close),
    );
    this.chart();
  }

  get say() {
    return wordsOf(this.page.look().language);
  }

  chart() {
    if (!this.answer || !this.group || !this.canvas?.isConnected) return;
    drawChart(this.canvas, classChart(this.answer, this.group, this.shown, this.trainee, this.say, this.page.look().theme), this.page.look().theme);
  }

  list() {
    const answer = /** @type {ClassAnswer} */ (this.answer), { language } = this.page.look(), say = this.say;
    const rows = classSessions(answer, this.group, this.own === null ? this.trainee : null).slice(0, MOST_CLASS_ROWS).map((session) => {
      const replay = element("button", { type: "button", textContent: say("replay") });
      replay.addEventListener("click", () => void this.fetched(session.id, (whole) => {
        this.dialog.close();
        this.page.replay(whole);
      }));
      const beside = element("button", { type: "button", textContent: say("as-expert"), title: say("as-expert-title") });
      beside.addEventListener("click", () => void this.fetched(session.id, this.page.expert));
      const level = element("button", { type: "button", textContent: say("class-benchmark"), title: say("class-benchmark-title") });
      level.setAttribute("aria-pressed", String(session.expert));
      level.addEventListener("click", () => void this.mark(session.id, !session.expert));
      return element("tr", {}, ...classCells(session, say, language).map((text) => element("td", { textContent: text })), element("td", {}, replay, beside, ...(this.own === null ? [level] : [])));
    });
    return this.table(["number", "started", "trainee", "class-attempt", "result", "final_error", "time", "class-check", ""], rows);
  }

  /** @param {string[]} heads words, or nothing @param {Node[]} rows */
  table(heads, rows) {
    const head = element("thead", {}, element("tr", {}, ...heads.map((key) => element("th", { textContent: key ? this.say(key) : "", scope: "col" }))));
    return element("div", { className: "scroll" }, element("table", { className: "list" }, head, element("tbody", {}, ...rows)));
  }

  /** @param {string} label @param {[string, string][]} entries @param {string} value @param {(value: string) => void} chosen */
  select(label, entries, value, chosen) {
    const choice = /** @type {HTMLSelectElement} */ (element("select", {}, ...entries.map(([name, text]) => element("option", { value: name, textContent: text }))));
    choice.value = value;
    choice.addEventListener("change", () => {
      const place = [...this.dialog.querySelectorAll("select")].indexOf(choice);
      chosen(choice.value);
      this.fill();
      this.dialog.querySelectorAll("select")[place]?.focus();
    });
    return element("label", { className: "field" }, element("span", { textContent: `${label} ` }), choice);
  }

  /** A button that saves a table: a link could not carry the token. @param {string} path @param {string} name @param {string} text */
  csv(path, name, text) {
    const button = element("button", { type: "button", textContent: text });
    button.addEventListener("click", async () => {
      try {
        const answer = await this.page.ask(path);
        if (!answer.ok) throw new Error(await answer.text());
        download(await answer.blob(), name);
      } catch (error) {
        this.tell(error);
      }
    });
    return button;
  }

  /** @param {number} id @param {(session: Session) => void} then */
  async fetched(id, then) {
    try {
      const answer = await this.page.ask(`api/sessions/${id}`);
      if (!answer.ok) throw new Error(await answer.text());
      then(readSession(await answer.json(), `session ${id}`));
    } catch (error) {
      this.tell(error);
    }
  }

  /** @param {number} number @param {boolean} expert */
  async mark(number, expert) {
    try {
      const answer = await this.page.ask("api/class/expert", { method: "POST", body: JSON.stringify({ number, expert }) });
      if (!answer.ok) throw new Error(await answer.text());
      await this.read();
    } catch (error) {
      this.tell(error);
    }
  }
}

/** Whether an exercise of this name is in several scenes. @param {ClassAnswer | null} answer @param {string} exercise */
function several(answer, exercise) {
  return (answer?.groups.filter((one) => one.exercise === exercise).length ?? 0) > 1;
}
