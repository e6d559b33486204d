// The core in WebAssembly: scenes, tissues, pictures and the motion of a needle, over the C interface and nothing else.
//
// Scenes in space: `core.volume`, `core.forceField`, `core.spatial` and `core.plane`, over space.h.
//
// `load(bytes)` makes a Core from the bytes of echospline.wasm, in a page, a worker or node. Structs and enums have the names of
// core/include/echospline/echospline.h; there are no defaults here. Handles live in the module's memory: `destroy` them, tissues first.
// Typed arrays that a method returns are views of that memory, right until the next call into the core: copy what is to be kept.

/** Version of the header that this file was written for. */
export const VERSION = "0.1.0";

export const Status = Object.freeze({
  OK: 0, NULL_POINTER: 1, WRONG_SIZE: 2, WRONG_VALUE: 3, OUT_OF_MEMORY: 4, NOT_HELD: 5, NOT_SOLVED: 6, WRONG_STATE: 7,
  FAILED_HANDLE: 8, NEEDS_STATION: 9,
});
export const Level = Object.freeze({
  LEVEL_BEST: 0, LEVEL_BASELINE: 1, LEVEL_AVX2: 2, LEVEL_AVX512: 3, LEVEL_NEON: 4, LEVEL_SIMD128: 5,
});
export const Kernel = Object.freeze({ THIN_PLATE: 0, ELASTIC: 1 });
export const Precision = Object.freeze({ SINGLE: 0, DOUBLE: 1 });
export const Tip = Object.freeze({ TIP_POINT: 0, TIP_NODE: 1 });
export const Loading = Object.freeze({ FOLLOW: 0, IMMEDIATE: 1, STICK: 2 });
export const Plane = Object.freeze({ PLANE_STRESS: 0, PLANE_STRAIN: 1 });
export const Edge = Object.freeze({ LEFT: 1, RIGHT: 2, TOP: 4, BOTTOM: 8, FRONT: 16, BACK: 32 });
export const PixelType = Object.freeze({ UINT8: 0, UINT16: 1, INT16: 2, FLOAT32: 3 });
export const Interpolation = Object.freeze({ LINEAR: 0, NEAREST: 1 });
export const Border = Object.freeze({ BORDER_VALUE: 0, BORDER_TRANSPARENT: 1 });
export const Method = Object.freeze({ METHOD_AUTO: 0, METHOD_EXACT: 1, METHOD_PULL: 2 });
export const NeedlePart = Object.freeze({ SHAFT: 1, BEVEL: 2, TAIL: 4, SHADOW: 8 });
export const GreenMethod = Object.freeze({ GREEN_BOUNDARY: 0, GREEN_SOLVE: 1 });
export const GreenCondition = Object.freeze({
  CONDITION_CLAMPED: 0, CONDITION_SLIDING_X: 1, CONDITION_SLIDING_Y: 2, CONDITION_FREE: 3, CONDITION_INTERFACE: 4,
});
export const LandmarkKind = Object.freeze({ CONTACT: 0, LEAVING: 1, TIP: 2, TIP_LEFT: 3 });

export const Top = Object.freeze({ TOP_NONE: 0, TOP_FREE: 1, TOP_SLIDING: 2 });

/** @typedef {"i32" | "u32" | "i64" | "f64" | "pointer"} Kind */
/** @typedef {{ name: string, kind: Kind, count: number, offset: number }} Field */
/** @typedef {{ fields: Field[], size: number }} Layout */
/** @typedef {ArrayLike<number>} Numbers */

/**
 * Options of a scene, named as in echospline_scene_options; what is not given keeps the core's default.
 * @typedef {{
 *   dimension?: number, kernel?: number, precision?: number, tip?: number, loading?: number, plane?: number,
 *   clamped?: number, level?: number, shape?: Numbers, spacing?: Numbers, origin?: Numbers, sigma?: number,
 *   delta?: number, alpha1?: number, alpha2?: number, alpha3?: number, length?: number, drag?: number,
 *   contact_spacing?: number, anchor_spacing?: number, poisson?: number, radius?: number, clamped_points?: Numbers,
 *   stiffness?: Numbers, contact_room?: number, sliding?: number, friction_speed?: number
 * }} SceneOptions
 */
/**
 * Options of a picture, named as in echospline_picture_options.
 * @typedef {{
 *   pixel_type?: number, channels?: number, interpolation?: number, border?: number, method?: number, level?: number,
 *   columns?: number, rows?: number, mesh_shape?: Numbers, spacing?: Numbers, origin?: Numbers, mesh_spacing?: Numbers,
 *   mesh_origin?: Numbers, border_value?: number, white?: number
 * }} PictureOptions
 */
/** A needle, named as in echospline_needle. @typedef {Record<string, number | Numbers>} Needle */
/**
 * @typedef {{
 *   method: number, residual: number, difference: number, exact_share: number, folded_cells: number,
 *   smallest_jacobian: number, place: number[]
 * }} PictureReport
 */
/**
 * How a picture is shown, named as in echospline_look; `depth_gains` has as many numbers as there are sliders.
 * @typedef {{
 *   level?: number, invert?: number, flip?: number, gain?: number, recorded_range?: number, dynamic_range?: number,
 *   depth_gains?: Numbers
 * }} Look
 */
/** @typedef {Uint8Array | Uint16Array | Int16Array | Float32Array} Pixels */
/** @typedef {{ entry: Numbers, tip: Numbers, speed: number, dt: number }} Pose */
/** @typedef {{ entry: Numbers, tip: Numbers, lag: number, fastest: number }} Command */
/**
 * @typedef {{
 *   place: number[], displacement: number[], grip: number[], along: number, node: number, kind: number
 * }} Landmark
 */
/**
 * @typedef {{
 *   steps: number, joined: number, left: number, rebuilt: number, held_back: number, allocations: number, residual: number
 * }} Statistics
 */

/**
 * Options of a forced tissue, named as in echospline_forced_options; what is not given keeps the core's default.
 * @typedef {{
 *   level?: number, node_count: number, low: Numbers, high: Numbers, tip?: number, friction_limit?: number, bond?: number,
 *   tip_stiffness?: number, side_stiffness?: number, viscosity?: number, station_spacing?: number, substep?: number,
 *   dead_band?: number
 * }} ForcedOptions
 */
/**
 * @typedef {{
 *   index: number, place: number[], axis: number[], points: number[], weights: number[], point_count: number
 * }} Station
 */
/** @typedef {{ tip: number, friction: number, side: number, torque: number, cut: number }} NeedleLoad */
/**
 * How tissue answers a station: displacement of the nodes by a unit force along x, then along y, (2, nodes, 2) mm/N, and mean
 * displacement over the stations so far, (index + 1, 2, 2) mm/N. `stations` are those before it.
 * @typedef {(wanted: Station, stations: Station[]) => { columns: Float32Array, rows: Numbers }} Answer
 */

/** A volume, named as in echospline_volume_options. @typedef {{ level?: number, shape: Numbers, spacing: Numbers, origin: Numbers }} VolumeOptions */
/**
 * Point forces in space, named as in echospline_force_field: three numbers for each of `places` and `forces`, one of `radii`.
 * @typedef {{
 *   level?: number, top: number, poisson: number, shear_modulus: number, places: Numbers, forces: Numbers, radii: Numbers,
 *   lattice_shape?: Numbers, lattice_spacing?: Numbers, lattice_origin?: Numbers, lattice?: Numbers
 * }} ForceFieldOptions
 */
/**
 * A probe's picture: `spacing` and `origin` of its pixels in its plane, mm; `step` pixels between the lattice's neighbours; `spread`,
 * `mask` and `background` as in echospline_slice.
 * @typedef {{
 *   columns: number, rows: number, spacing: Numbers, origin: Numbers, step: number, spread?: Numbers, mask?: Uint8Array,
 *   background?: number
 * }} PlaneOptions
 */
/** What moves tissue: a field, a spatial tissue, or a tissue in space. @typedef {{ fieldAt: number } | Tissue} Moving */
/**
 * The law and the tissue, named as in echospline_spatial_options, without counts; `SpaceResponse.tables()` of the Python package writes
 * what answers. Numbers that are not given are the law's usual ones.
 * @typedef {Record<string, number | Numbers> & { low: Numbers, high: Numbers }} SpatialOptions
 */
/** A station, named as in echospline_spatial_station. @typedef {{ index: number, place: number[], axis: number[], points: number[], weights: number[], point_count: number }} SpatialStation */
/** Answers a station where the core does not: nine numbers for each station before it and, last, itself. @typedef {(wanted: SpatialStation) => Numbers} SpatialAnswer */
/** The needle's forces, named as in echospline_spatial_load. @typedef {{ tip: number, friction: number, side: number, cut: number, force: number[], torque: number[] }} SpatialLoad */
/** @typedef {{ residual: number, folded: number, jacobian: number, place: number[], outside: number }} PlaneReport */
/**
 * How tissue answers forces: members of echospline_green_options without counts, as `GreenResponse.tables()` of the Python package writes
 * them; typed arrays may be of any type, and flat.
 * @typedef {Record<string, number | Numbers> & { shape: Numbers, spacing: Numbers, origin: Numbers }} GreenTables
 */

const BYTES = { i32: 4, u32: 4, i64: 8, f64: 8, pointer: 4 };

/**
 * Lay a struct out as C does: every member at a multiple of its own size.
 * @param {[string, Kind, number?][]} members
 * @returns {Layout}
 */
function layout(members) {
  let end = 0;
  let widest = 1;
  const fields = members.map(([name, kind, count = 1]) => {
    const size = BYTES[kind];
    const offset = Math.ceil(end / size) * size;
    end = offset + size * count;
    widest = Math.max(widest, size);
    return { name, kind, count, offset };
  });
  return { fields, size: Math.ceil(end / widest) * widest };
}

/** Structs of the header, by their names there. @type {Readonly<Record<string, Layout>>} */
export const LAYOUTS = Object.freeze({
  echospline_scene_options: layout([
    ["struct_size", "u32"], ["dimension", "i32"], ["kernel", "i32"], ["precision", "i32"], ["tip", "i32"],
    ["loading", "i32"], ["plane", "i32"], ["clamped", "u32"], ["level", "i32"], ["shape", "i32", 3],
    ["spacing", "f64", 3], ["origin", "f64", 3], ["sigma", "f64"], ["delta", "f64"], ["alpha1", "f64"],
    ["alpha2", "f64"], ["alpha3", "f64"], ["length", "f64"], ["drag", "f64"], ["contact_spacing", "f64"],
    ["anchor_spacing", "f64"], ["poisson", "f64"], ["radius", "f64"], ["clamped_points", "pointer"],
    ["clamped_point_count", "i64"], ["stiffness", "pointer"], ["stiffness_count", "i64"], ["contact_room", "i64"],
    ["sliding", "u32"], ["reserved", "u32"], ["friction_speed", "f64"],
  ]),
  echospline_pose: layout([["entry", "f64", 3], ["tip", "f64", 3], ["speed", "f64"], ["dt", "f64"]]),
  echospline_command: layout([["entry", "f64", 3], ["tip", "f64", 3], ["lag", "f64"], ["fastest", "f64"]]),
  echospline_landmark: layout([
    ["place", "f64", 3], ["displacement", "f64", 3], ["grip", "f64", 3], ["along", "f64"], ["node", "i64"],
    ["kind", "i32"], ["reserved", "i32"],
  ]),
  echospline_statistics: layout([
    ["struct_size", "u32"], ["reserved", "i32"], ["steps", "i64"], ["joined", "i64"], ["left", "i64"],
    ["rebuilt", "i64"], ["held_back", "i64"], ["allocations", "i64"], ["residual", "f64"],
  ]),
  echospline_picture_options: layout([
    ["struct_size", "u32"], ["pixel_type", "i32"], ["channels", "i32"], ["interpolation", "i32"], ["border", "i32"],
    ["method", "i32"], ["level", "i32"], ["columns", "i32"], ["rows", "i32"], ["mesh_shape", "i32", 2],
    ["reserved", "i32"], ["spacing", "f64", 2], ["origin", "f64", 2], ["mesh_spacing", "f64", 2],
    ["mesh_origin", "f64", 2], ["border_value", "f64"], ["white", "f64"],
  ]),
  echospline_needle: layout([
    ["struct_size", "u32"], ["parts", "u32"], ["seed", "u32"], ["curved", "i32"], ["entry", "f64", 3],
    ["tip", "f64", 3], ["apex", "f64", 2], ["diameter", "f64"], ["lateral", "f64"], ["axial", "f64"],
    ["elevation", "f64"], ["elevation_depth", "f64"], ["element_height", "f64"], ["f_number", "f64"],
    ["dynamic_range", "f64"], ["specular", "f64"], ["lobe", "f64"], ["lobe_elevation", "f64"], ["steering", "f64"],
    ["roughness", "f64"], ["rolloff", "f64"], ["wobble", "f64"], ["patches", "f64"], ["bevel", "f64"],
    ["ring_down", "f64"], ["ring_down_loss", "f64"], ["opacity", "f64"],
  ]),
  echospline_picture_report: layout([
    ["struct_size", "u32"], ["method", "i32"], ["residual", "f64"], ["difference", "f64"], ["exact_share", "f64"],
    ["folded_cells", "i64"], ["smallest_jacobian", "f64"], ["place", "f64", 2],
  ]),
  echospline_look: layout([
    ["struct_size", "u32"], ["level", "i32"], ["invert", "i32"], ["flip", "i32"], ["gain", "f64"],
    ["recorded_range", "f64"], ["dynamic_range", "f64"], ["depth_gain_count", "i32"], ["reserved", "i32"],
    ["depth_gains", "f64", 8],
  ]),
  echospline_volume_options: layout([
    ["struct_size", "u32"], ["level", "i32"], ["shape", "i32", 3], ["reserved", "i32"], ["spacing", "f64", 3],
    ["origin", "f64", 3],
  ]),
  echospline_slice: layout([
    ["struct_size", "u32"], ["columns", "i32"], ["rows", "i32"], ["step", "i32"], ["normal", "f64", 3],
    ["spread", "pointer"], ["mask", "pointer"], ["background", "i32"], ["reserved", "i32"],
  ]),
  echospline_force_field: layout([
    ["struct_size", "u32"], ["level", "i32"], ["top", "i32"], ["reserved", "i32"], ["poisson", "f64"],
    ["shear_modulus", "f64"], ["places", "pointer"], ["forces", "pointer"], ["radii", "pointer"], ["force_count", "i64"],
    ["lattice_shape", "i32", 3], ["lattice_reserved", "i32"], ["lattice_spacing", "f64", 3], ["lattice_origin", "f64", 3],
    ["lattice", "pointer"],
  ]),
  echospline_trace_report: layout([
    ["struct_size", "u32"], ["reserved", "i32"], ["residual", "f64"], ["folded", "i64"], ["jacobian", "f64"],
    ["place", "f64", 3],
  ]),
  echospline_spatial_options: layout([
    ["struct_size", "u32"], ["level", "i32"], ["low", "f64", 3], ["high", "f64", 3], ["tip", "f64"], ["friction_limit", "f64"],
    ["bond", "f64"], ["tip_stiffness", "f64"], ["side_stiffness", "f64"], ["viscosity", "f64"], ["station_spacing", "f64"],
    ["substep", "f64"], ["dead_band", "f64"], ["top", "i32"], ["clamped", "u32"], ["sliding", "u32"], ["reserved", "i32"],
    ["poisson", "f64"], ["shear_modulus", "f64"], ["radius", "f64"], ["source_radius", "f64"], ["traction_length", "f64"],
    ["sources", "pointer"], ["source_count", "i64"], ["conditions", "pointer"], ["condition_faces", "pointer"],
    ["condition_count", "i64"], ["answers", "pointer"], ["answer_count", "i64"], ["lattice_shape", "i32", 3],
    ["lattice_reserved", "i32"], ["lattice_spacing", "f64", 3], ["lattice_origin", "f64", 3],
  ]),
  echospline_spatial_station: layout([
    ["index", "i64"], ["place", "f64", 3], ["axis", "f64", 3], ["points", "f64", 12], ["weights", "f64", 4],
    ["point_count", "i32"], ["reserved", "i32"],
  ]),
  echospline_spatial_load: layout([
    ["tip", "f64"], ["friction", "f64"], ["side", "f64"], ["cut", "f64"], ["force", "f64", 3], ["torque", "f64", 3],
  ]),
  echospline_forced_options: layout([
    ["struct_size", "u32"], ["level", "i32"], ["node_count", "i64"], ["low", "f64", 2], ["high", "f64", 2],
    ["tip", "f64"], ["friction_limit", "f64"], ["bond", "f64"], ["tip_stiffness", "f64"], ["side_stiffness", "f64"],
    ["viscosity", "f64"], ["station_spacing", "f64"], ["substep", "f64"], ["dead_band", "f64"],
  ]),
  echospline_station: layout([
    ["index", "i64"], ["place", "f64", 2], ["axis", "f64", 2], ["points", "f64", 8], ["weights", "f64", 4],
    ["point_count", "i32"], ["reserved", "i32"],
  ]),
  echospline_needle_load: layout([["tip", "f64"], ["friction", "f64"], ["side", "f64"], ["torque", "f64"], ["cut", "f64"]]),
  echospline_green_options: layout([
    ["struct_size", "u32"], ["level", "i32"], ["method", "i32"], ["clamped", "u32"], ["sliding", "u32"], ["shape", "i32", 2],
    ["reserved", "i32"], ["spacing", "f64", 2], ["origin", "f64", 2], ["radius", "f64"], ["weight", "f64"],
    ["pin_weight", "f64"], ["pin_radius", "f64"], ["lattice", "f64"], ["bodies", "pointer"], ["depths", "pointer"],
    ["circles", "pointer"], ["sources", "pointer"], ["source_counts", "pointer"], ["conditions", "pointer"],
    ["sides", "pointer"], ["pins", "pointer"], ["order", "pointer"], ["right", "pointer"], ["left", "pointer"],
    ["body_count", "i64"], ["band_count", "i64"], ["source_count", "i64"], ["condition_count", "i64"],
    ["pin_count", "i64"], ["rank", "i64"], ["lines_x", "pointer"], ["lines_y", "pointer"], ["moduli", "pointer"],
    ["held", "pointer"], ["line_x_count", "i64"], ["line_y_count", "i64"], ["triangle_count", "i64"],
    ["held_count", "i64"],
  ]),
});

/**
 * Tables of echospline_green_options: the member that counts their entries, numbers per entry, type.
 * @type {Readonly<Record<string, [string, number, Float64ArrayConstructor | Int32ArrayConstructor | Uint8ArrayConstructor]>>}
 */
const GREEN_TABLES = Object.freeze({
  bodies: ["body_count", 2, Float64Array], depths: ["", 1, Float64Array], circles: ["", 3, Float64Array],
  sources: ["source_count", 2, Float64Array], source_counts: ["", 1, Int32Array],
  conditions: ["condition_count", 4, Float64Array], sides: ["", 3, Int32Array], pins: ["pin_count", 2, Float64Array],
  order: ["rank", 1, Int32Array],
  lines_x: ["line_x_count", 1, Float64Array], lines_y: ["line_y_count", 1, Float64Array],
  moduli: ["triangle_count", 2, Float64Array], held: ["held_count", 1, Uint8Array],
});

/** A call of the core that did not succeed; `status` is one of Status. */
export class CoreError extends Error {
  /** @param {number} status @param {string} message */
  constructor(status, message) {
    super(message);
    this.name = "CoreError";
    this.status = status;
  }
}

/**
 * Load the core.
 * @param {BufferSource} bytes contents of echospline.wasm
 * @returns {Promise<Core>}
 */
export async function load(bytes) {
  const { instance } = await WebAssembly.instantiate(bytes, {});
  return new Core(instance);
}

/** The loaded module: its functions, memory and version. */
export class Core {
  /** @param {WebAssembly.Instance} instance */
  constructor(instance) {
    /** Functions of the header, as the module exports them. @type {any} */
    this.functions = instance.exports;
    this.functions._initialize?.();
    const number = this.functions.echospline_version();
    this.version = `${number >>> 16}.${(number >>> 8) & 255}.${number & 255}`;
    if (this.version !== VERSION) {
      throw new Error(`expected version ${VERSION} of echospline.wasm; got ${this.version}; build it anew: make wasm`);
    }
  }

  /** Memory of the module; its buffer is replaced when it grows. @returns {ArrayBuffer} */
  get buffer() {
    return this.functions.memory.buffer;
  }

  /** Name of the processor level. @returns {string} */
  get level() {
    return this.text(this.functions.echospline_level_name(this.functions.echospline_level_best()));
  }

  /** Factor a scene. @param {SceneOptions} options @returns {Scene} */
  scene(options) {
    return new Scene(this, options);
  }

  /** Make a picture of undeformed tissue. @param {PictureOptions} options @param {Pixels} pixels @returns {Picture} */
  picture(options, pixels) {
    return new Picture(this, options, pixels);
  }

  /**
   * Tissue at rest under a needle that sticks, slips and cuts.
   * @param {ForcedOptions} options @param {Answer} answer @returns {Forced}
   */
  forced(options, answer) {
    return new Forced(this, options, answer);
  }

  /**
   * The same where the core answers: Green's function from its tables. Node count and corners of the options follow from them.
   * @param {Partial<ForcedOptions>} options @param {GreenTables} tables @returns {Green}
   */
  green(options, tables) {
    return new Green(this, options, tables);
  }

  /**
   * Move a needle one step of dt seconds towards a command.
   * @param {Pose} now @param {Command} command @param {number} dt @returns {Pose}
   */
  follow(now, command, dt) {
    const pose = LAYOUTS.echospline_pose;
    const at = this.allocate(2 * pose.size + LAYOUTS.echospline_command.size);
    try {
      this.write(at, pose, now);
      this.write(at + pose.size, pose, { ...now, dt });
      this.write(at + 2 * pose.size, LAYOUTS.echospline_command, command);
      const status = this.functions.echospline_follow(at, at + 2 * pose.size, at + pose.size);
      if (status !== Status.OK) throw new CoreError(status, this.text(this.functions.echospline_status_text(status)));
      return /** @type {any} */ (this.read(at + pose.size, pose));
    } finally {
      this.functions.free(at);
    }
  }

  /** Pack a volume of 8-bit voxels, x fastest, then y. @param {VolumeOptions} options @param {Uint8Array} voxels @returns {Volume} */
  volume(options, voxels) {
    return new Volume(this, options, voxels);
  }

  /** Point forces in elastic tissue in space. @param {ForceFieldOptions} options @returns {ForceField} */
  forceField(options) {
    return new ForceField(this, options);
  }

  /**
   * Tissue in space at rest, under a needle that sticks, slips and cuts. Without tables `answer` has to say what the tissue answers.
   * @param {SpatialOptions} options @param {SpatialAnswer | null} [answer] @returns {Spatial}
   */
  spatial(options, answer = null) {
    return new Spatial(this, options, answer);
  }

  /** The picture of a plane through a volume. @param {Volume} volume @param {PlaneOptions} options @returns {PlanePicture} */
  plane(volume, options) {
    return new PlanePicture(volume, options);
  }

  /**
   * Shade a grey picture in the module's memory into red, green, blue and alpha.
   * @param {Look} look @param {number} grey address @param {number} columns @param {number} rows @param {number} rgba address
   */
  shade(look, grey, columns, rows, rgba) {
    const shape = LAYOUTS.echospline_look;
    const at = this.allocate(shape.size);
    try {
      this.write(at, shape, { struct_size: shape.size });
      this.functions.echospline_look_defaults(at);
      this.write(at, shape, { ...look, depth_gain_count: look.depth_gains?.length ?? 0 });
      const status = this.functions.echospline_shade(at, grey, columns, rows, rgba, BigInt(4 * columns * rows));
      if (status !== Status.OK) throw new CoreError(status, this.text(this.functions.echospline_status_text(status)));
    } finally {
      this.functions.free(at);
    }
  }

  /** Memory of the module; throws when there is none left. @param {number} size @returns {number} address */
  allocate(size) {
    const at = this.functions.malloc(Math.max(size, 1));
    if (at === 0) throw new CoreError(Status.OUT_OF_MEMORY, `expected ${size} bytes of memory; there are none left`);
    return at;
  }

  /** Text at an address. @param {number} at @returns {string} */
  text(at) {
    const bytes = new Uint8Array(this.buffer, at);
    return new TextDecoder().decode(bytes.slice(0, bytes.indexOf(0)));
  }

  /** Write members of a struct; others stay. @param {number} at @param {Layout} layout @param {Record<string, any>} values */
  write(at, layout, values) {
    const view = new DataView(this.buffer, at, layout.size);
    for (const { name, kind, count, offset } of layout.fields) {
      const value = values[name];
      if (value === undefined) continue;
      for (let i = 0; i < count; ++i) {
        const number = count > 1 ? value[i] ?? 0 : value;
        const place = offset + i * BYTES[kind];
        if (kind === "f64") view.setFloat64(place, number, true);
        else if (kind === "i64") view.setBigInt64(place, BigInt(number), true);
        else if (kind === "i32") view.setInt32(place, number, true);
        else view.setUint32(place, number, true);
      }
    }
  }

  /** Read a struct. @param {number} at @param {Layout} layout @returns {Record<string, number | number[]>} */
  read(at, layout) {
    const view = new DataView(this.buffer, at, layout.size);
    /** @type {Record<string, number | number[]>} */
    const values = {};
    for (const { name, kind, count, offset } of layout.fields) {
      const numbers = Array.from({ length: count }, (_, i) => {
        const place = offset + i * BYTES[kind];
        if (kind === "f64") return view.getFloat64(place, true);
        if (kind === "i64") return Number(view.getBigInt64(place, true));
        return kind === "i32" ? view.getInt32(place, true) : view.getUint32(place, true);
      });
      values[name] = count > 1 ? numbers : numbers[0];
    }
    return values;
  }

  /** Copy numbers into the module. @param {Numbers} numbers @returns {number} address, to be freed */
  place(numbers) {
    const at = this.allocate(8 * numbers.length);
    new Float64Array(this.buffer, at, numbers.length).set(numbers);
    return at;
  }

  /** Throw unless a call succeeded. @param {number} status @param {string} what scene, tissue @param {number} handle */
  check(status, what, handle) {
    if (status === Status.OK) return;
    throw new CoreError(status, this.text(this.functions[`echospline_${what}_message`](handle)));
  }

  /** Call a create function and return its handle. @param {string} what @param {number[]} from @returns {number} */
  create(what, ...from) {
    const at = this.allocate(4);
    try {
      new Uint32Array(this.buffer, at, 1)[0] = 0;
      const status = this.functions[`echospline_${what}_create`](...from, at);
      const handle = new Uint32Array(this.buffer, at, 1)[0];
      if (status !== Status.OK) {
        const message = this.text(this.functions[`echospline_${what}_message`](handle));
        this.functions[`echospline_${what}_destroy`](handle);
        throw new CoreError(status, message);
      }
      return handle;
    } finally {
      this.functions.free(at);
    }
  }
}

/** What is given: mesh, clamped edges, parameters; factored once. */
export class Scene {
  /** @param {Core} core @param {SceneOptions} options */
  constructor(core, options) {
    this.core = core;
    const shape = LAYOUTS.echospline_scene_options;
    const at = core.allocate(shape.size);
    const points = options.clamped_points && core.place(options.clamped_points);
    const stiffness = options.stiffness && core.place(options.stiffness);
    try {
      core.write(at, shape, { struct_size: shape.size });
      core.functions.echospline_scene_defaults(at);
      core.write(at, shape, { ...options, clamped_points: points, stiffness });
      /** @type {number} */
      this.dimension = /** @type {any} */ (core.read(at, shape)).dimension;
      const points_given = (options.clamped_points?.length ?? 0) / this.dimension;
      core.write(at, shape, { clamped_point_count: points_given, stiffness_count: options.stiffness?.length ?? 0 });
      this.handle = core.create("scene", at);
    } finally {
      for (const address of [at, points, stiffness]) if (address) core.functions.free(address);
    }
    this.level = core.text(core.functions.echospline_level_name(core.functions.echospline_scene_level(this.handle)));
    this.nodeCount = Number(core.functions.echospline_scene_node_count(this.handle));
    this.anchorCount = Number(core.functions.echospline_scene_anchor_count(this.handle));
    this.sourceCount = Number(core.functions.echospline_scene_source_count(this.handle));
  }

  /** Anchors, dimension numbers each, mm. @returns {Float64Array} */
  anchors() {
    const { functions } = this.core;
    const count = this.anchorCount * this.dimension;
    const at = this.core.allocate(8 * count);
    try {
      this.core.check(functions.echospline_scene_anchors(this.handle, at, BigInt(count)), "scene", this.handle);
      return new Float64Array(this.core.buffer, at, count).slice();
    } finally {
      functions.free(at);
    }
  }

  /** Mesh nodes that may become contacts, ascending. @returns {number[]} */
  sources() {
    const { functions } = this.core;
    const at = this.core.allocate(8 * this.sourceCount);
    try {
      const count = BigInt(this.sourceCount);
      this.core.check(functions.echospline_scene_sources(this.handle, at, count), "scene", this.handle);
      return Array.from(new BigInt64Array(this.core.buffer, at, this.sourceCount), Number);
    } finally {
      functions.free(at);
    }
  }

  /** A tissue at rest in this scene. @returns {Tissue} */
  tissue() {
    return new Tissue(this);
  }

  destroy() {
    this.core.functions.echospline_scene_destroy(this.handle);
    this.handle = 0;
  }
}

/** Tissue in the plane under a needle that sticks, slips and cuts; how it answers forces comes from outside. */
export class Forced {
  /** @param {Core} core @param {ForcedOptions} options @param {Answer} answer */
  constructor(core, options, answer) {
    this.core = core;
    this.answer = answer;
    this.numbers = 2 * options.node_count;
    const shape = LAYOUTS.echospline_forced_options;
    const at = core.allocate(shape.size);
    try {
      core.write(at, shape, { struct_size: shape.size });
      core.functions.echospline_forced_defaults(at);
      core.write(at, shape, options);
      this.handle = core.create("forced", at);
    } finally {
      core.functions.free(at);
    }
    this.pose = core.allocate(LAYOUTS.echospline_pose.size);
    this.field = core.allocate(8 * this.numbers);
  }

  /** Throw unless a call succeeded. @param {number} status */
  check(status) {
    this.core.check(status, "forced", this.handle);
  }

  /** Back to rest. */
  reset() {
    this.check(this.core.functions.echospline_forced_reset(this.handle));
  }

  /** Advance by one step. @param {Pose} pose */
  advance(pose) {
    const { functions } = this.core;
    this.core.write(this.pose, LAYOUTS.echospline_pose, pose);
    this.answered(() => functions.echospline_forced_advance(this.handle, this.pose));
  }

  /** Repeat a call until it needs no further station. @param {() => number} call */
  answered(call) {
    const { functions } = this.core;
    const shape = LAYOUTS.echospline_station;
    let status = call();
    while (status === Status.NEEDS_STATION) {
      const stations = this.stations();
      const at = this.core.allocate(shape.size);
      let [columns, rows] = [0, 0];
      try {
        this.check(functions.echospline_forced_wanted(this.handle, at));
        const wanted = /** @type {any} */ (this.core.read(at, shape));
        const given = this.answer(wanted, stations.slice(0, wanted.index));
        columns = this.core.allocate(4 * given.columns.length);
        new Float32Array(this.core.buffer, columns, given.columns.length).set(given.columns);
        rows = this.core.place(given.rows);
        const counts = [BigInt(given.columns.length), BigInt(given.rows.length)];
        this.check(functions.echospline_forced_answer(this.handle, columns, counts[0], rows, counts[1]));
      } finally {
        for (const address of [at, columns, rows]) if (address) functions.free(address);
      }
      status = call();
    }
    this.check(status);
  }

  /** Stations that have been answered. @returns {Station[]} */
  stations() {
    const { functions } = this.core;
    const shape = LAYOUTS.echospline_station;
    const number = this.core.allocate(8);
    let list = 0;
    try {
      this.check(functions.echospline_forced_stations(this.handle, 0, 0n, number));
      const count = Number(new BigInt64Array(this.core.buffer, number, 1)[0]);
      list = this.core.allocate(count * shape.size);
      this.check(functions.echospline_forced_stations(this.handle, list, BigInt(count), number));
      return Array.from({ length: count }, (_, i) => /** @type {any} */ (this.core.read(list + i * shape.size, shape)));
    } finally {
      functions.free(number);
      functions.free(list);
    }
  }

  /** The needle's forces. @returns {NeedleLoad} */
  load() {
    const shape = LAYOUTS.echospline_needle_load;
    const at = this.core.allocate(shape.size);
    try {
      this.check(this.core.functions.echospline_forced_load(this.handle, at));
      return /** @type {any} */ (this.core.read(at, shape));
    } finally {
      this.core.functions.free(at);
    }
  }

  /** Force at every station, two numbers each, N. @returns {Float64Array} */
  forces() {
    const { functions } = this.core;
    const number = this.core.allocate(8);
    let list = 0;
    try {
      this.check(functions.echospline_forced_forces(this.handle, 0, 0n, number));
      const count = Number(new BigInt64Array(this.core.buffer, number, 1)[0]);
      list = this.core.allocate(16 * count);
      this.check(functions.echospline_forced_forces(this.handle, list, BigInt(count), number));
      return new Float64Array(this.core.buffer, list, 2 * count).slice();
    } finally {
      functions.free(number);
      functions.free(list);
    }
  }

  /** Displacement of the mesh nodes, two numbers each, mm: a view. @returns {Float64Array} */
  displacement() {
    const { functions } = this.core;
    this.answered(() => functions.echospline_forced_displacement(this.handle, this.field, BigInt(this.numbers)));
    return new Float64Array(this.core.buffer, this.field, this.numbers);
  }

  /** The same in single precision: a view. @returns {Float32Array} */
  displacementSingle() {
    const { functions } = this.core;
    this.answered(() => functions.echospline_forced_displacement_single(this.handle, this.field, BigInt(this.numbers)));
    return new Float32Array(this.core.buffer, this.field, this.numbers);
  }

  /** The present state as bytes. @returns {Uint8Array} */
  save() {
    const { functions } = this.core;
    const size = Number(functions.echospline_forced_state_size(this.handle));
    const at = this.core.allocate(size);
    try {
      this.check(functions.echospline_forced_state_save(this.handle, at, BigInt(size)));
      return new Uint8Array(this.core.buffer, at, size).slice();
    } finally {
      functions.free(at);
    }
  }

  /** Make saved bytes the present state. @param {Uint8Array} bytes */
  restore(bytes) {
    const { functions } = this.core;
    const at = this.core.allocate(bytes.length);
    try {
      new Uint8Array(this.core.buffer, at, bytes.length).set(bytes);
      this.check(functions.echospline_forced_state_load(this.handle, at, BigInt(bytes.length)));
    } finally {
      functions.free(at);
    }
  }

  destroy() {
    const { functions } = this.core;
    functions.echospline_forced_destroy(this.handle);
    functions.free(this.pose);
    functions.free(this.field);
    this.handle = this.pose = this.field = 0;
  }
}

/** Tissue in the plane under a needle that sticks, slips and cuts, which answers forces by Green's function in the core. */
export class Green extends Forced {
  /** @param {Core} core @param {Partial<ForcedOptions>} options @param {GreenTables} tables */
  constructor(core, options, tables) {
    checkTables(tables);
    const { shape, spacing, origin } = tables;
    const high = [0, 1].map((d) => origin[d] + spacing[d] * (shape[d] - 1));
    super(core, { ...options, node_count: shape[0] * shape[1], low: origin, high }, () => {
      throw new CoreError(Status.NEEDS_STATION, "expected an attached green to answer; it was detached");
    });
    this.response = 0;
    try {
      this.response = createGreen(core, tables, options.level ?? 0);
      this.check(core.functions.echospline_forced_attach(this.handle, this.response));
    } catch (error) {
      this.destroy();
      throw error;
    }
  }

  /** Displacement of reference points in the tissue, two numbers each, mm. @param {Numbers} points @returns {Float64Array} */
  displacementAt(points) {
    const { functions } = this.core;
    const given = this.core.place(points);
    const result = this.core.allocate(8 * points.length);
    try {
      this.check(functions.echospline_forced_displacement_at(this.handle, given, BigInt(points.length / 2), result));
      return new Float64Array(this.core.buffer, result, points.length).slice();
    } finally {
      functions.free(given);
      functions.free(result);
    }
  }

  /**
   * Displacement of the mesh nodes and of points under load cases, in that order: (nodes + points, 2, cases) mm.
   * @param {Numbers} places (m, 2) mm @param {Numbers} forces (m, 2, cases) N @param {Numbers} points (p, 2) mm
   * @returns {Float64Array}
   */
  answers(places, forces, points) {
    const { functions } = this.core;
    const cases = forces.length / places.length;
    const [mesh, at] = [this.numbers * cases, points.length * cases];
    const given = [places, forces, points].map((numbers) => this.core.place(numbers));
    const result = this.core.allocate(8 * (mesh + at));
    try {
      const status = functions.echospline_green_answer(
        this.response, given[0], BigInt(places.length / 2), given[1], BigInt(cases), given[2], BigInt(points.length / 2),
        result, BigInt(mesh), result + 8 * mesh, BigInt(at));
      this.core.check(status, "green", this.response);
      return new Float64Array(this.core.buffer, result, mesh + at).slice();
    } finally {
      for (const address of [...given, result]) functions.free(address);
    }
  }

  destroy() {
    super.destroy();
    this.core.functions.echospline_green_destroy(this.response);
    this.response = 0;
  }
}

/** Make a response from its tables. @param {Core} core @param {GreenTables} tables @param {number} level @returns {number} handle */
function createGreen(core, tables, level) {
  const shape = LAYOUTS.echospline_green_options;
  const at = core.allocate(shape.size);
  /** @type {Record<string, number>} */
  const placed = {};
  /** @type {Record<string, number>} */
  const counts = {};
  try {
    for (const [name, [count, width, type]] of Object.entries(GREEN_TABLES)) {
      const given = /** @type {Numbers | undefined} */ (tables[name]);
      if (given === undefined) continue;
      placed[name] = core.allocate(type.BYTES_PER_ELEMENT * given.length);
      new type(core.buffer, placed[name], given.length).set(given);
      if (count !== "") counts[count] = given.length / width;
    }
    core.write(at, shape, { struct_size: shape.size });
    core.functions.echospline_green_defaults(at);
    core.write(at, shape, { ...tables, ...placed, ...counts, level });
    return core.create("green", at);
  } finally {
    for (const address of [at, ...Object.values(placed)]) core.functions.free(address);
  }
}

/** Numbers of echospline_green_options that tables name, with their type; pairs are numbers per axis. */
const GREEN_NUMBERS = Object.freeze(LAYOUTS.echospline_green_options.fields.filter(({ name, kind }) => kind !== "pointer" &&
  (name === "band_count" || !["struct_size", "level", "reserved", "rank"].includes(name) && !name.endsWith("_count"))));

/** Refuse tables that are no numbers, or shorter than others say: the core has no other way to know. @param {GreenTables} tables */
function checkTables(tables) {
  const refuse = (/** @type {number} */ status, /** @type {string} */ text) => {
    throw new CoreError(status, text);
  };
  const known = new Set([...GREEN_NUMBERS.map(({ name }) => name), ...Object.keys(GREEN_TABLES)]);
  const unknown = Object.keys(tables).filter((name) => !known.has(name));
  if (unknown.length > 0) refuse(Status.WRONG_VALUE, `expected tables of echospline_green_options; got ${unknown.join(", ")}`);
  for (const { name, kind, count } of GREEN_NUMBERS) {
    if (tables[name] === undefined && count === 1) continue;
    const values = count > 1 ? Array.from(/** @type {any} */ (tables[name] ?? [])) : [tables[name]];
    const right = kind === "f64" ? Number.isFinite : Number.isSafeInteger;
    if (values.length !== count || !values.every((value) => right(value))) {
      refuse(Status.WRONG_VALUE, `expected ${count} ${kind === "f64" ? "finite" : "whole"} number${count > 1 ? "s" : ""} of ${name}; got ${tables[name]}`);
    }
  }
  const length = (/** @type {string} */ name) => /** @type {Numbers | undefined} */ (tables[name])?.length ?? 0;
  for (const [name, [, width]] of Object.entries(GREEN_TABLES)) {
    if (tables[name] === undefined || Number.isInteger(length(name) / width) && typeof tables[name] === "object") continue;
    refuse(Status.WRONG_SIZE, `expected ${width} numbers per entry of ${name}; got ${tables[name]}`.slice(0, 200));
  }
  if (tables.method === GreenMethod.GREEN_SOLVE) return;
  const bodies = length("bodies") / 2;
  const bands = Number(tables.band_count ?? 0);
  const expected = { depths: bands + 1, circles: 3 * (bodies - bands), source_counts: bodies, sides: 3 * length("conditions") / 4 };
  for (const [name, count] of Object.entries(expected)) {
    if (length(name) !== count) refuse(Status.WRONG_SIZE, `expected ${count} numbers of ${name}; got ${length(name)}`);
  }
}

/** One needle's session in a scene. */
export class Tissue {
  /** @param {Scene} scene */
  constructor(scene) {
    this.core = scene.core;
    this.dimension = scene.dimension;
    this.numbers = scene.nodeCount * scene.dimension;
    this.handle = this.core.create("tissue", scene.handle);
    this.pose = this.core.allocate(LAYOUTS.echospline_pose.size);
    this.field = this.core.allocate(8 * this.numbers);
  }

  /** Throw unless a call succeeded. @param {number} status */
  check(status) {
    this.core.check(status, "tissue", this.handle);
  }

  /** Back to rest. */
  reset() {
    this.check(this.core.functions.echospline_tissue_reset(this.handle));
  }

  /** Advance by one step. @param {Pose} pose */
  advance(pose) {
    const view = new Float64Array(this.core.buffer, this.pose, 8);
    for (let i = 0; i < 3; ++i) {
      view[i] = pose.entry[i] ?? 0;
      view[3 + i] = pose.tip[i] ?? 0;
    }
    view[6] = pose.speed;
    view[7] = pose.dt;
    this.check(this.core.functions.echospline_advance(this.handle, this.pose));
  }

  /** Displacement of the mesh nodes, dimension numbers each, mm: a view. @returns {Float64Array} */
  displacement() {
    const { functions } = this.core;
    this.check(functions.echospline_displacement(this.handle, this.field, BigInt(this.numbers)));
    return new Float64Array(this.core.buffer, this.field, this.numbers);
  }

  /** The same in single precision: a view. @returns {Float32Array} */
  displacementSingle() {
    const { functions } = this.core;
    this.check(functions.echospline_displacement_single(this.handle, this.field, BigInt(this.numbers)));
    return new Float32Array(this.core.buffer, this.field, this.numbers);
  }

  /** Displacement of reference points, dimension numbers each, mm. @param {Numbers} points @returns {Float64Array} */
  displacementAt(points) {
    const { functions } = this.core;
    const count = points.length / this.dimension;
    const given = this.core.place(points);
    const result = this.core.allocate(8 * points.length);
    try {
      this.check(functions.echospline_displacement_at(this.handle, given, BigInt(count), result));
      return new Float64Array(this.core.buffer, result, points.length).slice();
    } finally {
      functions.free(given);
      functions.free(result);
    }
  }

  /** Landmarks that move. @returns {Landmark[]} */
  landmarks() {
    const { functions } = this.core;
    const shape = LAYOUTS.echospline_landmark;
    const number = this.core.allocate(8);
    let list = 0;
    try {
      this.check(functions.echospline_landmarks(this.handle, 0, 0n, number));
      const count = Number(new BigInt64Array(this.core.buffer, number, 1)[0]);
      list = this.core.allocate(count * shape.size);
      this.check(functions.echospline_landmarks(this.handle, list, BigInt(count), number));
      return Array.from({ length: count }, (_, i) => /** @type {any} */ (this.core.read(list + i * shape.size, shape)));
    } finally {
      functions.free(number);
      functions.free(list);
    }
  }

  /** Counts since the tissue was created. @returns {Statistics} */
  statistics() {
    const shape = LAYOUTS.echospline_statistics;
    const at = this.core.allocate(shape.size);
    try {
      this.core.write(at, shape, { struct_size: shape.size });
      this.check(this.core.functions.echospline_tissue_statistics(this.handle, at));
      return /** @type {any} */ (this.core.read(at, shape));
    } finally {
      this.core.functions.free(at);
    }
  }

  /** The present state as bytes. @returns {Uint8Array} */
  save() {
    const { functions } = this.core;
    const size = Number(functions.echospline_state_size(this.handle));
    const at = this.core.allocate(size);
    try {
      this.check(functions.echospline_state_save(this.handle, at, BigInt(size)));
      return new Uint8Array(this.core.buffer, at, size).slice();
    } finally {
      functions.free(at);
    }
  }

  /** Make saved bytes the present state. @param {Uint8Array} bytes */
  load(bytes) {
    const { functions } = this.core;
    const at = this.core.allocate(bytes.length);
    try {
      new Uint8Array(this.core.buffer, at, bytes.length).set(bytes);
      this.check(functions.echospline_state_load(this.handle, at, BigInt(bytes.length)));
    } finally {
      functions.free(at);
    }
  }

  destroy() {
    const { functions } = this.core;
    functions.echospline_tissue_destroy(this.handle);
    functions.free(this.pose);
    functions.free(this.field);
    this.handle = this.pose = this.field = 0;
  }
}

/** A reference image, its deformation and a needle's echo. */
export class Picture {
  /** @param {Core} core @param {PictureOptions} options @param {Pixels} pixels */
  constructor(core, options, pixels) {
    this.core = core;
    const shape = LAYOUTS.echospline_picture_options;
    const at = core.allocate(shape.size);
    const image = core.allocate(pixels.byteLength);
    try {
      core.write(at, shape, { struct_size: shape.size });
      core.functions.echospline_picture_defaults(at);
      core.write(at, shape, options);
      const { columns, rows, channels, pixel_type, mesh_shape } = /** @type {any} */ (core.read(at, shape));
      /** @type {number} */
      this.pixels = columns * rows;
      this.columns = columns;
      this.grey = pixel_type === PixelType.UINT8 && channels === 1;
      const type = [Uint8Array, Uint16Array, Int16Array, Float32Array][pixel_type];
      const expected = this.pixels * channels;
      if (type === undefined || !(pixels instanceof type) || pixels.length !== expected) {
        const came = `${pixels.constructor.name} of ${pixels.length}`;
        throw new CoreError(Status.WRONG_SIZE, `expected ${type?.name} of ${expected} (rows, columns, channels); got ${came}`);
      }
      this.type = type;
      new Uint8Array(core.buffer, image, pixels.byteLength).set(bytesOf(pixels));
      this.handle = core.create("picture", at, image);
      /** @type {number} */
      this.numbers = 2 * mesh_shape[0] * mesh_shape[1];
    } finally {
      core.functions.free(at);
      core.functions.free(image);
    }
    this.size = Number(core.functions.echospline_picture_size(this.handle));
    this.level = core.text(core.functions.echospline_level_name(core.functions.echospline_picture_level(this.handle)));
    this.out = core.allocate(this.size);
    this.rgba = this.grey ? core.allocate(4 * this.pixels) : 0;
    this.field = core.allocate(8 * this.numbers);
    this.needle = core.allocate(LAYOUTS.echospline_needle.size);
  }

  /** Throw unless a call succeeded. @param {number} status */
  check(status) {
    this.core.check(status, "picture", this.handle);
  }

  /** Replace the reference by pixels of the same layout. @param {Pixels} pixels */
  reference(pixels) {
    const at = this.core.allocate(pixels.byteLength);
    try {
      new Uint8Array(this.core.buffer, at, pixels.byteLength).set(bytesOf(pixels));
      this.check(this.core.functions.echospline_picture_reference(this.handle, at, BigInt(pixels.byteLength)));
    } finally {
      this.core.functions.free(at);
    }
  }

  /** Deform by the displacement of the mesh nodes, two numbers each, mm. @param {Float64Array | Float32Array} displacement */
  deform(displacement) {
    const { functions } = this.core;
    if (displacement.length !== this.numbers) {
      throw new CoreError(Status.WRONG_SIZE, `expected ${this.numbers} numbers of displacement; got ${displacement.length}`);
    }
    const single = displacement instanceof Float32Array;
    new (single ? Float32Array : Float64Array)(this.core.buffer, this.field, this.numbers).set(displacement);
    const deform = single ? functions.echospline_picture_deform_single : functions.echospline_picture_deform;
    this.check(deform(this.handle, this.field, BigInt(this.numbers)));
  }

  /** Deform as a tissue in the plane is now, without a copy; the mesh has to be the tissue's. @param {Tissue | Forced} tissue */
  follow(tissue) {
    if (tissue instanceof Forced) {
      if (tissue.numbers !== this.numbers) {
        throw new CoreError(Status.WRONG_SIZE, `expected a tissue of ${this.numbers / 2} nodes; got ${tissue.numbers / 2}`);
      }
      const { functions } = this.core;
      tissue.displacementSingle();
      this.check(functions.echospline_picture_deform_single(this.handle, tissue.field, BigInt(this.numbers)));
      return;
    }
    this.check(this.core.functions.echospline_picture_follow(this.handle, tissue.handle));
  }

  /** Draw the picture: a view. @param {Needle | null} needle @returns {Pixels} */
  draw(needle) {
    const at = needle === null ? 0 : this.placeNeedle(needle);
    this.check(this.core.functions.echospline_picture_draw(this.handle, at, this.out, BigInt(this.size)));
    return new this.type(this.core.buffer, this.out, this.size / this.type.BYTES_PER_ELEMENT);
  }

  /**
   * Shade the picture that was drawn last, for ImageData: a view of red, green, blue and alpha.
   * @param {Look} look @returns {Uint8ClampedArray}
   */
  shade(look) {
    if (!this.grey) throw new CoreError(Status.WRONG_VALUE, "expected a picture of grey Uint8Array pixels; this one is not: draw it as it is");
    this.core.shade(look, this.out, this.columns, this.pixels / this.columns, this.rgba);
    return new Uint8ClampedArray(this.core.buffer, this.rgba, 4 * this.pixels);
  }

  /** Column and row of the reference that each pixel comes from; NaN where no tissue is. @returns {{ x: Float32Array, y: Float32Array }} */
  inverse() {
    const { functions } = this.core;
    const at = this.core.allocate(8 * this.pixels);
    try {
      const y = at + 4 * this.pixels;
      this.check(functions.echospline_picture_inverse(this.handle, at, y, BigInt(this.pixels)));
      const { buffer } = this.core;
      return { x: new Float32Array(buffer, at, this.pixels).slice(), y: new Float32Array(buffer, y, this.pixels).slice() };
    } finally {
      functions.free(at);
    }
  }

  /** Check the inverse against the forward map, and find folds. @returns {PictureReport} */
  report() {
    const shape = LAYOUTS.echospline_picture_report;
    const at = this.core.allocate(shape.size);
    try {
      this.core.write(at, shape, { struct_size: shape.size });
      this.check(this.core.functions.echospline_picture_check(this.handle, at));
      return /** @type {any} */ (this.core.read(at, shape));
    } finally {
      this.core.functions.free(at);
    }
  }

  /**
   * Echo at points of the plane, two numbers each, mm: power relative to white, and share of the tissue's power that passes.
   * @param {Needle} needle @param {Numbers} points @returns {{ power: Float64Array, transmission: Float64Array }}
   */
  echo(needle, points) {
    const { functions } = this.core;
    const count = points.length / 2;
    const given = this.core.place(points);
    const result = this.core.allocate(16 * count);
    try {
      const status = functions.echospline_picture_echo(
        this.handle, this.placeNeedle(needle), given, BigInt(count), result, result + 8 * count);
      this.check(status);
      const { buffer } = this.core;
      const [power, transmission] = [result, result + 8 * count].map((at) => new Float64Array(buffer, at, count).slice());
      return { power, transmission };
    } finally {
      functions.free(given);
      functions.free(result);
    }
  }

  /** Address of a needle: the core's default one with what is given. @param {Needle} needle @returns {number} */
  placeNeedle(needle) {
    const shape = LAYOUTS.echospline_needle;
    this.core.write(this.needle, shape, { struct_size: shape.size });
    this.core.functions.echospline_needle_defaults(this.needle);
    this.core.write(this.needle, shape, needle);
    return this.needle;
  }

  destroy() {
    const { functions } = this.core;
    functions.echospline_picture_destroy(this.handle);
    for (const at of [this.out, this.rgba, this.field, this.needle]) functions.free(at);
    this.handle = this.out = this.rgba = this.field = this.needle = 0;
  }
}

/** Voxels that probes make pictures of. */
export class Volume {
  /** @param {Core} core @param {VolumeOptions} options @param {Uint8Array} voxels */
  constructor(core, options, voxels) {
    this.core = core;
    const shape = LAYOUTS.echospline_volume_options;
    const [x, y, z] = Array.from(options.shape);
    if (!(voxels instanceof Uint8Array) || voxels.length !== x * y * z) {
      const came = `${voxels?.constructor.name} of ${voxels?.length}`;
      throw new CoreError(Status.WRONG_SIZE, `expected Uint8Array of ${x * y * z} voxels (z, y, x); got ${came}`);
    }
    const at = core.allocate(shape.size);
    const given = core.allocate(voxels.length);
    try {
      core.write(at, shape, { struct_size: shape.size, level: 0, reserved: 0, ...options });
      new Uint8Array(core.buffer, given, voxels.length).set(voxels);
      this.handle = core.create("volume", at, given);
    } finally {
      core.functions.free(at);
      core.functions.free(given);
    }
  }

  destroy() {
    this.core.functions.echospline_volume_destroy(this.handle);
    this.handle = 0;
  }
}

/** Displacement by point forces in space, and a smooth one on a lattice. */
export class ForceField {
  /** @param {Core} core @param {ForceFieldOptions} options */
  constructor(core, options) {
    this.core = core;
    const shape = LAYOUTS.echospline_force_field;
    const count = options.radii.length;
    if (options.places.length !== 3 * count || options.forces.length !== 3 * count) {
      const came = `${options.places.length} and ${options.forces.length}`;
      throw new CoreError(Status.WRONG_SIZE, `expected ${3 * count} numbers of places and of forces, three for each radius; got ${came}`);
    }
    this.places = core.place(options.places);
    this.forces = core.place(options.forces);
    this.radii = core.place(options.radii);
    this.lattice = options.lattice ? core.place(options.lattice) : 0;
    /** Address of echospline_force_field. */
    this.fieldAt = core.allocate(shape.size);
    new Uint8Array(core.buffer, this.fieldAt, shape.size).fill(0);
    const { places, forces, radii, lattice } = this;
    core.write(this.fieldAt, shape, { ...options, struct_size: shape.size, places, forces, radii, lattice, force_count: count });
  }

  /** Displacement of points in the undeformed tissue, three numbers each, mm. @param {Numbers} points @returns {Float64Array} */
  displacementAt(points) {
    return displacementOf(this.core, this.fieldAt, points);
  }

  destroy() {
    for (const at of [this.places, this.forces, this.radii, this.lattice, this.fieldAt]) this.core.functions.free(at);
    this.places = this.forces = this.radii = this.lattice = this.fieldAt = 0;
  }
}

/** Tissue in space under a needle that sticks, slips and cuts. After `move` it may be drawn: `plane.draw(matrix, spatial, needle)`. */
export class Spatial {
  /** @param {Core} core @param {SpatialOptions} options @param {SpatialAnswer | null} answer */
  constructor(core, options, answer) {
    this.core = core;
    this.answer = answer;
    const { functions } = core;
    const shape = LAYOUTS.echospline_spatial_options;
    const known = new Set(shape.fields.map(({ name }) => name));
    const unknown = Object.keys(options).filter((name) => !known.has(name));
    if (unknown.length > 0) {
      throw new CoreError(Status.WRONG_VALUE, `expected names of echospline_spatial_options; got ${unknown.join(", ")}`);
    }
    const numbers = (/** @type {string} */ name) => /** @type {Numbers} */ (options[name] ?? []);
    const faces = numbers("condition_faces");
    if (numbers("conditions").length !== 3 * faces.length || numbers("sources").length % 3 !== 0) {
      const came = `${numbers("conditions").length}, ${faces.length} and ${numbers("sources").length}`;
      throw new CoreError(Status.WRONG_SIZE, `expected three numbers of conditions for each of condition_faces, and of each source; got ${came}`);
    }
    const at = core.allocate(shape.size);
    /** @type {Record<string, number>} */
    const placed = {};
    try {
      for (const name of ["sources", "conditions", "answers"]) placed[name] = core.place(numbers(name));
      placed.condition_faces = core.allocate(4 * faces.length);
      new Uint32Array(core.buffer, placed.condition_faces, faces.length).set(faces);
      const counts = { source_count: numbers("sources").length / 3, condition_count: faces.length, answer_count: numbers("answers").length };
      core.write(at, shape, { struct_size: shape.size });
      functions.echospline_spatial_defaults(at);
      core.write(at, shape, { ...options, ...placed, ...counts });
      this.handle = core.create("spatial", at);
    } finally {
      for (const address of [at, ...Object.values(placed)]) functions.free(address);
    }
    this.pose = core.allocate(LAYOUTS.echospline_pose.size);
    /** Address of echospline_force_field, which `move` fills. */
    this.fieldAt = core.allocate(LAYOUTS.echospline_force_field.size);
    core.write(this.fieldAt, LAYOUTS.echospline_force_field, { struct_size: LAYOUTS.echospline_force_field.size });
  }

  /** Throw unless a call succeeded. @param {number} status */
  check(status) {
    this.core.check(status, "spatial", this.handle);
  }

  /** Back to rest. */
  reset() {
    this.check(this.core.functions.echospline_spatial_reset(this.handle));
  }

  /** Advance by one step. @param {Pose} pose */
  advance(pose) {
    const { functions } = this.core;
    this.core.write(this.pose, LAYOUTS.echospline_pose, pose);
    let status = functions.echospline_spatial_advance(this.handle, this.pose);
    while (status === Status.NEEDS_STATION && this.answer !== null) {
      const wanted = /** @type {any} */ (this.given("echospline_spatial_station", (at) => functions.echospline_spatial_wanted(this.handle, at)));
      const rows = this.answer(wanted);
      const at = this.core.place(rows);
      try {
        this.check(functions.echospline_spatial_answer(this.handle, at, BigInt(rows.length)));
      } finally {
        functions.free(at);
      }
      status = functions.echospline_spatial_advance(this.handle, this.pose);
    }
    this.check(status);
  }

  /** A struct that a call fills. @param {keyof typeof LAYOUTS} name @param {(at: number) => number} call @returns {Record<string, number | number[]>} */
  given(name, call) {
    const at = this.core.allocate(LAYOUTS[name].size);
    try {
      this.check(call(at));
      return this.core.read(at, LAYOUTS[name]);
    } finally {
      this.core.functions.free(at);
    }
  }

  /** The needle's forces. @returns {SpatialLoad} */
  load() {
    const { functions } = this.core;
    return /** @type {any} */ (this.given("echospline_spatial_load", (at) => functions.echospline_spatial_needle(this.handle, at)));
  }

  /** Force at every station, three numbers each, N. @returns {Float64Array} */
  forces() {
    const { functions } = this.core;
    return this.listed(
      (list, room, count) => functions.echospline_spatial_forces(this.handle, list, room, count), 24,
      (at, count) => new Float64Array(this.core.buffer, at, 3 * count).slice());
  }

  /** Where they act. @returns {SpatialStation[]} */
  stations() {
    const { functions } = this.core;
    const shape = LAYOUTS.echospline_spatial_station;
    return this.listed(
      (list, room, count) => functions.echospline_spatial_stations(this.handle, list, room, count), shape.size,
      (at, count) => Array.from({ length: count }, (_, i) => /** @type {any} */ (this.core.read(at + i * shape.size, shape))));
  }

  /** What a function writes of which there are many. @template T @param {(list: number, room: bigint, count: number) => number} call @param {number} size @param {(at: number, count: number) => T} read @returns {T} */
  listed(call, size, read) {
    const { functions } = this.core;
    const number = this.core.allocate(8);
    let list = 0;
    try {
      this.check(call(0, 0n, number));
      const count = Number(new BigInt64Array(this.core.buffer, number, 1)[0]);
      list = this.core.allocate(size * count);
      this.check(call(list, BigInt(count), number));
      return read(list, count);
    } finally {
      functions.free(number);
      functions.free(list);
    }
  }

  /** Find the displacement of the present state, for `displacementAt` and for drawing; where the core answers. @returns {Spatial} */
  move() {
    this.check(this.core.functions.echospline_spatial_field(this.handle, this.fieldAt));
    return this;
  }

  /** Displacement of points in the undeformed tissue, three numbers each, mm, after `move`. @param {Numbers} points @returns {Float64Array} */
  displacementAt(points) {
    return displacementOf(this.core, this.fieldAt, points);
  }

  /** The present state as bytes. @returns {Uint8Array} */
  save() {
    const { functions } = this.core;
    const size = Number(functions.echospline_spatial_state_size(this.handle));
    const at = this.core.allocate(size);
    try {
      this.check(functions.echospline_spatial_state_save(this.handle, at, BigInt(size)));
      return new Uint8Array(this.core.buffer, at, size).slice();
    } finally {
      functions.free(at);
    }
  }

  /** Make saved bytes the present state. @param {Uint8Array} bytes */
  restore(bytes) {
    const { functions } = this.core;
    const at = this.core.allocate(bytes.length);
    try {
      new Uint8Array(this.core.buffer, at, bytes.length).set(bytes);
      this.check(functions.echospline_spatial_state_load(this.handle, at, BigInt(bytes.length)));
    } finally {
      functions.free(at);
    }
  }

  destroy() {
    const { functions } = this.core;
    functions.echospline_spatial_destroy(this.handle);
    for (const at of [this.pose, this.fieldAt]) functions.free(at);
    this.handle = this.pose = this.fieldAt = 0;
  }
}

/** Displacement of points by a field in the module's memory. @param {Core} core @param {number} field address @param {Numbers} points @returns {Float64Array} */
function displacementOf(core, field, points) {
  const { functions } = core;
  const count = points.length / 3;
  const given = core.place(points);
  const result = core.allocate(8 * points.length);
  try {
    const status = functions.echospline_force_field_at(field, given, BigInt(count), result);
    if (status !== Status.OK) throw new CoreError(status, core.text(functions.echospline_status_text(status)));
    return new Float64Array(core.buffer, result, points.length).slice();
  } finally {
    functions.free(given);
    functions.free(result);
  }
}

/** The picture of a plane through a volume, which moves: deformed as tissue is, with a needle's echo. */
export class PlanePicture {
  /** @param {Volume} volume @param {PlaneOptions} options */
  constructor(volume, options) {
    const { core } = volume;
    const { columns, rows, step, mask, spread } = options;
    this.core = core;
    this.volume = volume;
    this.options = options;
    this.across = Math.ceil((columns - 1) / step) + 1;
    this.numbers = 3 * this.across * (Math.ceil((rows - 1) / step) + 1);
    const [dx, dy] = Array.from(options.spacing);
    const mesh = { mesh_shape: [2, 2], mesh_spacing: [Math.max(columns - 1, 1) * dx, Math.max(rows - 1, 1) * dy] };
    const look = { interpolation: Interpolation.NEAREST, mesh_origin: options.origin, origin: options.origin };
    /** Draws the needle, and holds the picture. */
    this.picture = core.picture({ columns, rows, spacing: options.spacing, ...mesh, ...look }, new Uint8Array(columns * rows));
    this.places = core.allocate(8 * this.numbers);
    this.lattice = core.allocate(8 * this.numbers);
    this.slice = core.allocate(LAYOUTS.echospline_slice.size);
    this.report = core.allocate(LAYOUTS.echospline_trace_report.size);
    this.tip = core.allocate(24);
    this.count = core.allocate(8);
    this.sliced = core.allocate(columns * rows);
    this.spread = 0;
    this.mask = 0;
    if (spread) {
      this.spread = core.allocate(4 * rows);
      new Float32Array(core.buffer, this.spread, rows).set(spread);
    }
    if (mask) {
      this.mask = core.allocate(columns * rows);
      new Uint8Array(core.buffer, this.mask, columns * rows).set(mask);
    }
  }

  /**
   * Draw the plane that a matrix (16 numbers, row by row) takes from the picture's frame to the scene's.
   * @param {Numbers} matrix @param {Moving | null} moving @param {Needle | null} needle entry and tip in the scene's frame, mm
   * @returns {Uint8Array} grey levels: a view
   */
  draw(matrix, moving, needle) {
    const { core, volume, options } = this;
    const { columns, rows, step } = options;
    const { functions } = core;
    const m = Array.from(matrix);
    const shape = LAYOUTS.echospline_slice;
    const { spread, mask } = this;
    const given = { columns, rows, step, normal: [m[2], m[6], m[10]], spread, mask, background: options.background ?? 0 };
    core.write(this.slice, shape, { ...given, struct_size: shape.size, reserved: 0 });
    const places = new Float64Array(core.buffer, this.places, this.numbers);
    for (let i = 0; i < this.numbers / 3; ++i) {
      const x = options.origin[0] + (i % this.across) * step * options.spacing[0];
      const y = options.origin[1] + Math.floor(i / this.across) * step * options.spacing[1];
      for (let k = 0; k < 3; ++k) places[3 * i + k] = m[4 * k] * x + m[4 * k + 1] * y + m[4 * k + 3];
    }
    const report = LAYOUTS.echospline_trace_report;
    core.write(this.report, report, { struct_size: report.size, residual: 0, folded: 0, jacobian: Infinity, place: [0, 0, 0] });
    const numbers = BigInt(this.numbers);
    if (moving !== null) {
      if (needle) new Float64Array(core.buffer, this.tip, 3).set(/** @type {Numbers} */ (needle.tip));
      const close = 0.05 * Math.min(options.spacing[0], options.spacing[1]); // a twentieth of a pixel, as in Python
      const tip = needle ? this.tip : 0;
      const { handle } = volume;
      this.check("fieldAt" in moving
        ? functions.echospline_volume_trace(
          handle, this.slice, moving.fieldAt, this.places, numbers, tip, close, this.lattice, this.report)
        : functions.echospline_volume_trace_tissue(
          handle, this.slice, moving.handle, this.places, numbers, tip, close, this.lattice, this.report));
    }
    const from = moving === null ? this.places : this.lattice;
    const bytes = BigInt(columns * rows);
    this.check(functions.echospline_volume_slice(volume.handle, this.slice, from, numbers, this.sliced, bytes, this.count));
    const picture = this.picture;
    picture.check(functions.echospline_picture_reference(picture.handle, this.sliced, bytes));
    const grey = picture.draw(needle ? this.lowered(m, needle) : null);
    if (needle && this.mask) {
      const shown = new Uint8Array(core.buffer, this.mask, columns * rows);
      const background = options.background ?? 0;
      for (let i = 0; i < grey.length; ++i) if (shown[i] === 0) grey[i] = background;
    }
    return /** @type {Uint8Array} */ (grey);
  }

  /** Needle in the frame of the plane. @param {number[]} m @param {Needle} needle @returns {Needle} */
  lowered(m, needle) {
    const [entry, tip] = [needle.entry, needle.tip].map((point) => {
      const d = [0, 1, 2].map((k) => /** @type {any} */ (point)[k] - m[4 * k + 3]);
      return [0, 1, 2].map((c) => m[c] * d[0] + m[4 + c] * d[1] + m[8 + c] * d[2]);
    });
    return { ...needle, entry, tip };
  }

  /** Shade the picture that was drawn last, for ImageData: a view. @param {Look} look @returns {Uint8ClampedArray} */
  shade(look) {
    return this.picture.shade(look);
  }

  /** How the last picture was traced back; `outside`: shown pixels outside the volume. @returns {PlaneReport} */
  traced() {
    const outside = Number(new BigInt64Array(this.core.buffer, this.count, 1)[0]);
    return { .../** @type {any} */ (this.core.read(this.report, LAYOUTS.echospline_trace_report)), outside };
  }

  /** Throw unless a call succeeded. @param {number} status */
  check(status) {
    this.core.check(status, "volume", this.volume.handle);
  }

  destroy() {
    this.picture.destroy();
    const own = [this.places, this.lattice, this.slice, this.report, this.tip, this.count, this.sliced, this.spread, this.mask];
    for (const at of own) this.core.functions.free(at);
    this.places = this.lattice = this.slice = this.report = this.tip = this.count = this.sliced = this.spread = this.mask = 0;
  }
}

/** Bytes under a typed array. @param {Pixels} pixels @returns {Uint8Array} */
function bytesOf(pixels) {
  return new Uint8Array(pixels.buffer, pixels.byteOffset, pixels.byteLength);
}
