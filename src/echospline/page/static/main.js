// The page: one loop at the screen's rate. It steps the tissue, draws when something has changed, and carries out what is asked.

import { digest, inflated, sha256 } from "./bytes.js";
import { Reel, newCanvas } from "./capture.js";
import { closableDialogs, openDialog, showAttempts, showCurve, showSummary } from "./dialogs.js";
import { drawList } from "./draw_list.js";
import { Engine } from "./engine.js";
import { Files, messageOf } from "./files.js";
import { Film } from "./film.js";
import { Input } from "./input.js";
import { Panels, byId, inputOf, put } from "./panels.js";
import { Renderer } from "./renderer.js";
import { Served } from "./served.js";
import { Server } from "./server.js";
import { anglesOf, helpsOf, initialState, next, tipOf } from "./state.js";
import { Store, keepChoices, keptChoices } from "./store.js";
import { Attempt, attemptsLeft, attemptsMade, landmarksOf, planesOf, posesOf, seenOf } from "./training.js";
import { LANGUAGES, wordsOf } from "./words.js";

/** @import { Live } from "./draw_list.js" */
/** @import { Action, State } from "./state.js" */
/** @import { Origin, Session } from "./training.js" */
/** @import { Trace } from "./scoring.js" */

const LONGEST_FRAME = 0.1; // s of model time that one frame makes up for; a slower screen loses time rather than falling behind
const PANELS = 50; // ms between changes of the panels, which cost the browser a layout
const TRACKED = 1000; // ms that a tracked needle is held after its last word
const MOST_SINCE = 7200 * 7 + 7; // numbers
const STILL = 0.002; // mm that tissue moves before it is drawn again
const NOTICE = 5000; // ms

/** @type {Engine} */
let engine;
/** @type {State} */
let state;
/** @type {Panels} */
let panels;
/** @type {Renderer} */
let renderer;
/** @type {Input} */
let input;
/** @type {Origin} */
let origin;
/** Names of scene and core for the sessions; made when they are first needed, once the picture stands. @type {() => Origin} */
let named = () => origin;
/** @type {Live} */
let live;
/** @type {Attempt | null} */
let attempt = null;
/** @type {Session | null} the attempt that the summary shows */
let summed = null;
/** @type {Session | null} */
let expert = null;
/** @type {Film | null} */
let film = null;
/** @type {Served | null} */
let served = null;
/** @type {Uint8Array<ArrayBuffer>} */
let coreBytes;
/** Rows of poses since the last reset, as many as a server takes, for its finite elements. @type {number[]} */
let since = [];
/** A needle that is steered from outside, and until when. @type {{ entry: number[], tip: number[], until: number } | null} */
let tracked = null;
const store = new Store(), reel = new Reel();
const files = new Files({ reel, store, renderer: () => renderer, view: () => state.view, notice, listed: sessions, say: (key, values) => say(key, values) });
let last = 0, due = 0, shownAt = 0, halted = false, noticeTimer = 0, attemptNumber = 0;
/** @type {State | null} */
let drawnState = null;
/** @type {number[]} */
let drawnSamples = [];
/** Counts that tests and measurements read from the stage's data. */
const counts = { drawn: 0, steps: 0 };

const say = (/** @type {string} */ key, /** @type {Record<string, string | number>} */ values = {}) => wordsOf(state?.language ?? "en")(key, values);

async function begin() {
  const server = Server.find(document), choices = keptChoices(), light = matchMedia("(prefers-color-scheme: light)").matches;
  const bytes = await Promise.all(server ? [server.bytes("core.wasm"), server.bytes("pack")] : ["core", "scene"].map((id) => inflated(byId(id).textContent ?? "")));
  coreBytes = bytes[0];
  inputOf("trainee").value = choices.trainee ?? "";
  renderer = new Renderer(/** @type {HTMLCanvasElement} */ (byId("canvas")), newCanvas);
  panels = new Panels(act, command);
  await showScene(bytes[1], {
    ...(LANGUAGES.includes(choices.language) ? { language: choices.language } : {}),
    theme: choices.theme === "light" || choices.theme === "dark" ? choices.theme : light ? "light" : "dark",
  });
  input = new Input(byId("stage"), () => state, act, command);
  closableDialogs();
  wire();
  new ResizeObserver(fit).observe(byId("stage"));
  requestAnimationFrame(frame);
  await store.open();
  if (/** @type {HTMLDialogElement} */ (byId("attempts")).open) sessions(); // asked for before they were read
  if (!server) return;
  served = new Served(server, {
    state: () => state, act, engine: () => engine, reel, store, named: () => named(), poses: () => Float64Array.from(since), load: (pack) => showScene(pack, { language: state.language, theme: state.theme }),
    track, notice, say, saved: (blob, name) => files.saved(blob, name), replay: (session) => playable(session) && replay(session), expert: (session) => (expert = session),
  });
  await served.begin();
}

/** Show a scene. @param {Uint8Array} packBytes @param {Partial<Pick<State, "language" | "theme">>} kept */
async function showScene(packBytes, kept) {
  const made = await Engine.open(coreBytes, packBytes), { pack } = made;
  engine = made;
  state = initialState(pack, { language: LANGUAGES.includes(pack.language) ? pack.language : "en", ...kept });
  attempt = film = expert = null;
  since = [];
  tracked = null;
  halted = false;
  fault("");
  reel.frames = [];
  origin = { version: pack.version, core: "", title: pack.title, pack: "" };
  const { columns, rows, spacing, origin: first } = pack.probe ?? /** @type {NonNullable<typeof pack.image>} */ (pack.image);
  live = { entry: engine.pose.entry, tip: engine.pose.tip, speed: 0, watched: [], expert: null, motion: [], picture: { columns, rows, spacing: [spacing[0], spacing[1]], origin: [first[0], first[1]] } };
  panels.load(pack);
  fit();
  panels.show(state, attemptNumber);
  named = () => {
    if (!origin.core) origin = { ...origin, core: sha256(coreBytes), pack: sha256(packBytes) };
    return origin;
  };
  setTimeout(async () => {
    const [core, scene] = await Promise.all([coreBytes, packBytes].map((bytes) => digest(/** @type {Uint8Array<ArrayBuffer>} */ (bytes))));
    if (core && scene && engine === made) origin = { ...origin, core, pack: scene };
  }, 500);
}

/** @param {Action} action */
function act(action) {
  state = next(state, action);
}

function fit() {
  const box = byId("stage").getBoundingClientRect();
  renderer.resize(box.width, box.height, devicePixelRatio || 1);
  act({ do: "resize", width: box.width, height: box.height });
  drawnState = null;
}

// --- the loop

/** @param {number} now ms */
function frame(now) {
  requestAnimationFrame(frame);
  const dt = last ? Math.min((now - last) / 1000, LONGEST_FRAME) : 0;
  last = now;
  input.tick(dt);
  try {
    if (state.replay) playOn(dt);
    else if (!state.frozen && !halted) stepOn(dt);
    if (drawnState !== state || hasMoved()) draw(now);
    if (now - shownAt >= PANELS) {
      shownAt = now;
      panels.show(state, attemptNumber);
    }
  } catch (error) {
    halted = true;
    fault(say("stopped", { reason: messageOf(error) }));
  }
}

/** Make the steps that are due. @param {number} dt s */
function stepOn(dt) {
  due += dt * state.rate;
  if (tracked && performance.now() > tracked.until) tracked = null;
  const hand = tracked ?? { entry: state.needle.entry, tip: tipOf(state.needle) };
  for (; due >= 1; --due) {
    const pose = engine.step(hand);
    ++counts.steps;
    if (served && since.length < MOST_SINCE) since.push(...Array.from(pose.entry).slice(0, state.low.length), ...Array.from(pose.tip).slice(0, state.low.length), pose.speed);
    if (!attempt || !state.run) continue;
    attempt.add(pose, watchedNow(attempt.places), state.held);
    if (attempt.steps >= Math.round(attempt.exercise.time_limit * state.rate)) {
      due = 0;
      finish("time");
      return;
    }
  }
  if (attempt && state.run && Math.floor(attempt.steps / state.rate) !== Math.floor(state.run.steps / state.rate)) act({ do: "stepped", steps: attempt.steps });
}

/** A needle that another hand steers. @param {{ entry: number[], tip: number[] }} hand @param {boolean} appears it was not seen before */
function track(hand, appears) {
  if (state.replay) return;
  tracked = { ...hand, until: performance.now() + TRACKED };
  if (appears) {
    if (state.run) finish("reset");
    engine.appear(hand);
    since = [];
  }
  const way = hand.tip.map((value, d) => value - hand.entry[d]), depth = Math.hypot(...way);
  act({ do: "adopt", needle: { ...state.needle, entry: hand.entry, depth, ...(depth > 0.01 ? anglesOf(way) : {}) } });
}

/** Where places lie in the tissue now. @param {number[]} places flat, mm */
function watchedNow(places) {
  const moved = engine.displacementAt(places);
  return places.map((value, k) => value + moved[k]);
}

function hasMoved() {
  if (!engine.stale) return false;
  const now = engine.samples(state);
  return now.length !== drawnSamples.length || now.some((value, k) => Math.abs(value - drawnSamples[k]) > STILL);
}

/** @param {number} now ms */
function draw(now) {
  engine.plane = state.held;
  const pictured = !drawnState || engine.stale || drawnState.look !== state.look;
  const exercise = state.run?.exercise ?? state.replay?.exercise ?? state.exercises.find((one) => one.name === state.chosen);
  const { entry, tip, speed } = engine.pose;
  live = { ...live, entry, tip, speed, watched: exercise ? watchedNow(landmarksOf(exercise)) : [], expert: film && state.replay ? film.expert() : null, motion: helpsOf(state).motion ? engine.motion(state.extent, state) : [] };
  if (engine.stale) drawnSamples = engine.samples(state);
  if (pictured) {
    const colours = engine.draw(state.look);
    renderer.picture(new ImageData(colours, engine.columns, engine.rows));
    reel.add(now, colours, engine.columns, engine.rows);
  }
  const list = drawList(state, live, say);
  renderer.draw(list);
  reel.over(now, list);
  drawnState = state;
  Object.assign(byId("stage").dataset, { ready: "true", drawn: String(++counts.drawn), steps: String(counts.steps), depth: Math.hypot(...state.low.map((_, d) => tip[d] - entry[d])).toFixed(3), plane: state.held?.map((value) => value.toFixed(2)).join(" ") ?? "", model: state.model });
}

// --- training

function start() {
  const chosen = state.exercises.find((one) => one.name === state.chosen), name = inputOf("trainee").value.trim();
  if (chosen && !state.run && attemptsLeft(chosen, store.sessions, name) === 0) return notice(say("no-attempts", { count: chosen.attempts ?? 0 }));
  act({ do: "start", lot: Math.random() });
  if (!state.run) return;
  const trainee = inputOf("trainee").value.trim(), { exercise, examination } = state.run;
  renew();
  attempt = new Attempt(exercise, state.rate, state.model, examination, trainee, new Date(), state.probe);
  attemptNumber = 1 + attemptsMade(store.sessions, exercise.name, trainee);
  drawnState = null;
}

/** End the attempt, keep it, and show it unless the person began anew. @param {"finished" | "reset" | "time"} how */
function finish(how) {
  const made = attempt;
  attempt = null;
  act({ do: "stop" });
  if (!made || made.steps === 0) return;
  const session = made.session(how, attemptNumber, named());
  store.add([session]).then(() => {
    notice(store.refused ? say("not-stored", { reason: store.refused }) : say("stored"));
    void served?.handIn();
  });
  if (how !== "reset") summarise(session, made.trace);
}

/** Needle out, tissue at rest. */
function renew() {
  halted = false;
  fault("");
  film = null;
  due = 0;
  since = [];
  engine.reset(state.needle.entry);
}

/** @param {Session} session @param {Trace} trace */
function summarise(session, trace) {
  summed = session;
  const past = store.sessions.filter((one) => one.exercise.name === session.exercise.name && one.trainee === session.trainee);
  const other = expert && expert !== session && expert.exercise.name === session.exercise.name && expert.steps ? retraced(expert) : null;
  showSummary(state, session, trace, other, past);
}

/** The trace of a kept attempt, by running it again. @param {Session} session @returns {Trace} */
function retraced(session) {
  const poses = posesOf(session), places = landmarksOf(session.exercise), planes = planesOf(session), { probe } = engine.pack;
  return {
    period: 1 / session.rate, dimension: engine.pack.dimension, poses, watched: engine.retrace(session.model, poses, session.rate, places), places: 1 + session.exercise.vessels.length,
    seen: planes && probe ? seenOf(probe, poses, planes) : null,
  };
}

/** Whether this scene can show a session; says why not. @param {Session} session */
function playable(session) {
  const other = session.scene.pack !== named().pack ? say("other-scene") : state.models.includes(session.model) ? "" : say("no-model", { name: session.model });
  files.told(other, false);
  return !other;
}

function sessions() {
  showAttempts(state, store.sessions, expert, {
    replay: (session) => playable(session) && replay(session),
    expert: (session) => {
      if (!playable(session)) return;
      expert = expert === session ? null : session;
      sessions();
    },
  });
}

// --- replay

/** @param {Session} session */
function replay(session) {
  for (const dialog of document.querySelectorAll("dialog")) dialog.close();
  if (session.steps === 0) return;
  if (state.run) finish("reset");
  renew();
  engine.choose(session.model);
  const beside = expert && expert !== session ? posesOf(expert) : null;
  film = new Film(engine, posesOf(session), beside, session.rate, planesOf(session));
  act({ do: "replay", replay: { exercise: session.exercise, model: session.model, length: session.steps, events: session.events, expert: beside !== null } });
  panels.events(state, (step) => act({ do: "scrub", at: step }));
  byId("stage").focus({ preventScroll: true });
}

/** @param {number} dt s */
function playOn(dt) {
  if (!film || !state.replay) return;
  if (!state.replay.paused) act({ do: "played", rows: dt * state.rate * state.replay.speed });
  film.seek(Math.floor(state.replay.at));
  const pose = film.held();
  if (pose && pose.some((value, k) => value !== state.held?.[k])) act({ do: "adoptProbe", pose });
  const needle = film.needle(state.needle), shown = state.needle;
  if (needle.entry[0] !== shown.entry[0] || needle.depth !== shown.depth || needle.angle !== shown.angle) act({ do: "adopt", needle });
}

// --- what is asked

/** @param {string} asked */
function command(asked) {
  const [name, value = ""] = asked.split(":"), done = COMMANDS[name];
  if (done) done(value);
  else if (name.startsWith("model-")) model(state.models[Number(name.slice(6))] ?? state.model);
  else act({ do: name });
}

/** @type {Record<string, (value: string) => void>} */
const COMMANDS = {
  reset: () => {
    if (state.run) finish("reset");
    act({ do: "reset" });
    renew();
  },
  exercise: () => (state.run ? finish("finished") : state.replay ? COMMANDS.leave("") : start()),
  leave: () => {
    act({ do: "leave" });
    renew();
  },
  play: () => act({ do: "pause" }),
  model: (name) => model(name),
  "zoom-in": () => act({ do: "zoom", factor: 1.25 }),
  "zoom-out": () => act({ do: "zoom", factor: 0.8 }),
  guide: () => act({ do: "help", name: "guide" }),
  rings: () => act({ do: "help", name: "rings" }),
  readouts: () => act({ do: "help", name: "readouts" }),
  motion: () => act({ do: "help", name: "motion" }),
  body: () => act({ do: "help", name: "body" }),
  along: () => act({ do: "over", name: "along" }),
  across: () => act({ do: "over", name: "across" }),
  caliper: () => act({ do: "tool", name: "caliper" }),
  note: () => act({ do: "tool", name: "note" }),
  mark: () => (state.tool === "note" ? COMMANDS.write("") : act({ do: "mark" })),
  write: () => {
    if (!state.cursor) act({ do: "cursor" });
    inputOf("write-text").value = "";
    openDialog("write");
  },
  escape: () => state.tool !== "needle" && act({ do: "tool", name: state.tool }),
  flat: () => act({ do: "flatGain" }),
  help: () => void openDialog("help"),
  sessions: () => sessions(),
  language: () => act({ do: "language", name: LANGUAGES[(LANGUAGES.indexOf(state.language) + 1) % LANGUAGES.length] }) ?? kept(),
  theme: () => act({ do: "theme" }) ?? kept(),
  picture: () => void files.picture(),
  clip: () => void files.clip(),
  dicom: () => void served?.dicom(),
  fem: () => void served?.fem(),
  phone: () => served?.phone(),
  open: () => void openDialog("open"),
  class: () => void served?.class.open(),
  own: () => void served?.class.open(inputOf("trainee").value.trim()),
};

/** @param {string} name */
function model(name) {
  if (state.run) return notice(say("model-kept"));
  if (state.replay || name === state.model) return;
  try {
    engine.choose(name);
    act({ do: "model", name });
  } catch (error) {
    notice(messageOf(error));
    drawnState = null;
  }
}

/** Keep the choices for the next visit. */
function kept() {
  keepChoices({ language: state.language, theme: state.theme, trainee: inputOf("trainee").value });
}

// --- wires

function wire() {
  inputOf("scrub").addEventListener("input", () => {
    act({ do: "scrub", at: Number(inputOf("scrub").value) });
    if (!state.replay?.paused) act({ do: "pause" });
  });
  inputOf("speed").addEventListener("change", () => act({ do: "speed", value: Number(inputOf("speed").value) }));
  inputOf("trainee").addEventListener("change", kept);
  byId("again").addEventListener("click", () => {
    /** @type {HTMLDialogElement} */ (byId("summary")).close();
    start();
  });
  byId("watch").addEventListener("click", () => summed && replay(summed));
  byId("export-one").addEventListener("click", () => summed && files.exported([summed]));
  byId("export-all").addEventListener("click", () => files.exported(store.sessions));
  byId("import").addEventListener("click", () => inputOf("import-file").click());
  inputOf("import-file").addEventListener("change", () => {
    const file = inputOf("import-file").files?.[0];
    if (file) void files.imported(file);
    inputOf("import-file").value = "";
  });
  byId("erase").addEventListener("click", () => confirm(say("erase-sure")) && void store.erase().then(sessions));
  for (const id of ["progress-of", "progress-who"]) byId(id).addEventListener("change", () => showCurve(state, store.sessions));
  byId("write-form").addEventListener("submit", () => state.cursor && act({ do: "note", at: state.cursor, text: inputOf("write-text").value }));
  for (const button of document.querySelectorAll("[data-hold]")) {
    const code = /** @type {HTMLElement} */ (button).dataset.hold ?? "";
    button.addEventListener("pointerdown", (event) => {
      button.setPointerCapture(/** @type {PointerEvent} */ (event).pointerId);
      input.hold(code, true);
    });
    for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) button.addEventListener(name, () => input.hold(code, false));
  }
  // After a click the keys steer again; who tabs to a control keeps it.
  document.addEventListener("click", (event) => {
    const target = /** @type {HTMLElement} */ (event.target), control = target.closest("button, summary, input[type=range], input[type=checkbox], input[type=radio]");
    if (event.detail > 0 && control && !control.closest("dialog") && !document.querySelector("dialog[open]")) byId("stage").focus({ preventScroll: true });
  });
  // A dialog gives the focus back to its button; who closes it with the pointer steers on, and Space is Reset again.
  let pointed = false;
  document.addEventListener("click", (event) => (pointed = event.detail > 0), true);
  document.addEventListener("keydown", () => (pointed = false), true);
  for (const dialog of document.querySelectorAll("dialog")) dialog.addEventListener("close", () => pointed && !document.querySelector("dialog[open]") && byId("stage").focus({ preventScroll: true }));
  setInterval(() => panels.spoken(state, live), 500);
  if (matchMedia("(max-width: 640px)").matches) for (const panel of document.querySelectorAll("details.panel:not(#probe-panel)")) /** @type {HTMLDetailsElement} */ (panel).open = false;
}

/** @param {string} text */
function notice(text) {
  const line = byId("notice");
  put(line, text);
  line.hidden = false;
  clearTimeout(noticeTimer);
  noticeTimer = setTimeout(() => (line.hidden = true), NOTICE);
}

/** @param {string} text */
function fault(text) {
  put(byId("fault"), text);
  byId("fault").hidden = !text;
}

begin().catch((error) => fault(messageOf(error)));
