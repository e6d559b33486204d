// Files that a person takes out of the page or brings into it: pictures, clips, attempts.

import { download, fileName, pngOf } from "./capture.js";
import { byId, put } from "./panels.js";
import { fileOf, readSessions } from "./training.js";

/** @import { Reel } from "./capture.js" */
/** @import { Renderer } from "./renderer.js" */
/** @import { Store } from "./store.js" */
/** @import { Session } from "./training.js" */
/** @import { ViewState } from "./view.js" */
/**
 * @typedef {{
 *   reel: Reel, store: Store, renderer: () => Renderer, view: () => ViewState, notice: (text: string) => void, listed: () => void,
 *   say: (key: string, values?: Record<string, string | number>) => string
 * }} FilesPage
 */

export class Files {
  /** @param {FilesPage} page */
  constructor(page) {
    this.page = page;
  }

  async picture() {
    this.saved(await pngOf(this.page.renderer().canvas), fileName("picture", "png"));
  }

  /** The last seconds as a video. */
  async clip() {
    const { reel, say, notice } = this.page, { width, height } = this.page.view();
    if (reel.seconds === 0) return notice(say("clip-none"));
    notice(say("clip-works", { seconds: reel.seconds.toFixed(0) }));
    try {
      const blob = await reel.record(width, height);
      this.saved(blob, fileName("clip", blob.type.includes("mp4") ? "mp4" : "webm"));
    } catch (error) {
      notice(say("clip-refused", { reason: messageOf(error) }));
    }
  }

  /** @param {Session[]} sessions */
  exported(sessions) {
    this.saved(new Blob([fileOf(sessions)], { type: "application/json" }), fileName("sessions", "json"));
  }

  /** @param {File} file */
  async imported(file) {
    try {
      const { store } = this.page, had = new Set(store.sessions.map(identity)), read = readSessions(await file.text());
      const fresh = read.filter((session) => !had.has(identity(session)) && had.add(identity(session))); // a file that is read twice makes no second attempts
      await store.add(fresh);
      this.page.listed();
      this.told(this.page.say("imported", { count: fresh.length }), true);
    } catch (error) {
      this.told(messageOf(error), false);
    }
  }

  /** Say in the dialog of attempts how reading went. @param {string} text @param {boolean} well */
  told(text, well) {
    byId("attempts-said").classList.toggle("well", well);
    put(byId("attempts-said"), text);
  }

  /** @param {Blob} blob @param {string} name */
  saved(blob, name) {
    download(blob, name);
    this.page.notice(this.page.say("saved", { name }));
  }
}

/** What makes two attempts the same one. @param {Session} session */
function identity({ started, trainee, exercise, scene, model, poses }) {
  return JSON.stringify([started, trainee, exercise.name, scene.pack, model, poses]);
}

/** An error as a sentence. @param {unknown} error */
export function messageOf(error) {
  const text = error instanceof Error ? error.message : String(error);
  return /[.!?]$/.test(text) ? text : `${text}.`;
}
