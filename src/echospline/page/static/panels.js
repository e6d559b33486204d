// The page's controls: what they show follows the state, what a person does with them becomes actions.

import { MOST_TILT } from "./probe.js";
import { deepestOf, helpsOf, isOut, steerable } from "./state.js";
import { given, printed, wordsOf } from "./words.js";

/** @import { Live } from "./draw_list.js" */
/** @import { Pack } from "./scene.js" */
/** @import { Action, State } from "./state.js" */

/** @param {string} id @returns {HTMLElement} */
export function byId(id) {
  const found = document.getElementById(id);
  if (!found) throw new Error(`no element ${id}`);
  return found;
}

/** @param {string} id @returns {HTMLInputElement} */
export function inputOf(id) {
  return /** @type {HTMLInputElement} */ (byId(id));
}

/** @param {string} tag @param {Record<string, any>} properties @param {Node[]} children */
export function element(tag, properties, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

/** Text of an element, changed only where it differs. @param {HTMLElement} place @param {string} text */
export function put(place, text) {
  if (place.textContent !== text) place.textContent = text;
}

/** @param {string} selector @returns {HTMLElement[]} */
function all(selector) {
  return [...document.querySelectorAll(selector)].map((found) => /** @type {HTMLElement} */ (found));
}

export class Panels {
  /**
   * @param {(action: Action) => void} act
   * @param {(command: string) => void} command
   */
  constructor(act, command) {
    /** @type {Pack} */
    this.pack = /** @type {any} */ (null);
    this.act = act;
    this.command = command;
    this.language = "";
    /** @type {State | null} */
    this.shown = null;
    this.sliders = [0, 0, 0, 0, 0, 0].map((_, k) => {
      const range = /** @type {HTMLInputElement} */ (element("input", { type: "range", min: "-20", max: "20", step: "1", value: "0" }));
      range.addEventListener("input", () => act({ do: "timeGain", k, dB: Number(range.value) }));
      const row = element("label", {}, element("span", {}), range, element("output", { ariaLive: "off" }));
      byId("time-gains").append(row);
      return { range, row };
    });
    /** @type {[string, (value: number) => Action][]} */
    const ranges = [
      ["seen", (mm) => ({ do: "seen", mm })], ["gain", (dB) => ({ do: "gain", dB })], ["range", (dB) => ({ do: "range", dB })],
      ["entry", (x) => ({ do: "enter", x })], ["entry-z", (z) => ({ do: "enter", z })], ["heading", (degrees) => ({ do: "heading", degrees })], ["angle", (degrees) => ({ do: "angle", degrees })], ["depth", (mm) => ({ do: "depth", mm })],
    ];
    for (const k of [0, 2, 3, 4, 5]) ranges.push([`probe-${k}`, (value) => ({ do: "hold", k, value })]);
    for (const [id, make] of ranges) inputOf(id).addEventListener("input", () => act(make(Number(inputOf(id).value))));
    inputOf("rule").addEventListener("change", () => act({ do: "entryRule", rule: inputOf("rule").value }));
    for (const box of all("[data-help]")) box.addEventListener("change", () => act({ do: "help", name: box.dataset.help }));
    for (const control of all("[data-do]")) control.addEventListener(control.matches("input") ? "change" : "click", () => command(control.dataset.do ?? ""));
  }

  /** Offer what a scene has. @param {Pack} pack */
  load(pack) {
    this.pack = pack;
    this.shown = null;
    this.language = "";
    document.body.classList.toggle("space", pack.dimension === 3);
    put(byId("title"), pack.title);
    this.choices("exercises", "exercise", pack.exercises.map((one) => [one.name, one.title]), (name) => this.act({ do: "choose", name }));
    this.choices("models", "model", pack.models.map((one) => [one.name, one.label]), (name) => this.command(`model:${name}`));
    byId("training").hidden = pack.exercises.length === 0;
  }

  /** Radio buttons with a title and a sentence. @param {string} id @param {string} name @param {[string, string][]} entries @param {(value: string) => void} chosen */
  choices(id, name, entries, chosen) {
    byId(id).replaceChildren(...entries.map(([value, title]) => {
      const radio = element("input", { type: "radio", name, value });
      radio.addEventListener("change", () => chosen(value));
      return element("label", { className: "choice" }, radio, element("strong", { textContent: title }), element("span", {}));
    }));
  }

  /** Words of the language, into every element that names one. @param {State} state */
  speak({ language }) {
    this.language = language;
    const say = wordsOf(language);
    document.documentElement.lang = language;
    for (const place of all("[data-word]")) put(place, say(place.dataset.word ?? ""));
    for (const place of all("[data-title]")) place.title = say(place.dataset.title ?? "");
    for (const place of all("[data-label]")) place.setAttribute("aria-label", say(place.dataset.label ?? ""));
    for (const place of all("[data-placeholder]")) /** @type {HTMLInputElement} */ (place).placeholder = say(place.dataset.placeholder ?? "");
    for (const place of all(".tools button")) place.setAttribute("aria-label", place.querySelector("span")?.textContent ?? "");
    this.pack.models.forEach((model, k) => put(/** @type {HTMLElement} */ (byId("models").children[k].querySelector("span")), model.sentence[language] ?? model.sentence.en ?? ""));
    this.pack.exercises.forEach((exercise, k) => {
      const [title, goal] = ["strong", "span"].map((part) => /** @type {HTMLElement} */ (byId("exercises").children[k].querySelector(part)));
      put(title, given(exercise.title, language));
      put(goal, given(exercise.goal, language));
    });
  }

  /** @param {State} state @param {number} attempt number of the running attempt */
  show(state, attempt) {
    if (state === this.shown) return;
    if (state.language !== this.language) this.speak(state);
    this.shown = state;
    const say = wordsOf(state.language), { run, replay, look, needle, extent } = state;
    document.body.dataset.theme = state.theme;
    document.body.classList.toggle("recording", run !== null);
    document.body.classList.toggle("replaying", replay !== null);
    for (const [name, on] of /** @type {[string, boolean][]} */ ([["freeze", state.frozen], ["flip", state.view.flip], ["invert", look.invert], ["caliper", state.tool === "caliper"], ["note", state.tool === "note"], ["fem", state.comparing]])) {
      document.querySelector(`.tools [data-do="${name}"]`)?.setAttribute("aria-pressed", String(on));
    }
    /** @type {HTMLButtonElement} */ (document.querySelector('.tools [data-do="freeze"]')).disabled = run !== null;
    this.radios("exercises", state.chosen, run !== null);
    this.radios("models", state.model, run !== null || replay !== null);
    inputOf("examination").checked = run ? run.examination : state.examination;
    inputOf("examination").disabled = inputOf("rule").disabled = run !== null;
    byId("rule-row").hidden = !state.examination;
    inputOf("rule").value = state.entryRule;
    put(byId("start"), say(run ? "finish" : "start"));
    put(byId("status"), run ? say("recording", { attempt, title: given(run.exercise.title, state.language) }) : replay ? say("replaying", { title: given(replay.exercise.title, state.language) }) : "");
    const helps = helpsOf(state), taken = run !== null && (run.examination || run.exercise.help === false);
    for (const box of all("[data-help]")) {
      /** @type {HTMLInputElement} */ (box).checked = helps[/** @type {"guide"} */ (box.dataset.help)];
      /** @type {HTMLInputElement} */ (box).disabled = taken;
    }
    byId("hint").hidden = state.touched;
    this.range("seen", 10, extent.y1 - extent.y0, state.view.depth, `${state.view.depth.toFixed(0)} mm`);
    this.range("gain", -30, 30, look.gain, `${look.gain > 0 ? "+" : ""}${look.gain} dB`);
    this.range("range", 20, 100, look.dynamicRange, `${look.dynamicRange} dB`);
    if (state.held) this.space(state, state.held);
    this.range("entry", state.low[0] + 1, state.high[0] - 1, needle.entry[0], `${needle.entry[0].toFixed(1)} mm`);
    this.range("angle", 8, 172, needle.angle, `${needle.angle.toFixed(1)}°`);
    this.range("depth", 0, Math.max(deepestOf(needle, state), needle.depth), needle.depth, `${needle.depth.toFixed(1)} mm`);
    for (const id of ["angle", "depth", "heading"]) inputOf(id).disabled = !steerable(state);
    inputOf("entry").disabled = inputOf("entry-z").disabled = !steerable(state) || !isOut(needle) || run?.entryFixed === true;
    this.sliders.forEach(({ range, row }, k) => {
      const mm = Math.round((k / (this.sliders.length - 1)) * (extent.y1 - extent.y0));
      range.value = String(look.timeGain[k]);
      range.setAttribute("aria-label", say("time-gain-at", { mm }));
      put(/** @type {HTMLElement} */ (row.children[0]), `${mm} mm`);
      put(/** @type {HTMLElement} */ (row.children[2]), `${look.timeGain[k] > 0 ? "+" : ""}${look.timeGain[k]} dB`);
    });
    byId("player").hidden = replay === null;
    if (replay) {
      inputOf("scrub").max = String(replay.length);
      inputOf("scrub").value = String(Math.round(replay.at));
      put(byId("scrub-time"), `${(replay.at / state.rate).toFixed(1)} / ${(replay.length / state.rate).toFixed(1)} s`);
      const play = byId("play");
      play.setAttribute("aria-label", say(replay.paused ? "play" : "pause"));
      play.querySelector("use")?.setAttribute("href", replay.paused ? "#i-play" : "#i-pause");
      inputOf("speed").value = String(replay.speed);
    }
  }

  /** The second hand's controls. @param {State} state @param {number[]} held */
  space({ low, high, needle }, held) {
    const mm = (/** @type {number} */ value) => `${value.toFixed(1)} mm`, degrees = (/** @type {number} */ value) => `${value.toFixed(0)}°`;
    for (const k of [0, 2]) this.range(`probe-${k}`, low[k], high[k], held[k], mm(held[k]));
    for (const k of [3, 4, 5]) this.range(`probe-${k}`, k === 3 ? -180 : -MOST_TILT, k === 3 ? 180 : MOST_TILT, held[k], degrees(held[k]));
    this.range("entry-z", low[2] + 1, high[2] - 1, needle.entry[2], mm(needle.entry[2]));
    this.range("heading", -180, 180, needle.heading, degrees(needle.heading));
  }

  /** Marks of events on the time line. @param {State} state @param {(step: number) => void} go */
  events(state, go) {
    const say = wordsOf(state.language), length = state.replay?.length ?? 1;
    byId("events").replaceChildren(...(state.replay?.events ?? []).map(([step, kind]) => {
      const known = ["entered", "left", "vessel", "target", "redirection", "lost"].includes(kind) ? say(`event-${kind}`) : kind;
      const mark = element("button", { type: "button", title: `${(step / state.rate).toFixed(1)} s: ${known}`, ariaLabel: `${(step / state.rate).toFixed(1)} s: ${known}` });
      mark.dataset.kind = kind;
      mark.style.left = `${(100 * step) / length}%`;
      mark.addEventListener("click", () => go(step));
      return mark;
    }));
  }

  /** What a reader of the screen finds at the picture; it is asked for, never announced. @param {State} state @param {Live} live */
  spoken(state, live) {
    const say = wordsOf(state.language), helps = helpsOf(state);
    const apart = (/** @type {ArrayLike<number>} */ to) => Math.hypot(...state.low.map((_, d) => live.tip[d] - to[d])), depth = apart(live.entry);
    const near = helps.readouts && live.watched.length >= state.low.length ? ` ${say("spoken-target", { distance: printed(apart(live.watched)) })}` : "";
    put(byId("spoken"), helps.readouts ? `${say("spoken", { depth: depth.toFixed(1), angle: state.needle.angle.toFixed(0) })}${near}` : "");
  }

  /** @param {string} id @param {string} value @param {boolean} disabled */
  radios(id, value, disabled) {
    for (const radio of byId(id).querySelectorAll("input")) {
      radio.checked = radio.value === value;
      radio.disabled = disabled;
    }
  }

  /** @param {string} id @param {number} low @param {number} high @param {number} value @param {string} text */
  range(id, low, high, value, text) {
    const slider = inputOf(id);
    if (slider.min !== String(low)) slider.min = String(low);
    if (slider.max !== String(high)) slider.max = String(high);
    if (Number(slider.value) !== value) slider.value = String(value);
    slider.setAttribute("aria-valuetext", text);
    const output = slider.nextElementSibling;
    if (output) put(/** @type {HTMLElement} */ (output), text);
  }
}
