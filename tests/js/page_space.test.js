// Both hands in space: where the probe goes, what the picture then holds, and what is refused.

import assert from "node:assert/strict";
import { test } from "node:test";

import { PackError } from "../../src/echospline/page/static/checked.js";
import { bodyArea } from "../../src/echospline/page/static/body.js";
import { drawList } from "../../src/echospline/page/static/draw_list.js";
import { Engine } from "../../src/echospline/page/static/engine.js";
import { dragged, handed, pressed } from "../../src/echospline/page/static/input.js";
import { lowered, planeMatrix, raised, tipSeen, turnedDown } from "../../src/echospline/page/static/probe.js";
import { readPack } from "../../src/echospline/page/static/scene.js";
import { readHeard } from "../../src/echospline/page/static/server.js";
import { axisOf, next, tipOf } from "../../src/echospline/page/static/state.js";
import { Attempt, readSessions } from "../../src/echospline/page/static/training.js";
import { viewOf } from "../../src/echospline/page/static/view.js";
import { wordsOf } from "../../src/echospline/page/static/words.js";
import { core, manifestInSpace, packedInSpace, stateInSpace } from "../node/made_pack.mjs";

const after = (state, ...actions) => actions.reduce(next, state), say = wordsOf("en");
const near = (a, b, within = 1e-9) => assert.ok(Math.abs(a - b) < within, `${a} is not ${b}`);
const live = (state, more = {}) => ({ entry: state.needle.entry, tip: tipOf(state.needle), speed: 0, watched: [4, 15, 1], expert: null, motion: [], picture: { columns: 101, rows: 101, spacing: [0.3, 0.3], origin: [-15, 0] }, ...more });

test("looking along, the picture holds the whole needle, wherever it heads", () => {
  for (const degrees of [-150, -40, 0, 33, 90, 170]) {
    const state = after(stateInSpace(), { do: "heading", degrees }, { do: "push", mm: 9 }, { do: "over", name: "along" }), m = planeMatrix(state.held);
    near(lowered(m, state.needle.entry)[2], 0);
    near(lowered(m, tipOf(state.needle))[2], 0);
    near(turnedDown(m, axisOf(state.needle))[2], 0);
  }
});

test("looking across, the picture cuts the needle at its tip", () => {
  for (const degrees of [-150, -40, 0, 33, 90]) {
    const state = after(stateInSpace(), { do: "heading", degrees }, { do: "push", mm: 9 }, { do: "over", name: "across" }), m = planeMatrix(state.held), [x, , off] = lowered(m, tipOf(state.needle));
    near(off, 0);
    near(x, 0);
    near(turnedDown(m, axisOf(state.needle))[0], 0, 1e-9);
  }
});

test("the probe stays over the tissue and is tilted no further than a hand can", () => {
  const state = after(stateInSpace(), { do: "probe", slide: 1e4, across: -1e4, tilt: 400, rock: -400, turn: 725 });
  assert.deepEqual(state.held.map((value) => Math.round(value * 1e6) / 1e6), [18, 0, -18, 5, 45, -45]);
});

test("sliding follows the probe's own face, however it is turned", () => {
  const turned = after(stateInSpace(), { do: "probe", turn: 90 }), moved = after(turned, { do: "probe", slide: 5 });
  const [x, , z] = lowered(planeMatrix(turned.held), moved.held.slice(0, 3));
  near(x, 5);
  near(z, 0);
});

test("a press near the skin lets the needle enter where the picture is, a deeper one aims at the place in the picture", () => {
  const turned = after(stateInSpace(), { do: "probe", slide: 3, across: 4, turn: 50 }), screen = (mm) => viewOf(turned.view, turned.extent).toScreen(mm);
  const entered = after(turned, ...pressed(turned, screen([6, 1])));
  const place = raised(planeMatrix(turned.held), [6, 0]);
  near(entered.needle.entry[0], place[0]);
  near(entered.needle.entry[2], place[2]);
  const aimed = after(entered, ...pressed(entered, screen([-2, 14]))), goal = raised(planeMatrix(turned.held), [-2, 14]), axis = axisOf(aimed.needle);
  const way = goal.map((value, d) => value - aimed.needle.entry[d]), size = Math.hypot(...way);
  for (let d = 0; d < 3; ++d) near(axis[d], way[d] / size);
});

test("a needle stays in the tissue on every side", () => {
  for (const heading of [0, 60, 130, -100]) {
    const state = after(stateInSpace(), { do: "heading", degrees: heading }, { do: "angle", degrees: 20 }, { do: "push", mm: 1e6 });
    tipOf(state.needle).forEach((value, d) => assert.ok(value >= state.low[d] - 1e-9 && value <= state.high[d] + 1e-9));
  }
});

test("a drag pushes along what is seen of the needle, and down where it is across", () => {
  const along = after(stateInSpace(), { do: "over", name: "along" }), [a] = dragged(along, "push", [300, 300], [330, 340]), scale = viewOf(along.view, along.extent).scale;
  near(a.mm, (30 * 0.6 + 40 * 0.8) / scale);
  const across = after(stateInSpace(), { do: "angle", degrees: 8 }, { do: "over", name: "across" }), [b] = dragged(across, "push", [300, 300], [300, 340]);
  near(b.mm, 40 / viewOf(across.view, across.extent).scale);
  assert.equal(handed(after(along, { do: "probe", turn: 180 })), -1, "seen from behind, turning is the other way");
});

test("a drag on the small drawing moves the probe and nothing else", () => {
  const state = stateInSpace(), area = bodyArea(state);
  assert.ok(area.right <= state.view.width && area.bottom <= state.view.height);
  const moved = after(state, ...dragged(state, "probe", [700, 500], [720, 490]));
  assert.ok(moved.held[0] > 0 && moved.held[2] > 0);
  assert.deepEqual(moved.needle, state.needle);
  assert.ok(after(state, ...dragged(state, "probe-turn", [700, 500], [720, 500])).held[3] > 5);
});

test("rings are cut by the plane, and are not there where it misses them", () => {
  const state = stateInSpace(), ring = (s) => drawList(s, live(s), say).find((command) => command.draw === "circle" && command.ink === "#ffd166" && command.width === 2);
  near(ring(state).r / viewOf(state.view, state.extent).scale, Math.sqrt(9 - 1));
  assert.equal(ring(after(state, { do: "probe", across: 8 })), undefined);
});

test("a needle that will pass the plane is marked where it will, one in the plane by a line", () => {
  const state = after(stateInSpace(), { do: "push", mm: 4 }), dashes = (s) => drawList(s, live(s), say).filter((command) => command.draw === "line" && command.dash);
  const crosses = (s) => drawList(s, live(s), say).filter((command) => command.draw === "line" && command.ink === "#5fd4e0" && !command.dash && command.width === 2);
  assert.equal(dashes(state).length, 1);
  assert.equal(crosses(state).length, 0);
  const beyond = after(state, { do: "heading", degrees: 30 }, { do: "probe", across: 4 });
  assert.equal(crosses(beyond).length, 2);
});

test("an examination shows no drawing of the body", () => {
  const bars = (s) => drawList(s, live(s), say).filter((command) => command.draw === "shape").length;
  const examined = after(stateInSpace(), { do: "examination" }, { do: "start", lot: 0.3 });
  assert.ok(bars(examined) < bars(stateInSpace()));
  assert.equal(bars(after(stateInSpace(), { do: "help", name: "body" })), bars(examined));
});

test("a tip is in the picture within the slice and the beams alone", () => {
  const { probe } = readPack(packedInSpace()), pose = [0, 0, 0, 0, 0, 0];
  assert.ok(tipSeen(probe, pose, [3, 18, 1.4]) && !tipSeen(probe, pose, [3, 18, 1.6]));
  assert.ok(!tipSeen(probe, pose, [16, 10, 0]) && !tipSeen(probe, pose, [0, 31, 0]));
  assert.ok(tipSeen(probe, [0, 0, 5, 0, 0, 0], [3, 18, 5.5]));
});

test("what an attempt keeps of the probe is where it was moved, and a file of it is read again", () => {
  const pack = readPack(packedInSpace()), attempt = new Attempt(pack.exercises[0], 120, "elastic", false, "", new Date(0), pack.probe), still = pack.probe.pose, moved = [1, 0, 6, 0, 0, 0];
  for (let k = 0; k < 40; ++k) attempt.add({ entry: [-8, 0, 0], tip: [-8 + k / 5, k / 4, 0], speed: 10 }, [4, 15, 1], k < 25 ? still : moved);
  const session = attempt.session("finished", 1, { version: "0.1.0", core: "c", title: "t", pack: "p" });
  assert.deepEqual(attempt.planes, [0, ...still, 25, ...moved]);
  assert.ok(session.score.picture_time > 0 && session.score.picture_time < session.score.tissue_time);
  assert.ok(session.events.some(([step, kind]) => step === 25 && kind === "lost"));
  assert.deepEqual(readSessions(JSON.stringify(session)), [JSON.parse(JSON.stringify(session))]);
  for (const planes of [null, "AAAA", session.planes.slice(0, 20)]) assert.throws(() => readSessions(JSON.stringify({ ...session, planes })), PackError);
});

test("a probe or a volume that lies is refused", () => {
  const lies = [(m) => delete m.probe, (m) => (m.probe.shape = "square"), (m) => (m.probe.columns = 1e6), (m) => (m.probe.pose = [0, 0, 0]), (m) => (m.probe.depth = -1), (m) => (m.volume.shape = [20, 20, 21]), (m) => (m.mesh.shape = [7, 7]), (m) => (m.needle.entry = [0, 0])];
  for (const lie of lies) {
    const given = manifestInSpace();
    lie(given);
    assert.throws(() => readPack(packedInSpace(given)), PackError, String(lie));
  }
});

test("the picture changes with the plane and with the tissue", async () => {
  const engine = await Engine.open(core, packedInSpace()), first = engine.grey().slice();
  engine.plane = [0, 0, 4, 30, 0, 0];
  assert.ok(engine.stale);
  const turned = engine.grey().slice();
  assert.notDeepEqual(turned, first);
  engine.plane = [0, 0, 0, 0, 0, 0];
  assert.deepEqual(engine.grey().slice(), first);
  for (let k = 0; k < 120; ++k) engine.step({ entry: [-8, 0, 0], tip: [-2, 8, 0] });
  assert.notDeepEqual(engine.grey().slice(), first);
  assert.ok(Math.hypot(...engine.displacementAt([-3, 7, 0])) > 0.05);
  const motion = engine.motion({ x0: -15, y0: 0, x1: 15, y1: 30 }, { low: [-18, 0, -18], high: [18, 36, 18] }), [x, y] = [motion[40], motion[41]];
  const u = engine.displacementAt([x, y, 0]);
  near(motion[42] - x, u[0]);
  near(motion[43] - y, u[1]);
});

test("messages from outside are read, and others change nothing", () => {
  assert.deepEqual(readHeard('{"entry": [1, 0], "tip": [2, 3], "appears": true}'), { needle: { entry: [1, 0], tip: [2, 3], appears: true } });
  assert.deepEqual(readHeard('{"plane": [1, 2, 3, 4, 5, 6]}'), { plane: [1, 2, 3, 4, 5, 6] });
  assert.deepEqual(readHeard('{"turn": [1, 2, 3]}'), { turn: [1, 2, 3] });
  assert.deepEqual(readHeard('{"tracker": "lost"}'), { tracker: "lost" });
  for (const bad of ["", "{", "[]", "null", '{"plane": [1]}', '{"plane": [1,2,3,4,5,6,7]}', '{"entry": [1], "tip": [2]}', '{"entry": [1, null], "tip": [2, 3]}', '{"turn": ["a", 1, 2]}', 7]) assert.equal(readHeard(bad), null);
});
