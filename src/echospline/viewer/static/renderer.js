// WebGL2: the image as a texture on the mesh, drawn where the tissue is.

import { SPLINE_HEAD } from "./protocol.js";
import { FRAGMENT, VERTEX } from "./shaders.js";

/** @import { Frame } from "./protocol.js" */
/** @import { View } from "./view.js" */

const BACKGROUND = [0.031, 0.039, 0.047];
const LANDMARK_ROW = 256; // texels a row of the landmarks' texture
const MOST_NODES_A_SIDE = 72; // of the mesh that a spline is evaluated on
/** Viridis, nine anchors. */
export const COLOURS = ["440154", "472d7b", "3b528b", "2c728e", "21918c", "28ae80", "5ec962", "addc30", "fde725"];

/**
 * @typedef {object} Grid
 * @property {[number, number]} shape
 * @property {[number, number]} spacing
 * @property {[number, number]} origin
 */

/**
 * @typedef {object} Looks
 * @property {number} gain
 * @property {number} contrast
 * @property {boolean} invert
 * @property {boolean} mesh
 * @property {boolean} heat
 * @property {number} heatScale mm
 * @property {boolean} shaft
 * @property {boolean} tip
 * @property {boolean} reverberation
 * @property {boolean} shadow
 */

export class Renderer {
  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    this.canvas = canvas;
    const gl = canvas.getContext("webgl2", { antialias: true, alpha: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("this browser offers no WebGL2, which the image needs");
    this.gl = gl;
    /** @type {Map<string, WebGLUniformLocation | null>} */
    this.uniforms = new Map();
    /** @type {Grid | null} */
    this.grid = null;
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => this.build());
    this.build();
  }

  build() {
    const gl = this.gl;
    const program = gl.createProgram();
    for (const [kind, source] of /** @type {[number, string][]} */ ([[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]])) {
      const shader = /** @type {WebGLShader} */ (gl.createShader(kind));
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader) ?? "shader");
      gl.attachShader(program, shader);
    }
    ["rest", "moved", "other"].forEach((name, k) => gl.bindAttribLocation(program, k, name));
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program) ?? "program");
    this.program = program;
    this.uniforms.clear();
    this.buffers = { rest: gl.createBuffer(), moved: gl.createBuffer(), other: gl.createBuffer(), index: gl.createBuffer() };
    this.image = gl.createTexture();
    this.landmarks = gl.createTexture();
    this.colours = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.colours);
    const strip = new Uint8Array(256 * 4);
    for (let k = 0; k < 256; ++k) strip.set(colourOf(k / 255), 4 * k);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, strip);
    this.filter(gl.LINEAR);
    gl.bindTexture(gl.TEXTURE_2D, this.landmarks);
    this.filter(gl.NEAREST);
    this.fine = false;
    this.nodes = 0;
    if (this.scene) this.setScene(this.scene.description, this.scene.pixels);
  }

  /** @param {number} how */
  filter(how) {
    const gl = this.gl;
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, how);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, how);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  }

  /**
   * @param {any} description as Scene.describe
   * @param {Uint8Array} pixels
   */
  setScene(description, pixels) {
    const gl = this.gl;
    this.scene = { description, pixels };
    gl.bindTexture(gl.TEXTURE_2D, this.image ?? null);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R8, description.image.columns, description.image.rows, 0, gl.RED, gl.UNSIGNED_BYTE, pixels);
    this.filter(gl.LINEAR);
    this.layMesh(description.mesh, false);
  }

  /**
   * Lay the nodes and triangles of a grid.
   * @param {Grid} grid
   * @param {boolean} fine whether this is the mesh for splines
   */
  layMesh(grid, fine) {
    const gl = this.gl;
    const [nx, ny] = grid.shape;
    const rest = new Float32Array(2 * nx * ny);
    for (let j = 0, k = 0; j < ny; ++j) {
      for (let i = 0; i < nx; ++i) {
        rest[k++] = grid.origin[0] + i * grid.spacing[0];
        rest[k++] = grid.origin[1] + j * grid.spacing[1];
      }
    }
    const index = new Uint32Array(6 * (nx - 1) * (ny - 1));
    for (let j = 0, k = 0; j + 1 < ny; ++j) {
      for (let i = 0; i + 1 < nx; ++i) {
        const a = j * nx + i, b = a + 1, c = a + nx, d = c + 1;
        index.set([a, b, c, b, d, c], k);
        k += 6;
      }
    }
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers?.rest ?? null);
    gl.bufferData(gl.ARRAY_BUFFER, rest, gl.STATIC_DRAW);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.buffers?.index ?? null);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, index, gl.STATIC_DRAW);
    this.triangles = index.length;
    this.nodes = nx * ny;
    this.fine = fine;
  }

  /** The mesh on which a spline is evaluated: as dense as the image deserves, whatever the model's. */
  fineGrid() {
    const { mesh } = this.scene?.description;
    const [wide, high] = [0, 1].map((k) => (mesh.shape[k] - 1) * mesh.spacing[k]);
    const step = Math.max(wide, high) / MOST_NODES_A_SIDE;
    const shape = /** @type {[number, number]} */ ([wide, high].map((extent, k) => Math.max(mesh.shape[k], Math.ceil(extent / step) + 1)));
    return { shape, spacing: /** @type {[number, number]} */ ([wide / (shape[0] - 1), high / (shape[1] - 1)]), origin: mesh.origin };
  }

  /**
   * @param {Frame} frame
   * @param {View} view
   * @param {Looks} looks
   */
  draw(frame, view, looks) {
    const gl = this.gl;
    if (!this.scene || !this.program || !this.buffers) return;
    const { description } = this.scene;
    const spline = frame.spline;
    if (Boolean(spline) !== this.fine) this.layMesh(spline ? this.fineGrid() : description.mesh, Boolean(spline));
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(BACKGROUND[0], BACKGROUND[1], BACKGROUND[2], 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(this.program);
    this.attribute(0, this.buffers.rest, null);
    if (spline) {
      gl.disableVertexAttribArray(1);
      gl.disableVertexAttribArray(2);
      this.loadSpline(spline, frame.count);
    } else {
      this.attribute(1, this.buffers.moved, frame.displacement);
      if (frame.reference) this.attribute(2, this.buffers.other, frame.reference);
      else gl.disableVertexAttribArray(2);
    }
    gl.uniform1i(this.at("landmarkCount"), spline ? frame.count : -1);
    gl.uniform1i(this.at("difference"), frame.reference ? 1 : 0);
    const [sx, sy, ox, oy] = view.toClip();
    gl.uniform4f(this.at("toClip"), sx, sy, ox, oy);
    const { image, mesh, needle } = description, echo = needle.echo;
    gl.uniform4f(this.at("pixels"), image.origin[0], image.origin[1], image.spacing[0], image.spacing[1]);
    const every = mesh.spacing.map((/** @type {number} */ h) => h * Math.max(1, Math.ceil(9 / (h * view.scale))));
    gl.uniform4f(this.at("mesh"), mesh.origin[0], mesh.origin[1], every[0], every[1]);
    gl.uniform3f(this.at("tone"), looks.gain, looks.contrast, looks.invert ? 1 : 0);
    gl.uniform4f(this.at("shaftEnds"), frame.entry[0], frame.entry[1], frame.tip[0], frame.tip[1]);
    gl.uniform4f(this.at("look"), echo.diameter / 2, echo.resolution, echo.fade_angle, echo.floor);
    gl.uniform3f(this.at("strength"), echo.brightness, echo.opacity, echo.refill);
    gl.uniform3f(this.at("apex"), echo.apex?.[0] ?? 0, echo.apex?.[1] ?? 0, echo.apex ? 1 : 0);
    gl.uniform4i(this.at("traits"), +looks.shaft, +looks.tip, +looks.reverberation, +looks.shadow);
    gl.uniform4f(this.at("heat"), looks.heat ? 1 : 0, looks.heatScale, 0.72, looks.mesh ? 1 : 0);
    [this.image, this.landmarks, this.colours].forEach((texture, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture ?? null);
    });
    gl.uniform1i(this.at("image"), 0);
    gl.uniform1i(this.at("landmarks"), 1);
    gl.uniform1i(this.at("colours"), 2);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.buffers.index);
    gl.drawElements(gl.TRIANGLES, this.triangles ?? 0, gl.UNSIGNED_INT, 0);
  }

  /**
   * @param {Float32Array} spline
   * @param {number} count
   */
  loadSpline(spline, count) {
    const gl = this.gl;
    const rows = Math.max(1, Math.ceil(count / LANDMARK_ROW));
    const texels = new Float32Array(4 * LANDMARK_ROW * rows);
    texels.set(spline.subarray(SPLINE_HEAD));
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.landmarks ?? null);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, LANDMARK_ROW, rows, 0, gl.RGBA, gl.FLOAT, texels);
    gl.uniform4f(this.at("kernel"), spline[0], spline[1], spline[2], spline[5]);
    gl.uniform2f(this.at("centre"), spline[3], spline[4]);
    gl.uniform2fv(this.at("motion[0]"), spline.subarray(6, 12));
  }

  /**
   * @param {number} place
   * @param {WebGLBuffer} buffer
   * @param {Float32Array | null} values to fill it with, if any
   */
  attribute(place, buffer, values) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    if (values) gl.bufferData(gl.ARRAY_BUFFER, values, gl.STREAM_DRAW);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, 2, gl.FLOAT, false, 0, 0);
  }

  /** @param {string} name */
  at(name) {
    let place = this.uniforms.get(name);
    if (place === undefined) {
      place = this.gl.getUniformLocation(/** @type {WebGLProgram} */ (this.program), name);
      this.uniforms.set(name, place);
    }
    return place;
  }
}

/**
 * @param {number} share 0 to 1
 * @returns {[number, number, number, number]} RGBA, 0 to 255
 */
export function colourOf(share) {
  const place = share * (COLOURS.length - 1), k = Math.min(Math.floor(place), COLOURS.length - 2), t = place - k;
  const part = (/** @type {string} */ hex, /** @type {number} */ c) => parseInt(hex.slice(2 * c, 2 * c + 2), 16);
  const mixed = [0, 1, 2].map((c) => Math.round((1 - t) * part(COLOURS[k], c) + t * part(COLOURS[k + 1], c)));
  return [mixed[0], mixed[1], mixed[2], 255];
}
