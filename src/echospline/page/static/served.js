// What a page does with the server that it came from. Without it nothing of this is there; a server that is lost is said, and the page goes on.

import { ClassView } from "./class_view.js";
import { openDialog } from "./dialogs.js";
import { byId, inputOf, put } from "./panels.js";
import { poseOfMatrix, turnedBy } from "./probe.js";
import { Refusal } from "./server.js";

/** @import { Reel } from "./capture.js" */
/** @import { Engine } from "./engine.js" */
/** @import { ProbePose } from "./probe.js" */
/** @import { Heard, Offer, Server } from "./server.js" */
/** @import { Action, State } from "./state.js" */
/** @import { Store } from "./store.js" */
/** @import { Origin, Session } from "./training.js" */
/**
 * What it needs of the page. `poses` are rows since the last reset, `load` shows another scene, `track` lets a needle from outside steer.
 * @typedef {{
 *   state: () => State, act: (action: Action) => void, engine: () => Engine, reel: Reel, store: Store, named: () => Origin, poses: () => Float64Array,
 *   load: (pack: Uint8Array) => Promise<void>, track: (hand: { entry: number[], tip: number[] }, appears: boolean) => void, notice: (text: string) => void,
 *   say: (key: string, values?: Record<string, string | number>) => string, saved: (blob: Blob, name: string) => void,
 *   replay: (session: Session) => void, expert: (session: Session) => void
 * }} ServedPage
 */

const TAKEN_UP = 400; // ms without a turn after which a phone is taken up anew

export class Served {
  /** @param {Server} server @param {ServedPage} page */
  constructor(server, page) {
    this.server = server;
    this.page = page;
    this.there = false;
    this.lost = false;
    this.tracker = "";
    /** @type {Offer | null} */
    this.offer = null;
    this.handing = false;
    /** How the probe was held when the phone was taken up. @type {ProbePose | null} */
    this.taken = null;
    this.turned = 0;
    this.class = new ClassView({
      ask: (path, init) => server.fetch(path, init), look: () => ({ language: page.state().language, theme: page.state().theme }),
      replay: (session) => page.replay(session), expert: (session) => page.expert(session),
    });
    byId("open-form").addEventListener("submit", (event) => {
      event.preventDefault();
      void this.open();
    });
  }

  /** Ask what there is, and listen. */
  async begin() {
    this.server.listen((heard) => this.hear(heard), (there) => void this.line(there));
    await this.greet();
  }

  async greet() {
    this.offer = await this.server.hello();
    this.tracker = this.offer.tracker;
    const space = this.page.state().held !== null;
    const has = { uploads: this.offer.uploads, fem: this.offer.fem && !space, class: this.offer.instructor, own: !this.offer.instructor, dicom: true, phone: space };
    for (const place of document.querySelectorAll("[data-served]")) /** @type {HTMLElement} */ (place).hidden = !has[/** @type {"fem"} */ (/** @type {HTMLElement} */ (place).dataset.served)];
    this.tell();
  }

  /** @param {boolean} there */
  async line(there) {
    const back = there && this.lost;
    this.there = there;
    this.lost = !there;
    this.tell();
    if (back) await this.greet().catch(() => {});
    if (there) await this.handIn();
  }

  /** State of server and tracker, where there is something to say. */
  tell() {
    const text = this.lost ? this.page.say("server-lost") : this.tracker ? this.page.say("tracker", { text: this.tracker }) : "";
    put(byId("line"), text);
    byId("line").hidden = !text;
  }

  /** @param {Heard} heard */
  hear(heard) {
    const { state, act } = this.page, { held } = state();
    if (heard.tracker !== undefined) {
      this.tracker = heard.tracker;
      this.tell();
    } else if (heard.phone !== undefined) {
      this.taken = null;
      this.page.notice(this.page.say(heard.phone ? "phone-there" : "phone-gone"));
      if (heard.phone) /** @type {HTMLDialogElement} */ (byId("phone")).close();
    } else if (heard.needle && heard.needle.entry.length === state().low.length) this.page.track(heard.needle, heard.needle.appears);
    else if (heard.plane && held) act({ do: "hold-all", pose: heard.plane.length === 16 ? poseOfMatrix(heard.plane) : heard.plane });
    else if (heard.turn && held) {
      const now = performance.now();
      if (!this.taken || now - this.turned > TAKEN_UP) this.taken = held;
      this.turned = now;
      const [x, , z] = held, pose = turnedBy(this.taken, heard.turn);
      act({ do: "hold-all", pose: [x, pose[1], z, pose[3], pose[4], pose[5]] });
    }
  }

  /** Hand in every session that the server does not have yet, oldest first. */
  async handIn() {
    if (this.handing) return;
    this.handing = true;
    try {
      for (const session of this.page.store.waiting()) {
        if (!this.there) break;
        try {
          const taken = await this.server.hand(session);
          await this.page.store.handed(session, taken.number);
          this.page.notice(taken.verified === false ? this.page.say("handed-differs", { number: taken.number, difference: taken.difference.slice(0, 200) }) : this.page.say(taken.verified ? "handed" : "handed-unchecked", { number: taken.number }));
        } catch (error) {
          if (!(error instanceof Refusal)) break; // lost: it is handed in when the server is back
          if (error.status === 429 || error.status === 503) break;
          await this.page.store.handed(session, -1);
          this.page.notice(this.page.say("refused", { reason: error.message }));
        }
      }
    } finally {
      this.handing = false;
    }
  }

  async open() {
    const file = inputOf("open-file").files?.[0], said = byId("open-said");
    if (!file) return put(said, this.page.say("open-none"));
    put(said, this.page.say("open-works"));
    try {
      await this.page.load(await this.server.open(file, inputOf("open-spacing").value.trim()));
      put(said, "");
      /** @type {HTMLDialogElement} */ (byId("open")).close();
      await this.greet();
    } catch (error) {
      put(said, this.words(error));
    }
  }

  /** Compare the model with finite elements at this pose. */
  async fem() {
    const { page } = this, engine = page.engine(), rows = page.poses();
    if (engine.other) {
      engine.show();
      page.act({ do: "comparing", on: false });
      return;
    }
    if (rows.length === 0) return page.notice(page.say("fem-none"));
    page.act({ do: "comparing", on: true });
    page.notice(page.say("fem-works"));
    try {
      const { mean, most } = engine.compare(await this.server.fem(page.named().pack, rows));
      page.act({ do: "touch" });
      page.notice(page.say("fem-differs", { model: engine.model.label, mean: mean.toFixed(2), most: most.toFixed(2) }));
    } catch (error) {
      page.act({ do: "comparing", on: false });
      page.notice(this.words(error));
    }
  }

  async dicom() {
    const { reel } = this.page, { pack } = this.page.engine();
    if (reel.seconds === 0) return this.page.notice(this.page.say("clip-none"));
    const { frames, rate } = reel.even(), { columns, rows } = frames[0], of = pack.probe ?? pack.image;
    const head = { columns, rows, frames: frames.length, samples: 1, spacing: of ? [of.spacing[0], of.spacing[1]] : null, title: pack.title.slice(0, 200) };
    try {
      this.page.saved(await this.server.dicom(head, frames.map((frame) => frame.colours), rate), "echospline.dcm");
    } catch (error) {
      this.page.notice(this.words(error));
    }
  }

  phone() {
    const link = /** @type {HTMLAnchorElement} */ (byId("phone-link"));
    link.href = this.server.phone;
    put(link, this.server.phone);
    openDialog("phone");
  }

  /** @param {unknown} error */
  words(error) {
    return error instanceof Refusal ? error.message : this.page.say("server-lost");
  }
}
