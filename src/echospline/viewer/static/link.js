// The connection: newest frame in, newest needle out, and a way back after the server went.

import { decodeFrame, encodeCommand } from "./protocol.js";

/** @import { Frame, Pose } from "./protocol.js" */

const SUBPROTOCOL = "echospline.1";
const LONGEST_WAIT = 8000; // ms between attempts to connect

/** @returns {string} token from the address (then kept for this tab, and out of sight) */
function token() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (given) {
    sessionStorage.setItem("token", given);
    history.replaceState(null, "", location.pathname + location.search);
  }
  return sessionStorage.getItem("token") ?? "";
}

/** @returns {string} what this tab is known by, so that a reload finds its engine again */
function seat() {
  let key = sessionStorage.getItem("seat");
  if (!key) {
    key = [...crypto.getRandomValues(new Uint8Array(16))].map((byte) => byte.toString(16).padStart(2, "0")).join("");
    sessionStorage.setItem("seat", key);
  }
  return key;
}

export class Link {
  /**
   * @param {(told: any) => void} onTold called with each JSON message
   * @param {(state: "open" | "lost" | "refused", reason: string) => void} onState
   */
  constructor(onTold, onState) {
    this.onTold = onTold;
    this.onState = onState;
    this.token = token();
    this.seat = seat();
    this.scene = sessionStorage.getItem("scene") ?? "";
    /** @type {Frame | null} newest frame, until it is taken */
    this.newest = null;
    this.received = 0;
    this.commands = 0;
    this.drawn = 0; // number of the newest frame drawn on this connection
    this.entered = false; // whether its scene is shown: before that nothing is reported
    this.openedAt = 0;
    this.wait = 250;
    /** @type {WebSocket | null} */
    this.socket = null;
    this.connect();
  }

  connect() {
    const address = new URL("/live", location.href);
    address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    address.search = new URLSearchParams({ seat: this.seat, scene: this.scene }).toString();
    const socket = new WebSocket(address, this.token ? [SUBPROTOCOL, `token.${this.token}`] : [SUBPROTOCOL]);
    this.socket = socket;
    this.commands = this.drawn = 0;
    this.entered = false;
    this.openedAt = performance.now();
    this.newest = null;
    socket.binaryType = "arraybuffer";
    let opened = false;
    socket.onmessage = (event) => {
      if (typeof event.data === "string") {
        opened = true;
        this.wait = 250;
        this.onState("open", "");
        this.onTold(JSON.parse(event.data));
      } else {
        this.newest = decodeFrame(event.data);
        this.received += 1;
      }
    };
    socket.onclose = (event) => {
      if (this.socket !== socket) return;
      if (event.code === 4404) this.useScene("");
      this.onState(event.code === 1008 ? "refused" : "lost", event.reason);
      if (event.code === 1008) return;
      if (!opened) this.askWhy();
      setTimeout(() => this.socket === socket && this.connect(), this.wait);
      this.wait = Math.min(2 * this.wait, LONGEST_WAIT);
    };
  }

  /** A socket that was never opened gives no reason; a plain request does. */
  async askWhy() {
    try {
      const answer = await fetch("/api/sessions", { headers: this.token ? { Authorization: `Bearer ${this.token}` } : {} });
      if (answer.status === 401) this.onState("refused", await answer.text());
    } catch {
      // the server is not there: that was said already
    }
  }

  /** @returns {Frame | null} the newest frame, once */
  take() {
    const frame = this.newest;
    this.newest = null;
    return frame;
  }

  /**
   * Report what was drawn, and where the needle shall go.
   * @param {Pose | null} pose
   */
  command(pose) {
    if (this.socket?.readyState !== WebSocket.OPEN || !this.entered) return;
    this.commands += 1;
    this.socket.send(encodeCommand(this.drawn, this.commands, performance.now(), pose));
  }

  /** @param {object} request */
  ask(request) {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(request));
  }

  /** @param {string} name of a scene; empty for the one that the server began with */
  useScene(name) {
    this.scene = name;
    sessionStorage.setItem("scene", name);
  }

  /** Leave this scene's engine and open another scene. @param {string} name */
  open(name) {
    this.useScene(name);
    const old = this.socket;
    this.socket = null;
    old?.close();
    this.connect();
  }

  /**
   * @param {string} path
   * @param {RequestInit} [options]
   * @returns {Promise<Response>} a good one
   */
  async fetch(path, options = {}) {
    const headers = new Headers(this.token ? { Authorization: `Bearer ${this.token}` } : undefined);
    const response = await fetch(path, { ...options, headers });
    if (!response.ok) throw new Error((await response.text()) || response.statusText);
    return response;
  }
}
