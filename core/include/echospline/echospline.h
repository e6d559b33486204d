/*
 * echospline.h: tissue that a needle deforms, and its ultrasound picture, in memory. The C interface of the core.
 *
 * Scenes are read-only and shared by threads; one tissue, and one picture, belongs to one thread at a time.
 *
 * - A *scene* is what is given: mesh, clamped and sliding edges, parameters. It is factored once and never changes.
 * - A *tissue* is one needle's session in a scene: the present state and the workspace that makes a step fast.
 *   States are values: `echospline_state_save` and `echospline_state_load` carry them as versioned bytes.
 * - A *picture* is a reference image, its deformation and the needle's echo.
 *
 * Conventions. Lengths in mm, times in s, angles in degrees. A point is (x lateral, y depth, z elevation); with dimension 2
 * the third number is not read. Displacement is deformed minus reference. A mesh of shape (nx, ny[, nz]) numbers its nodes
 * with x fastest. All arrays belong to the caller and are not kept unless a function says so.
 *
 * Errors. Functions return a status; `echospline_..._message` of the handle says in one sentence what was expected, what came and
 * what to do. A `create` that fails still sets the handle, unless memory ran out: it only carries its message, and has
 * to be destroyed. `destroy` takes NULL. Structs that grow carry `struct_size`; fill them with their `defaults` function.
 */
#ifndef ECHOSPLINE_H
#define ECHOSPLINE_H

#include <stdint.h>

#define ECHOSPLINE_VERSION_MAJOR 0
#define ECHOSPLINE_VERSION_MINOR 1
#define ECHOSPLINE_VERSION_PATCH 0

#if defined(ECHOSPLINE_STATIC)
#define ECHOSPLINE_API
#elif defined(_WIN32) && defined(ECHOSPLINE_BUILD)
#define ECHOSPLINE_API __declspec(dllexport)
#elif defined(_WIN32)
#define ECHOSPLINE_API __declspec(dllimport)
#else
#define ECHOSPLINE_API __attribute__((visibility("default")))
#endif

#ifdef __cplusplus
extern "C" {
#endif

/* ---- Status ------------------------------------------------------------------------------------------------------- */

typedef int32_t echospline_status;
enum {
  ECHOSPLINE_OK = 0,
  ECHOSPLINE_NULL_POINTER = 1,  /* a pointer that must be given is NULL */
  ECHOSPLINE_WRONG_SIZE = 2,    /* a struct_size, count or shape that does not fit */
  ECHOSPLINE_WRONG_VALUE = 3,   /* a number out of its range or not finite, an unknown choice */
  ECHOSPLINE_OUT_OF_MEMORY = 4, /* nothing has changed */
  ECHOSPLINE_NOT_HELD = 5,      /* what is held does not determine the field */
  ECHOSPLINE_NOT_SOLVED = 6,    /* landmarks cannot be told apart; the state has not changed */
  ECHOSPLINE_WRONG_STATE = 7,   /* bytes of another version or scene, or damaged */
  ECHOSPLINE_FAILED_HANDLE = 8, /* the handle's create had failed: it only carries a message */
  ECHOSPLINE_NEEDS_STATION = 9  /* no failure: a forced tissue waits for the answer to a station */
};

/* Name of a status, for logs; never NULL. */
ECHOSPLINE_API const char* echospline_status_text(echospline_status status);

/* ---- Version and processor level ---------------------------------------------------------------------------------- */

/* major * 65536 + minor * 256 + patch of the library; compare with ECHOSPLINE_VERSION_... of the header. */
ECHOSPLINE_API uint32_t echospline_version(void);

enum {
  ECHOSPLINE_LEVEL_BEST = 0,     /* in options: what the processor has */
  ECHOSPLINE_LEVEL_BASELINE = 1, /* x86-64 with SSE2, or the plain level of another processor */
  ECHOSPLINE_LEVEL_AVX2 = 2,     /* AVX2 and FMA */
  ECHOSPLINE_LEVEL_AVX512 = 3,   /* AVX-512 F, BW, DQ, VL */
  ECHOSPLINE_LEVEL_NEON = 4,
  ECHOSPLINE_LEVEL_SIMD128 = 5 /* WebAssembly */
};

/* Best level that this library holds and this processor and system can run. */
ECHOSPLINE_API int32_t echospline_level_best(void);
/* 1 where a level can be asked for in options, else 0. */
ECHOSPLINE_API int32_t echospline_level_available(int32_t level);
/* Name of a level ("AVX2"), or "unknown"; never NULL. */
ECHOSPLINE_API const char* echospline_level_name(int32_t level);

/* ---- Scene -------------------------------------------------------------------------------------------------------- */

enum { ECHOSPLINE_THIN_PLATE = 0, ECHOSPLINE_ELASTIC = 1 };                     /* kernel */
enum { ECHOSPLINE_SINGLE = 0, ECHOSPLINE_DOUBLE = 1 };                          /* precision of the field */
enum { ECHOSPLINE_TIP_POINT = 0, ECHOSPLINE_TIP_NODE = 1 };                     /* landmark of the tip */
enum { ECHOSPLINE_FOLLOW = 0, ECHOSPLINE_IMMEDIATE = 1, ECHOSPLINE_STICK = 2 }; /* loading */
enum { ECHOSPLINE_PLANE_STRESS = 0, ECHOSPLINE_PLANE_STRAIN = 1 };              /* elastic kernel in the plane */
enum {                                                                          /* edges (2-D) or faces (3-D), bits */
       ECHOSPLINE_LEFT = 1,                                                     /* least x */
       ECHOSPLINE_RIGHT = 2,
       ECHOSPLINE_TOP = 4, /* least y: at the probe */
       ECHOSPLINE_BOTTOM = 8,
       ECHOSPLINE_FRONT = 16, /* least z, 3-D alone */
       ECHOSPLINE_BACK = 32
};

typedef struct echospline_scene_options {
  uint32_t struct_size;
  int32_t dimension; /* 2 or 3 */
  int32_t kernel;    /* ECHOSPLINE_THIN_PLATE, equation (3), or ECHOSPLINE_ELASTIC */
  int32_t precision;
  int32_t tip;
  int32_t loading;
  int32_t plane;
  uint32_t clamped; /* edges that do not move: bits of ECHOSPLINE_LEFT ... */
  int32_t level;
  int32_t shape[3];             /* nodes along x, y, z, 2 or more each */
  double spacing[3];            /* mm */
  double origin[3];             /* position of the first node, mm */
  double sigma;                 /* push of the tip, equation (12), mm */
  double delta;                 /* reach of friction around the shaft, equation (13), mm */
  double alpha1, alpha2;        /* friction, equation (15), s */
  double alpha3;                /* rate of relaxation, equation (16), 1/s */
  double length;                /* length in the exponential of equation (15), mm */
  double drag;                  /* share of the shaft's sideways motion that contacts follow, 0 to 1 */
  double contact_spacing;       /* distance between nodes that may become contacts, mm; 0: every node */
  double anchor_spacing;        /* greatest distance between anchors along held edges, mm */
  double poisson;               /* elastic kernel: Poisson's ratio */
  double radius;                /* elastic kernel: regularisation length, mm */
  const double* clamped_points; /* (clamped_point_count, dimension) mm, or NULL */
  int64_t clamped_point_count;
  const double* stiffness; /* per mesh node, how firmly a landmark there holds its displacement; NULL: infinitely */
  int64_t stiffness_count; /* number of mesh nodes, or 0 */
  int64_t contact_room;    /* contacts for which memory is reserved; 0 chooses. More are possible and allocate once. */
  uint32_t sliding; /* edges that move along themselves alone, without friction: bits as `clamped`. Others are free. */
  uint32_t reserved;
  double friction_speed; /* speed at which equation (15) says how far friction holds tissue that sticks, mm/s */
} echospline_scene_options;

typedef struct echospline_scene echospline_scene;

/* Fill options with the parameters of the paper's plane scene: left, right and bottom (and front and back) clamped. Shape and
 * spacing have to be set. Does nothing when options is NULL or its struct_size is not set. */
ECHOSPLINE_API void echospline_scene_defaults(echospline_scene_options* options);

/* Factor a scene. The arrays that options point to are copied. */
ECHOSPLINE_API echospline_status echospline_scene_create(const echospline_scene_options* options,
                                                         echospline_scene** scene);
ECHOSPLINE_API void echospline_scene_destroy(echospline_scene* scene); /* after all its tissues */
ECHOSPLINE_API const char* echospline_scene_message(const echospline_scene* scene);

ECHOSPLINE_API int32_t echospline_scene_level(const echospline_scene* scene);
ECHOSPLINE_API int64_t echospline_scene_node_count(const echospline_scene* scene);
ECHOSPLINE_API int64_t echospline_scene_anchor_count(const echospline_scene* scene);
ECHOSPLINE_API int64_t
echospline_scene_source_count(const echospline_scene* scene); /* nodes that may become contacts */
/* Anchors, (anchor_count, dimension) mm; count: numbers that there is room for. */
ECHOSPLINE_API echospline_status echospline_scene_anchors(echospline_scene* scene, double* anchors, int64_t count);
/* Mesh nodes that may become contacts, ascending. */
ECHOSPLINE_API echospline_status echospline_scene_sources(echospline_scene* scene, int64_t* nodes, int64_t count);

/* ---- Needle ------------------------------------------------------------------------------------------------------- */

typedef struct echospline_pose {
  double entry[3]; /* n_s, mm */
  double tip[3];   /* n_t, mm */
  double speed;    /* of the tip along the axis relative to the entry, mm/s; negative on withdrawal */
  double dt;       /* time since the pose before, s, zero or more */
} echospline_pose;

typedef struct echospline_command {
  double entry[3]; /* where the needle shall go, mm */
  double tip[3];
  double lag;     /* time constant with which it follows, s; 0: at once */
  double fastest; /* upper limit of its speed, mm/s */
} echospline_command;

/* Move a needle one step of next->dt seconds from now towards a command; fills entry, tip and speed of `next`. `next` may be `now`. */
ECHOSPLINE_API echospline_status echospline_follow(const echospline_pose* now, const echospline_command* command,
                                                   echospline_pose* next);

/* ---- Tissue ------------------------------------------------------------------------------------------------------- */

typedef struct echospline_tissue echospline_tissue;

enum {                         /* kind of a landmark that moves */
       ECHOSPLINE_CONTACT = 0, /* a node that touches the shaft */
       ECHOSPLINE_LEAVING = 1, /* a node that has left it and relaxes */
       ECHOSPLINE_TIP = 2,     /* the tip, pushing */
       ECHOSPLINE_TIP_LEFT = 3 /* where the tip was, relaxing */
};

typedef struct echospline_landmark {
  double place[3];        /* in the undeformed tissue, mm */
  double displacement[3]; /* mm */
  double grip[3]; /* of a contact: displacement across the axis less the shaft's position when it was touched, mm */
  double along;   /* of a contact: where on the shaft it was touched, mm from the entry */
  int64_t node;   /* mesh node; -1 for the tip */
  int32_t kind;
  int32_t reserved;
} echospline_landmark;

typedef struct echospline_statistics {
  uint32_t struct_size;
  int32_t reserved;
  int64_t steps;        /* since the tissue was created */
  int64_t joined, left; /* contacts */
  int64_t rebuilt;      /* times the contacts' inverse was made anew because rounding had grown */
  int64_t held_back;    /* steps since rest in which the landmarks were slowed down so that the picture does not jump */
  int64_t allocations;  /* made by steps; 0 as long as the reserved room is enough */
  double residual;      /* largest misfit at the landmarks seen, mm for displacements of 1 mm */
} echospline_statistics;

/* A tissue at rest. The scene must live longer. */
ECHOSPLINE_API echospline_status echospline_tissue_create(const echospline_scene* scene, echospline_tissue** tissue);
ECHOSPLINE_API void echospline_tissue_destroy(echospline_tissue* tissue);
ECHOSPLINE_API const char* echospline_tissue_message(const echospline_tissue* tissue);

/* Back to rest: tissue that no needle has touched. */
ECHOSPLINE_API echospline_status echospline_tissue_reset(echospline_tissue* tissue);
/* Advance by one step: the needle has moved to pose in pose->dt seconds, equations (12) to (17). */
ECHOSPLINE_API echospline_status echospline_advance(echospline_tissue* tissue, const echospline_pose* pose);

/* Displacement of the mesh nodes, (node_count, dimension) mm; count: numbers that there is room for. */
ECHOSPLINE_API echospline_status echospline_displacement(echospline_tissue* tissue, double* displacement,
                                                         int64_t count);
/* The same in single precision. */
ECHOSPLINE_API echospline_status echospline_displacement_single(echospline_tissue* tissue, float* displacement,
                                                                int64_t count);
/* Displacement of any reference points (point_count, dimension) mm, in the scene's precision. */
ECHOSPLINE_API echospline_status echospline_displacement_at(echospline_tissue* tissue, const double* points,
                                                            int64_t point_count, double* displacement);
/* Landmarks that move; `count` is set to their number, and no more than `room` are written. */
ECHOSPLINE_API echospline_status echospline_landmarks(echospline_tissue* tissue, echospline_landmark* landmarks,
                                                      int64_t room, int64_t* count);
ECHOSPLINE_API echospline_status echospline_tissue_statistics(echospline_tissue* tissue,
                                                              echospline_statistics* statistics);

/* ---- States as values --------------------------------------------------------------------------------------------- */

/* Bytes that the present state takes. */
ECHOSPLINE_API int64_t echospline_state_size(const echospline_tissue* tissue);
ECHOSPLINE_API echospline_status echospline_state_save(echospline_tissue* tissue, void* bytes, int64_t size);
/* Make bytes of the same scene the present state. Bytes are checked; damaged ones change nothing. */
ECHOSPLINE_API echospline_status echospline_state_load(echospline_tissue* tissue, const void* bytes, int64_t size);

/* ---- Picture ------------------------------------------------------------------------------------------------------ */

/* A picture shows the reference image deformed, with a needle in it. A pixel has an area: tissue reaches half a pixel
 * beyond the mesh's outermost nodes, and beyond the reference's outermost centres its outermost pixels count. */

enum { ECHOSPLINE_UINT8 = 0, ECHOSPLINE_UINT16 = 1, ECHOSPLINE_INT16 = 2, ECHOSPLINE_FLOAT32 = 3 }; /* pixel_type */
enum { ECHOSPLINE_LINEAR = 0, ECHOSPLINE_NEAREST = 1 };                                             /* interpolation */
enum {
  ECHOSPLINE_BORDER_VALUE = 0,      /* border_value where no tissue comes to lie */
  ECHOSPLINE_BORDER_TRANSPARENT = 1 /* red, green, blue and alpha are drawn; no needle outside tissue */
};
enum {
  ECHOSPLINE_METHOD_AUTO = 0,  /* the faster one that is good to 0.1 pixel: pull */
  ECHOSPLINE_METHOD_EXACT = 1, /* every pixel traced back in the cells of the mesh */
  ECHOSPLINE_METHOD_PULL = 2   /* every fourth pixel and row, interpolated where that is good to 0.1 pixel */
};

typedef struct echospline_picture_options {
  uint32_t struct_size;
  int32_t pixel_type;
  int32_t channels; /* 1 or 3 (interleaved) */
  int32_t interpolation;
  int32_t border;
  int32_t method;
  int32_t level;
  int32_t columns, rows; /* of the image */
  int32_t mesh_shape[2]; /* nodes along x and y, 2 or more each */
  int32_t reserved;
  double spacing[2];      /* of the pixels, mm */
  double origin[2];       /* centre of pixel (0, 0), mm */
  double mesh_spacing[2]; /* mm */
  double mesh_origin[2];  /* first node, mm */
  double border_value;
  double white; /* grey level at which the display is white; 0: the largest of an integer type, or 1 */
} echospline_picture_options;

enum {                       /* parts of a needle's echo, bits */
       ECHOSPLINE_SHAFT = 1, /* the line of its near wall */
       ECHOSPLINE_BEVEL = 2, /* tip and heel of the bevel */
       ECHOSPLINE_TAIL = 4,  /* ring-down below a shaft that lies across the beam */
       ECHOSPLINE_SHADOW = 8
};

/* A needle and how its echo looks. Levels are dB of power relative to white; sigmas are of amplitude. */
typedef struct echospline_needle {
  uint32_t struct_size;
  uint32_t parts;          /* bits of ECHOSPLINE_SHAFT ... */
  uint32_t seed;           /* of the grain, which is fixed to the needle */
  int32_t curved;          /* 0: beams run along y; 1: away from the apex */
  double entry[3], tip[3]; /* mm; the picture is the plane z = 0 */
  double apex[2];          /* of a curved array, mm; its face is where the beams cross y = 0 below the apex */
  double diameter;         /* mm */
  double lateral, axial;   /* resolution across and along the beam: sigma, mm */
  double elevation;        /* thickness of the slice at its focus: sigma, mm */
  double elevation_depth;  /* of the focus, mm */
  double element_height;   /* of the array across the plane, mm: the slice is thicker off its focus */
  double f_number;         /* depth over aperture: penumbra of the shadow */
  double dynamic_range;    /* of the display, dB */
  double specular;         /* level of a shaft at right angles to the beam, before compounding, dB */
  double lobe;             /* tilt at which that has fallen by 4.3 dB: in the plane, degrees */
  double lobe_elevation;   /* and out of it */
  double steering;         /* beams are compounded at 0 and plus and minus this, degrees; 0: no compounding */
  double roughness;        /* level of the grain at any tilt, dB */
  double rolloff;          /* its loss from 50 to 90 degrees of tilt, dB */
  double wobble;           /* sd of the slow changes along the shaft, dB */
  double patches;          /* sd of the grain's own, in patches of 1.5 mm, dB */
  double bevel;            /* level of the tip, dB */
  double ring_down;        /* first level of the tail relative to the specular echo, dB */
  double ring_down_loss;   /* dB per mm */
  double opacity;          /* share of a blocked ray that is lost, 0 to 1 */
} echospline_needle;

typedef struct echospline_picture_report {
  uint32_t struct_size;
  int32_t method;           /* used: ECHOSPLINE_METHOD_EXACT or ECHOSPLINE_METHOD_PULL */
  double residual;          /* largest distance of a checked pixel from the forward map of its origin, pixels */
  double difference;        /* pull: bound of the distance of reference positions from the exact ones, pixels */
  double exact_share;       /* of the lattice cells traced pixel by pixel; 1 with the exact method */
  int64_t folded_cells;     /* of the mesh: the Jacobian determinant is not positive somewhere in them */
  double smallest_jacobian; /* over the mesh */
  double place[2];          /* where that is, in the reference, mm */
} echospline_picture_report;

typedef struct echospline_picture echospline_picture;

/* Fill options with: grey 8-bit pixels, linear, border 0, automatic method, best level, origins 0. Sizes and spacings
 * have to be set. Does nothing when options is NULL or its struct_size is not set. */
ECHOSPLINE_API void echospline_picture_defaults(echospline_picture_options* options);
/* Fill a needle with an 18-gauge one of which every part is seen by a linear array. Entry and tip have to be set. */
ECHOSPLINE_API void echospline_needle_defaults(echospline_needle* needle);

/* A picture of undeformed tissue. The pixels (rows, columns, channels) are copied; all memory is allocated here. */
ECHOSPLINE_API echospline_status echospline_picture_create(const echospline_picture_options* options,
                                                           const void* pixels, echospline_picture** picture);
ECHOSPLINE_API void echospline_picture_destroy(echospline_picture* picture);
ECHOSPLINE_API const char* echospline_picture_message(const echospline_picture* picture);
ECHOSPLINE_API int32_t echospline_picture_level(const echospline_picture* picture);
/* Bytes that a drawn picture takes. */
ECHOSPLINE_API int64_t echospline_picture_size(const echospline_picture* picture);

/* Replace the reference by pixels of the same layout; bytes: how many there are. */
ECHOSPLINE_API echospline_status echospline_picture_reference(echospline_picture* picture, const void* pixels,
                                                              int64_t bytes);
/* Deform by the displacement of the mesh nodes, (count / 2, 2) mm. */
ECHOSPLINE_API echospline_status echospline_picture_deform(echospline_picture* picture, const double* displacement,
                                                           int64_t count);
ECHOSPLINE_API echospline_status echospline_picture_deform_single(echospline_picture* picture,
                                                                  const float* displacement, int64_t count);

/* Deform as a tissue in the plane is now, straight from its field. The picture's mesh has to be the tissue's; levels and
 * precision may differ. The tissue is only read, and may go on or be destroyed afterwards. */
ECHOSPLINE_API echospline_status echospline_picture_follow(echospline_picture* picture, echospline_tissue* tissue);

/* Draw into bytes of the caller's; needle may be NULL. */
ECHOSPLINE_API echospline_status echospline_picture_draw(echospline_picture* picture, const echospline_needle* needle,
                                                         void* out, int64_t bytes);
/* Where each pixel comes from, exactly, as column and row of the reference, (rows, columns); NaN where no tissue is. */
ECHOSPLINE_API echospline_status echospline_picture_inverse(echospline_picture* picture, float* x, float* y,
                                                            int64_t count);
/* Check the inverse against the forward map, and find folds. */
ECHOSPLINE_API echospline_status echospline_picture_check(echospline_picture* picture,
                                                          echospline_picture_report* report);
/* Echo at points (point_count, 2) mm of the plane: its power relative to white, and the share of the tissue's power
 * that passes the needle. */
ECHOSPLINE_API echospline_status echospline_picture_echo(echospline_picture* picture, const echospline_needle* needle,
                                                         const double* points, int64_t point_count, double* power,
                                                         double* transmission);

/* ---- A picture on a display --------------------------------------------------------------------------------------- */

/* How a recorded 8-bit picture is shown. It is compressed logarithmically: grey 255 is white, grey 0 lies recorded_range below. Where
 * nothing was recorded, grey 0, stays black under any gain; below grey 8 the rise from there is linear. */
typedef struct echospline_look {
  uint32_t struct_size;
  int32_t level;
  int32_t invert;           /* 1: white becomes black */
  int32_t flip;             /* 1: left and right are exchanged */
  double gain;              /* dB, -100 to 100 */
  double recorded_range;    /* of the recorded picture, 1 to 300 dB */
  double dynamic_range;     /* from black to white on the display, 1 to 300 dB */
  int32_t depth_gain_count; /* sliders, 0 to 8 */
  int32_t reserved;
  double
      depth_gains[8]; /* dB, -100 to 100 each, at even distances from the first row to the last, linear between them */
} echospline_look;

/* Fill a look that shows a picture of 60 dB as it is. Does nothing when look is NULL or its struct_size is not set. */
ECHOSPLINE_API void echospline_look_defaults(echospline_look* look);
/* Shade a grey picture (rows, columns) into red, green, blue and alpha (255) of each pixel; bytes: room for them, 4 * columns * rows. */
ECHOSPLINE_API echospline_status echospline_shade(const echospline_look* look, const uint8_t* grey, int32_t columns,
                                                  int32_t rows, uint8_t* rgba, int64_t bytes);

/* ---- Tissue under a needle's forces ------------------------------------------------------------------------------- */

/* A *forced tissue* is elastic tissue in the plane under a needle that sticks, slips and cuts. The core solves the needle's forces and
 * keeps the state; how the tissue answers forces comes from the host (finite elements, a closed form), one station of the track at a time:
 *
 *     while ((status = echospline_forced_advance(forced, &pose)) == ECHOSPLINE_NEEDS_STATION) {
 *       echospline_forced_wanted(forced, &station);              where its forces act
 *       ... columns, rows: displacement by them ...
 *       echospline_forced_answer(forced, columns, count, rows, rows_count);
 *     }
 *
 * The call is repeated with the same pose and goes on where it stopped; with another pose the unfinished step is forgotten. A
 * station is needed about once per station_spacing of new track, and after a state of another track has been loaded. */

typedef struct echospline_forced_options {
  uint32_t struct_size;
  int32_t level;
  int64_t node_count;     /* of the mesh whose displacement is wanted */
  double low[2], high[2]; /* least and greatest corner of the tissue, mm */
  double tip;             /* cutting force, N */
  double friction_limit;  /* per mm of shaft, N/mm */
  double bond;            /* stiffness between shaft and tissue per mm of shaft, N/mm^2 */
  double tip_stiffness;   /* N/mm */
  double side_stiffness;  /* across the shaft, per mm of shaft, N/mm^2 */
  double viscosity;       /* friction beyond its limit per mm of shaft and mm/s of slip, N s/mm^2 */
  double station_spacing; /* mm */
  double substep;         /* longest travel that is solved at once, mm */
  double dead_band;       /* play in the depth to either side, mm */
} echospline_forced_options;

typedef struct echospline_station {
  int64_t index;       /* along the track, 0 at the surface */
  double place[2];     /* in the undeformed tissue, mm */
  double axis[2];      /* of the needle when the tip cut there */
  double points[8];    /* (point_count, 2) mm: where the station's force acts */
  double weights[4];   /* share of the force at each point; they add up to 1 */
  int32_t point_count; /* 0 to 4; 0: outside the tissue, its columns and rows are zero */
  int32_t reserved;
} echospline_station;

typedef struct echospline_needle_load {
  double tip;      /* of the tip along the axis, N, zero or more */
  double friction; /* sum along the axis, N; negative on withdrawal */
  double side;     /* sum across the axis, N; positive towards (-axis y, axis x) */
  double torque;   /* of all forces about the entry, N mm; positive turns x towards y */
  double cut;      /* length of track cut so far, mm */
} echospline_needle_load;

typedef struct echospline_forced echospline_forced;

/* Fill options with the law's usual numbers. Node count and corners have to be set. Does nothing when options is NULL or its
 * struct_size is not set. */
ECHOSPLINE_API void echospline_forced_defaults(echospline_forced_options* options);
/* A forced tissue at rest. */
ECHOSPLINE_API echospline_status echospline_forced_create(const echospline_forced_options* options,
                                                          echospline_forced** forced);
ECHOSPLINE_API void echospline_forced_destroy(echospline_forced* forced);
ECHOSPLINE_API const char* echospline_forced_message(const echospline_forced* forced);

/* Back to rest: tissue that no needle has touched. Answers are kept. */
ECHOSPLINE_API echospline_status echospline_forced_reset(echospline_forced* forced);
/* Advance by one step: the needle has moved to pose in pose->dt seconds. The pose's speed is not read. */
ECHOSPLINE_API echospline_status echospline_forced_advance(echospline_forced* forced, const echospline_pose* pose);
/* The station that the last call needs. */
ECHOSPLINE_API echospline_status echospline_forced_wanted(echospline_forced* forced, echospline_station* station);
/* Stations that have been answered; `count` is set to their number, and no more than `room` are written. */
ECHOSPLINE_API echospline_status echospline_forced_stations(echospline_forced* forced, echospline_station* stations,
                                                            int64_t room, int64_t* count);
/* Answer the wanted station. columns (2, node_count, 2): displacement of the nodes by a unit force along x, then along y, mm/N;
 * rows (index + 1, 2, 2): [station, component, direction of the force], mean displacement over the stations before it and, last, itself.
 * Where a station has no points columns may be NULL with count 0. Both are copied. */
ECHOSPLINE_API echospline_status echospline_forced_answer(echospline_forced* forced, const float* columns,
                                                          int64_t count, const double* rows, int64_t row_count);

/* Forces of the present state. */
ECHOSPLINE_API echospline_status echospline_forced_load(echospline_forced* forced, echospline_needle_load* load);
/* Force at each of the present state's stations, (stations, 2) N; `count` is set to the stations' number, and no more than `room`
 * forces are written. */
ECHOSPLINE_API echospline_status echospline_forced_forces(echospline_forced* forced, double* forces, int64_t room,
                                                          int64_t* count);
/* Displacement of the mesh nodes, (node_count, 2) mm: columns times forces. May need stations after a state was loaded. */
ECHOSPLINE_API echospline_status echospline_forced_displacement(echospline_forced* forced, double* displacement,
                                                                int64_t count);
ECHOSPLINE_API echospline_status echospline_forced_displacement_single(echospline_forced* forced, float* displacement,
                                                                       int64_t count);

/* States as bytes, as those of a tissue. They hold the track and the forces, not the answers. */
ECHOSPLINE_API int64_t echospline_forced_state_size(const echospline_forced* forced);
ECHOSPLINE_API echospline_status echospline_forced_state_save(echospline_forced* forced, void* bytes, int64_t size);
ECHOSPLINE_API echospline_status echospline_forced_state_load(echospline_forced* forced, const void* bytes,
                                                              int64_t size);
#ifdef __cplusplus
}
#endif
#endif
