// Records sessions as the page does, by its engine, attempts and scores, without a document.
// node record_session.mjs PACK MODEL HANDS: for every hand (a list of [entry, tip, steps, pose of the probe in space]) an attempt; prints the file of sessions.

import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";
import { Engine } from "../../src/echospline/page/static/engine.js";
import { Attempt, fileOf } from "../../src/echospline/page/static/training.js";

const [packPath, model, hands] = process.argv.slice(2);
const bytes = new Uint8Array(readFileSync(packPath));
const core = readFileSync(new URL("../../src/echospline/_native/echospline.wasm", import.meta.url));
const sha = (data) => createHash("sha256").update(data).digest("hex");
const engine = await Engine.open(core, bytes);
engine.choose(model);
const { pack } = engine, origin = { version: pack.version, core: sha(core), title: pack.title, pack: sha(bytes) };
const exercise = pack.exercises[0];
const sessions = JSON.parse(hands).map((hand, k) => {
  engine.reset();
  const attempt = new Attempt(exercise, pack.rate, model, false, "Ann", new Date(Date.UTC(2026, 2, 1, 10, k)), pack.probe);
  for (const [entry, tip, steps, held] of hand) {
    if (held) engine.plane = held;
    for (let step = 0; step < steps; ++step) {
      const pose = engine.step({ entry, tip });
      const moved = engine.displacementAt(attempt.places);
      attempt.add(pose, Array.from(attempt.places, (at, i) => at + moved[i]), engine.plane);
    }
  }
  return attempt.session("finished", k + 1, origin);
});
process.stdout.write(fileOf(sessions));
