// The wire, version 1, as viewer/protocol.py documents it; both are held to the same golden bytes.

export const VERSION = 1;
export const COMMAND = 1, FRAME = 2;
export const COMMAND_BYTES = 36, FRAME_HEADER_BYTES = 68, SPLINE_HEAD = 12;
export const FROZEN = 1, REPLAYING = 2, FAILED = 4, HAS_REFERENCE = 8, SPLINE = 16, RECORDING = 32;
export const HAS_POSE = 1;

/** @typedef {[number, number]} Point (x lateral, y depth) in mm */

/**
 * @typedef {object} Pose
 * @property {Point} entry mm
 * @property {number} angle degrees from +x towards depth
 * @property {number} depth mm
 */

/**
 * @typedef {object} Frame
 * @property {number} number
 * @property {number} flags
 * @property {number} command number of the newest command that it shows
 * @property {number} sent the page's clock when that command was sent, ms
 * @property {number} time model time, s
 * @property {Point} entry mm
 * @property {Point} tip mm
 * @property {number} speed mm/s
 * @property {number} duration of the step, ms
 * @property {number} largest displacement, mm
 * @property {number} difference largest one between two models, mm
 * @property {Float32Array} watched deformed positions, x and y in turn, mm
 * @property {Float32Array | null} displacement of the nodes, x and y in turn, mm
 * @property {Float32Array | null} reference the compared model's
 * @property {Float32Array | null} spline head and landmarks
 * @property {number} count nodes or landmarks
 */

/**
 * @param {number} drawn number of the newest frame drawn
 * @param {number} number of this command
 * @param {number} sent ms
 * @param {Pose | null} pose
 * @returns {ArrayBuffer}
 */
export function encodeCommand(drawn, number, sent, pose) {
  const view = new DataView(new ArrayBuffer(COMMAND_BYTES));
  view.setUint8(0, VERSION);
  view.setUint8(1, COMMAND);
  view.setUint16(2, pose ? HAS_POSE : 0, true);
  view.setUint32(4, drawn, true);
  view.setUint32(8, number, true);
  view.setFloat64(12, sent, true);
  if (pose) {
    [pose.entry[0], pose.entry[1], pose.angle, pose.depth].forEach((value, k) => view.setFloat32(20 + 4 * k, value, true));
  }
  return view.buffer;
}

/**
 * @param {ArrayBuffer} buffer
 * @returns {Frame}
 */
export function decodeFrame(buffer) {
  const view = new DataView(buffer);
  if (buffer.byteLength < FRAME_HEADER_BYTES || view.getUint8(0) !== VERSION || view.getUint8(1) !== FRAME) {
    throw new Error("this is no frame of protocol version 1: reload the page");
  }
  const flags = view.getUint16(2, true);
  const count = view.getUint32(12, true);
  const float = (/** @type {number} */ k) => view.getFloat32(32 + 4 * k, true);
  const watchedCount = view.getUint16(64, true);
  const perItem = flags & (SPLINE | HAS_REFERENCE) ? 4 : 2;
  const head = flags & SPLINE ? SPLINE_HEAD : 0;
  const expected = FRAME_HEADER_BYTES + 4 * (2 * watchedCount + head + perItem * count);
  if (buffer.byteLength !== expected) {
    throw new Error(`a frame must have ${expected} bytes; got ${buffer.byteLength}`);
  }
  const values = new Float32Array(buffer, FRAME_HEADER_BYTES);
  const field = values.subarray(2 * watchedCount);
  const nodes = !(flags & SPLINE);
  return {
    number: view.getUint32(4, true),
    flags,
    command: view.getUint32(8, true),
    sent: view.getFloat64(16, true),
    time: view.getFloat64(24, true),
    entry: [float(0), float(1)],
    tip: [float(2), float(3)],
    speed: float(4),
    duration: float(5),
    largest: float(6),
    difference: float(7),
    watched: values.subarray(0, 2 * watchedCount),
    displacement: nodes ? field.subarray(0, 2 * count) : null,
    reference: flags & HAS_REFERENCE ? field.subarray(2 * count, 4 * count) : null,
    spline: nodes ? null : field,
    count,
  };
}
