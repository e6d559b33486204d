// The server that a page came from, if it came from one: files, sessions, finite elements, recordings, and what steers from outside.

import { asList, asNumber, asNumbers, asRecord, asText, asWhole } from "./checked.js";
import { inBase64 } from "./bytes.js";

/** What a server offers. @typedef {{ version: string, instructor: boolean, fem: boolean, tracker: string, uploads: boolean }} Offer */
/**
 * What reaches a page from outside: a tracked needle, a plane (16 numbers, or x, y, z, yaw, pitch, roll), the turn of a phone (yaw, pitch, roll in
 * degrees since it was taken up), whether a phone is there, and the tracker's trouble in words.
 * @typedef {{
 *   needle?: { entry: number[], tip: number[], appears: boolean }, plane?: number[], turn?: number[], phone?: boolean, tracker?: string
 * }} Heard
 */
/** How a session was taken. @typedef {{ number: number, verified: boolean | null, difference: string }} Taken */

const AGAIN = 2000; // ms between tries to reach a server that is lost
const SUBPROTOCOL = "echospline.1";

/** A server that said no, in its own words. */
export class Refusal extends Error {
  /** @param {number} status @param {string} words */
  constructor(status, words) {
    super(words);
    this.name = "Refusal";
    this.status = status;
  }
}

export class Server {
  /** The server of a page; null for a page of one file. @param {Document} page */
  static find(page) {
    return page.querySelector('meta[name="echospline-server"]') ? new Server(page.location) : null;
  }

  /** @param {Pick<Location, "href" | "hash">} place */
  constructor(place) {
    this.place = place.href;
    this.token = new URLSearchParams(place.hash.slice(1)).get("token") ?? "";
    this.key = Array.from(crypto.getRandomValues(new Uint8Array(16)), (byte) => byte.toString(16).padStart(2, "0")).join("");
  }

  /** @param {string} path @param {RequestInit} [init] @returns {Promise<Response>} */
  fetch(path, init = {}) {
    const headers = { ...(this.token ? { Authorization: `Bearer ${this.token}` } : {}), ...(init.headers ?? {}) };
    return fetch(new URL(path, this.place), { ...init, headers });
  }

  /** The same, where anything but success is a refusal. @param {string} path @param {RequestInit} [init] */
  async ask(path, init) {
    const answer = await this.fetch(path, init);
    if (!answer.ok) throw new Refusal(answer.status, (await answer.text()).slice(0, 400) || `The server refused (${answer.status}).`);
    return answer;
  }

  /** @param {string} path @returns {Promise<Uint8Array<ArrayBuffer>>} */
  async bytes(path) {
    return new Uint8Array(await (await this.ask(path)).arrayBuffer());
  }

  /** @returns {Promise<Offer>} */
  async hello() {
    const h = asRecord(await (await this.ask("api/hello")).json(), "the server's answer");
    return { version: asText(h.version, "version", 80), instructor: h.instructor === true, fem: h.fem === true, tracker: asText(h.tracker ?? "", "tracker", 400), uploads: h.uploads === true };
  }

  /** The pack of a file of the person. @param {File} file @param {string} spacing "0.1" or "0.1,0.2" in mm, or nothing where the file knows */
  async open(file, spacing) {
    const asked = new URLSearchParams({ name: file.name.slice(-100), page: this.key, ...(spacing ? { spacing } : {}) });
    return new Uint8Array(await (await this.ask(`api/open?${asked}`, { method: "POST", body: file })).arrayBuffer());
  }

  /** Hand a session in. @param {unknown} session @returns {Promise<Taken>} */
  async hand(session) {
    const t = asRecord(await (await this.ask("api/sessions", { method: "POST", body: JSON.stringify(session) })).json(), "the server's answer");
    return { number: asWhole(t.number, "number", 0, 2 ** 53), verified: t.verified === null ? null : t.verified === true, difference: asText(t.difference ?? "", "difference", 100_000) };
  }

  /** Displacement of the mesh's nodes by finite elements after poses, mm. @param {string} pack its name @param {Float64Array} rows @returns {Promise<Float32Array>} */
  async fem(pack, rows) {
    const answer = await this.ask(`api/fem?page=${this.key}`, { method: "POST", body: JSON.stringify({ pack, rows: inBase64(rows) }) });
    return new Float32Array(await answer.arrayBuffer());
  }

  /** Frames as a DICOM file. @param {Record<string, unknown>} head @param {Uint8Array[]} frames @param {number} rate frames per second */
  async dicom(head, frames, rate) {
    const body = new Blob([`${JSON.stringify(head)}\n`, ...frames.map((frame) => /** @type {BlobPart} */ (frame))]);
    return await (await this.ask(`api/dicom?${new URLSearchParams({ rate: rate.toFixed(3), page: this.key })}`, { method: "POST", body })).blob();
  }

  /** Address at which a phone becomes the probe of this page. */
  get phone() {
    const place = new URL(`phone?room=${this.key}`, this.place);
    place.hash = this.token ? `token=${this.token}` : "";
    return place.href;
  }

  /** Listen for what steers from outside, and to whether the server is there. @param {(heard: Heard) => void} hear @param {(there: boolean) => void} there */
  listen(hear, there) {
    const place = new URL(`poses?room=${this.key}`, this.place);
    place.protocol = place.protocol === "https:" ? "wss:" : "ws:";
    place.hash = "";
    const line = new WebSocket(place, [SUBPROTOCOL, ...(this.token ? [`token.${this.token}`] : [])]);
    line.addEventListener("open", () => there(true));
    line.addEventListener("message", ({ data }) => {
      const heard = readHeard(data);
      if (heard) hear(heard);
    });
    line.addEventListener("close", () => {
      there(false);
      setTimeout(() => this.listen(hear, there), AGAIN);
    });
  }
}

/** Read a message; null for one that is none. @param {unknown} data @returns {Heard | null} */
export function readHeard(data) {
  try {
    const m = asRecord(JSON.parse(asText(data, "a message", 4096)), "a message");
    if (m.tracker !== undefined) return { tracker: asText(m.tracker, "tracker", 400) };
    if (m.phone !== undefined) return { phone: m.phone === true };
    if (m.turn !== undefined) return { turn: asNumbers(m.turn, "turn", 3) };
    if (m.plane !== undefined) {
      const plane = asList(m.plane, "plane", 6, 16).map((value) => asNumber(value, "plane"));
      return plane.length === 6 || plane.length === 16 ? { plane } : null;
    }
    const entry = asList(m.entry, "entry", 2, 3).map((value) => asNumber(value, "entry")), tip = asNumbers(m.tip, "tip", entry.length);
    return { needle: { entry, tip, appears: m.appears === true } };
  } catch {
    return null; // nothing that steers; the next message will
  }
}
