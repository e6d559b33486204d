// What leaves the page because a person asks: pictures, clips and files, as downloads.

import { Renderer } from "./renderer.js";

/** @import { DrawCommand } from "./draw_list.js" */
/** @typedef {{ at: number, colours: Uint8Array, columns: number, rows: number, list: DrawCommand[] }} Frame */

const SECONDS = 8, RATE = 15; // of a clip, s and frames/s
const MOST_BYTES = 64 << 20; // of memory for it
const MOST_SENT = (64 << 20) - 4096; // bytes of pictures that a server takes, with room for the words before them
const TYPES = ["video/webm;codecs=vp9", "video/webm;codecs=vp8", "video/webm", "video/mp4"];

/** The last seconds of what was drawn, grey pictures and lists of what lay over them, in memory of fixed size. */
export class Reel {
  constructor() {
    /** @type {Frame[]} */
    this.frames = [];
    this.last = -Infinity;
  }

  /** Keep a picture, at most RATE a second. @param {number} now ms @param {Uint8ClampedArray} colours RGBA of grey @param {number} columns @param {number} rows */
  add(now, colours, columns, rows) {
    if (now - this.last < 1000 / RATE - 2) return;
    this.last = now;
    const pixels = columns * rows, most = Math.max(2, Math.min(SECONDS * RATE, Math.floor(MOST_BYTES / pixels)));
    const old = this.frames.length >= most ? this.frames.shift() : undefined;
    const kept = old && old.colours.length === pixels ? old.colours : new Uint8Array(pixels);
    for (let k = 0; k < pixels; ++k) kept[k] = colours[4 * k];
    this.frames.push({ at: now, colours: kept, columns, rows, list: [] });
    while (this.frames.length > 1 && now - this.frames[0].at > 1000 * SECONDS) this.frames.shift();
  }

  /** What lay over the picture that was just kept. @param {number} now ms @param {DrawCommand[]} list */
  over(now, list) {
    if (this.last === now) this.frames[this.frames.length - 1].list = list;
  }

  /**
   * What was kept at an even pace, as files need it that know no other: where nothing moved the last picture is held.
   * @returns {{ frames: Frame[], rate: number }} frames of one size and how many of them a second lasts
   */
  even() {
    const { columns, rows } = this.frames[0], same = this.frames.filter((frame) => frame.columns === columns && frame.rows === rows);
    const first = same[0].at, seconds = (same[same.length - 1].at - first) / 1000;
    const count = Math.max(1, Math.min(Math.round(seconds * RATE) + 1, Math.floor(MOST_SENT / (columns * rows)))), rate = count > 1 ? (count - 1) / seconds : RATE;
    let k = 0;
    const frames = Array.from({ length: count }, (_, n) => {
      const at = first + ((n + 0.5) * 1000) / rate; // a picture that is nearly due is shown: the screen's pace is never quite even
      while (k + 1 < same.length && same[k + 1].at <= at) ++k;
      return same[k];
    });
    return { frames, rate };
  }

  /** Seconds that a clip would last. */
  get seconds() {
    return this.frames.length < 2 ? 0 : (this.frames[this.frames.length - 1].at - this.frames[0].at) / 1000;
  }

  /** Draw the last seconds again, in their own time, and record them. @param {number} width @param {number} height CSS pixels @returns {Promise<Blob>} */
  async record(width, height) {
    const type = typeof MediaRecorder === "undefined" ? undefined : TYPES.find((one) => MediaRecorder.isTypeSupported(one));
    if (!type) throw new Error("it knows no type of video");
    const frames = this.frames.map((frame) => ({ ...frame, colours: frame.colours.slice() }));
    const canvas = newCanvas(width, height), renderer = new Renderer(canvas, newCanvas);
    renderer.resize(2 * Math.round(width / 2), 2 * Math.round(height / 2), 1);
    const stream = canvas.captureStream(RATE), recorder = new MediaRecorder(stream, { mimeType: type, videoBitsPerSecond: 5e6 });
    /** @type {Blob[]} */
    const parts = [];
    recorder.ondataavailable = ({ data }) => parts.push(data);
    const ended = new Promise((done, failed) => {
      recorder.onstop = done;
      recorder.onerror = (event) => failed(/** @type {any} */ (event).error ?? new Error("the recorder failed"));
    });
    const image = new ImageData(frames[0].columns, frames[0].rows), words = new Uint32Array(image.data.buffer);
    recorder.start();
    const start = performance.now();
    for (const { at, colours, list } of frames) {
      const wait = at - frames[0].at - (performance.now() - start);
      if (wait > 0) await new Promise((done) => setTimeout(done, wait));
      for (let k = 0; k < colours.length; ++k) words[k] = (colours[k] * 0x010101) | 0xff000000;
      renderer.picture(image);
      renderer.draw(list);
    }
    await new Promise((done) => setTimeout(done, 1000 / RATE));
    recorder.stop();
    await ended;
    for (const track of stream.getTracks()) track.stop();
    return new Blob(parts, { type });
  }
}

/** @param {number} width @param {number} height @returns {HTMLCanvasElement} */
export function newCanvas(width, height) {
  return Object.assign(document.createElement("canvas"), { width, height });
}

/** @param {HTMLCanvasElement} canvas @returns {Promise<Blob>} */
export function pngOf(canvas) {
  return new Promise((done, failed) => canvas.toBlob((blob) => (blob ? done(blob) : failed(new Error("the browser made no picture"))), "image/png"));
}

/** Give a file to the person. @param {Blob} blob @param {string} name */
export function download(blob, name) {
  const url = URL.createObjectURL(blob);
  Object.assign(document.createElement("a"), { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 10_000);
}

/** A name for a file of this moment. @param {string} what @param {string} ending */
export function fileName(what, ending) {
  return `echospline-${what}-${new Date().toISOString().slice(0, 19).replace(/[T:]/g, "-")}.${ending}`;
}
