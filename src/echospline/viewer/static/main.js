// The page: one loop at the display's rate that takes the newest frame, draws it and reports.

import { Controls, Needle } from "./controls.js";
import { Training, byId } from "./exercise.js";
import { Link } from "./link.js";
import { Overlay } from "./overlay.js";
import { FROZEN, REPLAYING } from "./protocol.js";
import { Renderer } from "./renderer.js";
import { View } from "./view.js";

/** @import { Frame } from "./protocol.js" */
/** @import { Looks } from "./renderer.js" */

const stage = byId("stage");
const glCanvas = /** @type {HTMLCanvasElement} */ (byId("image"));
const overlayCanvas = /** @type {HTMLCanvasElement} */ (byId("overlay"));
const view = new View();
const needle = new Needle();
/** @type {Looks} */
const looks = { gain: 0, contrast: 1, invert: false, mesh: false, heat: false, heatScale: 0.5, shaft: true, tip: true, reverberation: true, shadow: true };
const shown = { guide: true, arrows: false };
/** @type {any} */
let scene = null;
/** @type {Frame | null} */
let frame = null;
let dirty = true;
let model = "";
let period = 1 / 120; // s between steps of the model
/** @type {string | null} */
let compared = null;
let last = performance.now();
/** @type {number[]} */
let drawTimes = [];
/** @type {number[]} */
let latencies = [];
let noticeTimer = 0;
/** @type {number | null} */
let replayNext = null; // session to replay once its own picture is open
/** @type {number | null} */
let replayTried = null; // the last such session: its picture is opened once

/** @type {Renderer} */
let renderer;
try {
  renderer = new Renderer(glCanvas);
} catch (error) {
  fault(error instanceof Error ? error.message : String(error));
  throw error;
}
const overlay = new Overlay(overlayCanvas);
const link = new Link(told, state);
const training = new Training(link, notice);
const controls = new Controls(stage, view, needle, act);

// --- what the server says

/** @param {any} message */
async function told(message) {
  if (message.tell === "scene") await enter(message);
  else if (message.tell === "running") begin(message);
  else if (message.tell === "summary") {
    controls.enabled = true;
    adopt();
    training.summarise(message);
  } else if (message.tell === "stopped") {
    training.end();
    controls.enabled = true;
    adopt();
  } else if (message.tell === "failure") fault(`The model stopped: ${message.text}. Reset starts it again.`);
  else if (message.tell === "notice") notice(message.text);
  else if (message.tell === "tracker") tracker(message.text);
  else if (message.tell === "elsewhere") elsewhere(message);
}

/** The tracker that steers the needle is lost, or back (no text). @param {string} text */
function tracker(text) {
  fault(text);
  if (!text) notice("The tracker is back.");
}

/** A session of another picture: that picture is opened first, if it is stored. @param {any} message */
function elsewhere(message) {
  if (message.scene === link.scene || message.session === replayTried) {
    notice(message.text);
    return;
  }
  replayNext = replayTried = message.session;
  leave(message.scene);
}

/** Open another scene; an exercise that runs in this one is given up. @param {string} name */
function leave(name) {
  training.end();
  link.open(name);
}

/** @param {any} message */
async function enter(message) {
  scene = frame = null; // nothing is drawn before the scene is whole
  const connection = link.socket;
  const pixels = new Uint8Array(await (await link.fetch(`/api/image?scene=${encodeURIComponent(link.scene)}`)).arrayBuffer());
  if (link.socket !== connection) return; // another connection came meanwhile, with a scene of its own
  scene = message.scene;
  model = message.model;
  period = message.period;
  const { mesh } = scene;
  const [x0, y0] = mesh.origin;
  view.extent = needle.extent = { x0, y0, x1: x0 + (mesh.shape[0] - 1) * mesh.spacing[0], y1: y0 + (mesh.shape[1] - 1) * mesh.spacing[1] };
  const { entry, tip } = message.pose;
  needle.entry = entry;
  needle.depth = Math.hypot(tip[0] - entry[0], tip[1] - entry[1]);
  needle.angle = needle.depth > 0 ? (Math.atan2(tip[1] - entry[1], tip[0] - entry[0]) * 180) / Math.PI : message.resumed ? needle.angle : scene.needle.angle;
  needle.changed = false;
  renderer.setScene(scene, pixels);
  byId("title").textContent = scene.title;
  byId("models").replaceChildren(...scene.models.map(modelButton));
  compared = null;
  showModel();
  setRange("entry", view.extent.x0 + 1, view.extent.x1 - 1, 0.1);
  const lost = training.lost(message.running);
  training.setExercises(scene.exercises, message.running);
  controls.enabled = true;
  fault(lost ? `The server was started again: your run of “${lost}” is lost. Start it once more.` : "");
  resize();
  link.entered = true;
  stage.dataset.ready = "true";
  if (replayNext !== null) link.ask({ do: "replay", session: replayNext });
  replayNext = null;
}

/** @param {any} message */
function begin(message) {
  fault("");
  replayTried = null;
  training.begin(message);
  controls.enabled = !message.replay;
  if (message.replay && scene.models.some((/** @type {any} */ m) => m.name === message.model)) {
    model = message.model;
    showModel();
  }
  home();
}

/** The needle goes back to its entry; the chosen entry and angle stay. */
function home() {
  needle.depth = 0;
  needle.entry = scene.needle.entry;
  needle.changed = false;
}

/** Take the needle where the server has it (after a replay). */
function adopt() {
  if (!frame) return;
  needle.entry = frame.entry;
  const [dx, dy] = [frame.tip[0] - frame.entry[0], frame.tip[1] - frame.entry[1]];
  needle.depth = Math.hypot(dx, dy);
  if (needle.depth > 0.01) needle.angle = (Math.atan2(dy, dx) * 180) / Math.PI;
  needle.changed = false;
}

/** @param {"open" | "lost" | "refused"} how @param {string} reason */
function state(how, reason) {
  const light = byId("connection");
  light.dataset.state = how;
  light.title = { open: "connected", lost: "connection lost", refused: "connection refused" }[how];
  if (how === "lost") fault(reason || "The connection was lost; trying again.");
  else if (how === "refused") fault(reason || "The server refused this page: open the address that it printed, with its token.");
}

// --- models

/** @param {{ name: string, label: string }} entry @param {number} k */
function modelButton(entry, k) {
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = entry.label;
  button.dataset.model = entry.name;
  button.title = `Switch to ${entry.label} in the same pose (${k + 1})`;
  button.addEventListener("click", () => switchModel(entry.name));
  return button;
}

/** @param {string} name */
function switchModel(name) {
  if (training.running) {
    notice("The model stays as it is while an exercise is recorded.");
    return;
  }
  model = name;
  link.ask({ do: "model", name });
  if (compared === name) compare(null);
  showModel();
}

/** @param {string | null} name */
function compare(name) {
  compared = name;
  link.ask({ do: "compare", name });
  if (name !== null) {
    looks.heat = true;
    /** @type {HTMLInputElement} */ (byId("heat")).checked = true;
  }
  showModel();
}

function showModel() {
  for (const button of /** @type {NodeListOf<HTMLButtonElement>} */ (byId("models").querySelectorAll("button"))) {
    button.setAttribute("aria-pressed", String(button.dataset.model === model));
  }
  const select = /** @type {HTMLSelectElement} */ (byId("compare"));
  const others = scene.models.filter((/** @type {any} */ m) => m.name !== model);
  select.replaceChildren(new Option("nothing", ""), ...others.map((/** @type {any} */ m) => new Option(m.label, m.name)));
  select.value = compared ?? "";
  byId("compare-row").hidden = others.length === 0;
}

// --- what a person does

/** @param {string} action */
function act(action) {
  dirty = true;
  if (action === "moved") return;
  if (action.startsWith("model-")) {
    const chosen = scene?.models[Number(action.slice(6))];
    if (chosen) switchModel(chosen.name);
  } else if (action === "reset") {
    if (training.replaying) training.end();
    controls.enabled = true;
    link.ask({ do: "reset" });
    home();
    fault("");
  } else if (action === "freeze") link.ask({ do: "freeze", on: !((frame?.flags ?? 0) & FROZEN) });
  else if (action === "zoom-in") view.zoomBy(1.25);
  else if (action === "zoom-out") view.zoomBy(0.8);
  else if (action === "fit") view.fit();
  else if (action === "compare") {
    const others = scene.models.filter((/** @type {any} */ m) => m.name !== model);
    compare(compared === null && others.length ? others[0].name : null);
  } else if (action === "exercise") training.toggle();
  else if (action === "abandon") training.abandon();
  else if (action === "next-exercise") training.next();
  else if (action === "sessions") training.showSessions();
  else if (action === "help") /** @type {HTMLDialogElement} */ (byId("help")).showModal();
  else {
    const box = /** @type {HTMLInputElement} */ (byId(action));
    box.checked = !box.checked;
    box.dispatchEvent(new Event("change"));
  }
}

for (const button of /** @type {NodeListOf<HTMLButtonElement>} */ (document.querySelectorAll("button[data-act]"))) {
  button.addEventListener("click", () => act(button.dataset.act ?? ""));
}
for (const button of /** @type {NodeListOf<HTMLButtonElement>} */ (document.querySelectorAll("button[data-hold]"))) {
  const code = button.dataset.hold ?? "";
  button.addEventListener("pointerdown", (event) => {
    button.setPointerCapture(event.pointerId);
    controls.hold(code, true);
  });
  for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) button.addEventListener(name, () => controls.hold(code, false));
}
for (const name of /** @type {const} */ (["invert", "mesh", "heat", "shaft", "tip", "reverberation", "shadow"])) {
  byId(name).addEventListener("change", (event) => {
    looks[name] = /** @type {HTMLInputElement} */ (event.target).checked;
    dirty = true;
  });
}
for (const name of /** @type {const} */ (["guide", "arrows"])) {
  byId(name).addEventListener("change", (event) => {
    shown[name] = /** @type {HTMLInputElement} */ (event.target).checked;
    dirty = true;
  });
}
for (const name of /** @type {const} */ (["gain", "contrast"])) {
  byId(name).addEventListener("input", (event) => {
    looks[name] = Number(/** @type {HTMLInputElement} */ (event.target).value);
    dirty = true;
  });
}
range("entry").addEventListener("input", () => controls.enabled && needle.setEntry(Number(range("entry").value)));
range("angle").addEventListener("input", () => controls.enabled && needle.setAngle(Number(range("angle").value)));
range("depth").addEventListener("input", () => controls.enabled && needle.setDepth(Number(range("depth").value)));
byId("compare").addEventListener("change", (event) => compare(/** @type {HTMLSelectElement} */ (event.target).value || null));
byId("open").addEventListener("click", () => /** @type {HTMLDialogElement} */ (byId("upload")).showModal());
byId("upload-form").addEventListener("submit", upload);
// After a click the keys steer again; who tabs to a control keeps it.
document.addEventListener("click", (event) => {
  const target = /** @type {HTMLElement} */ (event.target);
  const control = target.closest("button, summary, input[type=range], input[type=checkbox], input[type=radio]");
  if (event.detail > 0 && control && !control.closest("dialog")) stage.focus({ preventScroll: true });
});
for (const dialog of document.querySelectorAll("dialog")) {
  dialog.addEventListener("click", (event) => event.target === dialog && dialog.close());
  dialog.querySelector("button[data-close]")?.addEventListener("click", () => dialog.close());
}

/** @param {Event} event */
async function upload(event) {
  event.preventDefault();
  const file = /** @type {HTMLInputElement} */ (byId("upload-file")).files?.[0];
  const spacing = /** @type {HTMLInputElement} */ (byId("upload-spacing")).value.trim();
  const said = byId("upload-said");
  if (!file) return;
  said.textContent = "Reading…";
  try {
    const query = new URLSearchParams({ name: file.name, spacing, seat: link.seat });
    const answer = await (await link.fetch(`/api/upload?${query}`, { method: "POST", body: file })).json();
    /** @type {HTMLDialogElement} */ (byId("upload")).close();
    said.textContent = "";
    leave(answer.scene);
  } catch (error) {
    said.textContent = error instanceof Error ? error.message : String(error);
  }
}

// --- what is shown

/** @param {string} id @returns {HTMLInputElement} */
function range(id) {
  return /** @type {HTMLInputElement} */ (byId(`${id}-range`));
}

/** @param {string} id @param {number} low @param {number} high @param {number} step */
function setRange(id, low, high, step) {
  Object.assign(range(id), { min: String(low), max: String(high), step: String(step) });
}

/** @param {string} text */
function notice(text) {
  const line = byId("notice");
  line.textContent = text;
  line.hidden = false;
  clearTimeout(noticeTimer);
  noticeTimer = setTimeout(() => (line.hidden = true), 5000);
}

/** @param {string} text */
function fault(text) {
  const line = byId("fault");
  line.textContent = text;
  line.hidden = !text;
}

function resize() {
  const box = stage.getBoundingClientRect(), ratio = Math.min(devicePixelRatio || 1, 2);
  view.resize(box.width, box.height);
  for (const canvas of [glCanvas, overlayCanvas]) {
    canvas.width = Math.max(1, Math.round(box.width * ratio));
    canvas.height = Math.max(1, Math.round(box.height * ratio));
  }
  dirty = true;
}
new ResizeObserver(resize).observe(stage);

/** @param {string} id @param {string} text */
function put(id, text) {
  const place = byId(id);
  if (place.textContent !== text) place.textContent = text;
}

/** @param {Frame} f */
function readouts(f) {
  put("depth", Math.hypot(f.tip[0] - f.entry[0], f.tip[1] - f.entry[1]).toFixed(1));
  put("angle", needle.angle.toFixed(1));
  put("speed", (Math.abs(f.speed) < 0.05 ? 0 : f.speed).toFixed(1));
  put("largest", f.largest.toFixed(2));
  put("difference", f.reference ? f.difference.toFixed(2) : "–");
  const target = f.watched.length >= 2 && training.running;
  put("target", target ? Math.hypot(f.tip[0] - f.watched[0], f.tip[1] - f.watched[1]).toFixed(1) : "–");
  byId("frozen").hidden = !(f.flags & FROZEN);
  byId("freeze").setAttribute("aria-pressed", String(Boolean(f.flags & FROZEN)));
  setRange("depth", 0, Math.max(needle.deepest, needle.depth), 0.1);
  for (const [id, value] of /** @type {[string, number][]} */ ([["entry", needle.entry[0]], ["angle", needle.angle], ["depth", needle.depth]])) {
    const slider = range(id);
    if (document.activeElement !== slider || Math.abs(Number(slider.value) - value) > 0.2) slider.value = String(value);
    put(`${id}-value`, value.toFixed(1));
  }
  range("entry").disabled = !needle.out;
  Object.assign(stage.dataset, { depth: String(needle.depth), step: String(f.number), model });
}

function slowReadouts() {
  const now = performance.now();
  drawTimes = drawTimes.filter((t) => now - t < 1000);
  const idle = frame !== null && frame.speed === 0 && drawTimes.length <= 14; // the server sends ten a second then
  put("fps", idle ? "at rest" : `${drawTimes.length} frames/s`);
  if (frame) {
    const late = frame.duration > 1000 * period;
    put("step", frame.duration.toFixed(2));
    byId("step").classList.toggle("late", late);
    byId("step").title = late ? `longer than the ${(1000 * period).toFixed(1)} ms between steps: time runs slower than the clock` : "";
  }
  if (latencies.length) {
    latencies.sort((a, b) => a - b);
    put("latency", latencies[latencies.length >> 1].toFixed(0));
    stage.dataset.latency = JSON.stringify(latencies);
    latencies = [];
  }
}
setInterval(slowReadouts, 500);

// A tab that was hidden holds a frame from then: it is passed over, and the present asked for.
document.addEventListener("visibilitychange", () => {
  const old = document.visibilityState === "visible" ? link.take() : null;
  if (!old) return;
  link.drawn = old.number;
  link.command(null);
});

let lastCommand = 0;
/** @param {number} now ms */
function loop(now) {
  requestAnimationFrame(loop);
  const dt = Math.min((now - last) / 1000, 0.1);
  last = now;
  if (!scene) return;
  controls.tick(dt);
  const next = link.take();
  if (next) {
    frame = next;
    if (next.command !== lastCommand && next.sent > link.openedAt) latencies.push(performance.now() - next.sent);
    lastCommand = next.command;
    if (next.flags & REPLAYING) adopt();
  }
  if (frame && (next || dirty)) {
    const wanted = Math.max(0.2, frame.reference ? frame.difference : frame.largest);
    looks.heatScale = wanted > looks.heatScale || wanted < 0.4 * looks.heatScale ? niceScale(wanted) : looks.heatScale;
    renderer.draw(frame, view, looks);
    overlay.draw(frame, view, { ...shown, heat: looks.heat, heatScale: looks.heatScale, angle: needle.angle, exercise: training.running, scene });
    readouts(frame);
    dirty = false;
    drawTimes.push(now);
  }
  if (next) link.drawn = next.number;
  if (next || needle.changed) {
    link.command(needle.changed ? needle.pose : null);
    needle.changed = false;
  }
}
requestAnimationFrame(loop);

/** A full scale that does not flicker. @param {number} value mm */
function niceScale(value) {
  return [0.25, 0.5, 1, 2, 3, 5, 10, 20, 50].find((step) => step >= value) ?? value;
}

if (matchMedia("(max-width: 760px)").matches) {
  for (const section of /** @type {NodeListOf<HTMLDetailsElement>} */ (document.querySelectorAll("details.panel"))) section.open = section.id === "training";
}
