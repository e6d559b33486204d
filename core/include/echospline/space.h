/*
 * space.h: volumes, slices through them and fields of point forces in space; the C interface of the core for scenes in space.
 *
 * Conventions and errors are those of echospline.h. The face for C# does not have these functions yet.
 */
#ifndef ECHOSPLINE_SPACE_H
#define ECHOSPLINE_SPACE_H

#include "echospline.h"

#ifdef __cplusplus
extern "C" {
#endif

/* A volume of 8-bit voxels, x fastest, then y, then z: what a probe in space makes pictures of. */
typedef struct echospline_volume_options {
  uint32_t struct_size;
  int32_t level;
  int32_t shape[3]; /* voxels along x, y, z */
  int32_t reserved;
  double spacing[3]; /* mm */
  double origin[3];  /* centre of the first voxel, mm */
} echospline_volume_options;

/* A picture of a bent slice: where its pixels lie in the undeformed volume. */
typedef struct echospline_slice {
  uint32_t struct_size;
  int32_t columns, rows;
  int32_t
      step; /* pixels between neighbours of the lattice, which begins at pixel (0, 0) and ends at or beyond the last */
  double normal[3];    /* unit vector across the slice */
  const float* spread; /* (rows) thickness of the beam: sigma, mm; NULL: none */
  const uint8_t* mask; /* (rows, columns) 0 where nothing is shown; NULL: everything is */
  int32_t background;  /* grey level outside mask and volume */
  int32_t reserved;
} echospline_slice;

typedef struct echospline_volume echospline_volume;

/* The voxels are copied. A volume only changes its message, so many threads may draw slices of it. */
ECHOSPLINE_API echospline_status echospline_volume_create(const echospline_volume_options* options,
                                                          const uint8_t* voxels, echospline_volume** volume);
ECHOSPLINE_API void echospline_volume_destroy(echospline_volume* volume);
ECHOSPLINE_API const char* echospline_volume_message(const echospline_volume* volume);
/* Draw a slice. The lattice holds places in the undeformed volume (rows of it, columns of it, 3) mm, `count` numbers: as many rows and columns
 * as steps take to reach the last pixel, and one. `outside` (or NULL) is set to the number of shown pixels that lie outside the volume. */
ECHOSPLINE_API echospline_status echospline_volume_slice(echospline_volume* volume, const echospline_slice* slice,
                                                         const double* lattice, int64_t count, uint8_t* out,
                                                         int64_t bytes, int64_t* outside);

enum {                            /* what the surface y = 0 of elastic tissue is */
       ECHOSPLINE_TOP_NONE = 0,   /* there is none: tissue goes on */
       ECHOSPLINE_TOP_FREE = 1,   /* free of traction (Mindlin 1936) */
       ECHOSPLINE_TOP_SLIDING = 2 /* a frictionless face lies on it: skin under a probe */
};

/* Point forces in homogeneous elastic tissue in space; with a surface they lie below it. A displacement that is smooth, what forces
 * far away do, may be given on a lattice instead, and is added between its points by cubic convolution. */
typedef struct echospline_force_field {
  uint32_t struct_size;
  int32_t level;
  int32_t top;
  int32_t reserved;
  double poisson;       /* above -1 and below 0.5 */
  double shear_modulus; /* N/mm^2 */
  const double* places; /* (force_count, 3) mm */
  const double* forces; /* (force_count, 3) N */
  const double* radii;  /* (force_count) over which a force is spread, mm, positive */
  int64_t force_count;
  int32_t lattice_shape[3]; /* points along x, y, z, 4 or more each; not read where lattice is NULL */
  int32_t lattice_reserved;
  double lattice_spacing[3]; /* mm */
  double lattice_origin[3];  /* mm */
  const double* lattice;     /* (nz, ny, nx, 3) displacement, mm, or NULL */
} echospline_force_field;

/* Displacement (count, 3) mm at points (count, 3) mm, in single precision; above a surface it goes on as it is there. */
ECHOSPLINE_API echospline_status echospline_force_field_at(const echospline_force_field* field, const double* points,
                                                           int64_t count, double* displacement);

/* How well a lattice was traced back. */
typedef struct echospline_trace_report {
  uint32_t struct_size;
  int32_t reserved;
  double
      residual; /* largest distance midway between the lattice's places from the forward map of the origin there, mm */
  int64_t folded;  /* places at which tissue is turned inside out, or to which none leads */
  double jacobian; /* smallest determinant of I + grad u at those, or infinite where there are none */
  double place[3]; /* where that is, in the undeformed tissue, mm */
} echospline_trace_report;

/* Find where the places of a slice's lattice come from: X + u(X) = p. `lattice` is what echospline_volume_slice draws from.
 * places, lattice (count numbers): as those of echospline_volume_slice. close: distance within which a place has to be reached, mm.
 * tip: the needle's, (3) mm, around which folds are looked for; NULL: only where Newton's method was needed. */
ECHOSPLINE_API echospline_status echospline_volume_trace(echospline_volume* volume, const echospline_slice* slice,
                                                         const echospline_force_field* field, const double* places,
                                                         int64_t count, const double* tip, double close,
                                                         double* lattice, echospline_trace_report* report);
/* The same for a tissue in space of echospline.h. */
ECHOSPLINE_API echospline_status echospline_volume_trace_tissue(echospline_volume* volume,
                                                                const echospline_slice* slice,
                                                                echospline_tissue* tissue, const double* places,
                                                                int64_t count, const double* tip, double close,
                                                                double* lattice, echospline_trace_report* report);

/* ---- Tissue in space under a needle's forces ---------------------------------------------------------------------- */

/* The law of echospline_forced in space. Homogeneous tissue is answered by the core from tables (mechanics/space_response.py makes them, in
 * Python); with source_count 0 the host answers, one station of the track at a time, as in the plane:
 *
 *     while ((status = echospline_spatial_advance(spatial, &pose)) == ECHOSPLINE_NEEDS_STATION) {
 *       echospline_spatial_wanted(spatial, &station);
 *       ... rows: displacement by its forces at the stations so far ...
 *       echospline_spatial_answer(spatial, rows, count);
 *     } */

typedef struct echospline_spatial_options {
  uint32_t struct_size;
  int32_t level;
  double low[3], high[3]; /* least and greatest corner of the tissue, mm; with a surface low[1] is 0 */
  double tip, friction_limit, bond, tip_stiffness, side_stiffness, viscosity; /* as in echospline_forced_options */
  double station_spacing, substep, dead_band;
  int32_t top;      /* ECHOSPLINE_TOP_NONE where the face y = low[1] is held by boundary forces, as the others are */
  uint32_t clamped; /* faces, bits of ECHOSPLINE_LEFT ...; others are free or slide */
  uint32_t sliding;
  int32_t reserved;
  double poisson, shear_modulus, radius; /* -, N/mm^2; over which a force of the needle is spread, mm */
  double source_radius;                  /* over which a boundary force is spread, mm */
  double traction_length;                /* weight of a traction over the shear modulus among displacements, mm */
  const double* sources;                 /* (source_count, 3) places of the boundary forces, mm */
  int64_t source_count;
  const double* conditions;        /* (condition_count, 3) points on the faces, mm */
  const uint32_t* condition_faces; /* (condition_count) the face of each */
  int64_t condition_count;
  const double*
      answers; /* (3 * source_count + motions, 3 * condition_count): boundary forces, N, and rigid motions (6, or shifts
                            along x and z and the turn about y under a sliding top) by what the needle does to the conditions */
  int64_t answer_count;     /* numbers of it */
  int32_t lattice_shape[3]; /* of the lattice that carries what the faces do, 4 or more points each */
  int32_t lattice_reserved;
  double lattice_spacing[3], lattice_origin[3]; /* mm */
} echospline_spatial_options;

typedef struct echospline_spatial_station {
  int64_t index;       /* along the track, 0 at the surface */
  double place[3];     /* in the undeformed tissue, mm */
  double axis[3];      /* of the needle when the tip cut there */
  double points[12];   /* (point_count, 3) mm: where the station's force acts */
  double weights[4];   /* share of the force at each point; they add up to 1 */
  int32_t point_count; /* 0 to 4; 0: outside the tissue, its rows are zero */
  int32_t reserved;
} echospline_spatial_station;

typedef struct echospline_spatial_load {
  double tip;       /* of the tip along the axis, N, zero or more */
  double friction;  /* sum along the axis, N; negative on withdrawal */
  double side;      /* size of the sum across the axis, N */
  double cut;       /* length of track cut so far, mm */
  double force[3];  /* of all, N */
  double torque[3]; /* of all about the entry, N mm */
} echospline_spatial_load;

typedef struct echospline_spatial echospline_spatial;

/* Fill options with the law's usual numbers. Corners have to be set, and what answers, if the core shall. */
ECHOSPLINE_API void echospline_spatial_defaults(echospline_spatial_options* options);
/* A forced tissue in space at rest. The tables are copied. */
ECHOSPLINE_API echospline_status echospline_spatial_create(const echospline_spatial_options* options,
                                                           echospline_spatial** spatial);
ECHOSPLINE_API void echospline_spatial_destroy(echospline_spatial* spatial);
ECHOSPLINE_API const char* echospline_spatial_message(const echospline_spatial* spatial);

/* Back to rest: tissue that no needle has touched. Answers are kept. */
ECHOSPLINE_API echospline_status echospline_spatial_reset(echospline_spatial* spatial);
/* Advance by one step: the needle has moved to pose in pose->dt seconds. The pose's speed is not read. */
ECHOSPLINE_API echospline_status echospline_spatial_advance(echospline_spatial* spatial, const echospline_pose* pose);
/* The station that the last call needs. */
ECHOSPLINE_API echospline_status echospline_spatial_wanted(echospline_spatial* spatial,
                                                           echospline_spatial_station* station);
/* Answer it: rows (index + 1, 3, 3): [station, component, direction of the force], mean displacement over the stations before it and, last,
 * itself, mm/N. Copied. */
ECHOSPLINE_API echospline_status echospline_spatial_answer(echospline_spatial* spatial, const double* rows,
                                                           int64_t count);
/* Forces of the present state. */
ECHOSPLINE_API echospline_status echospline_spatial_needle(echospline_spatial* spatial, echospline_spatial_load* load);
/* Force at each of the present state's stations, (stations, 3) N; `count` is set to the stations' number, and no more than `room` forces are
 * written. */
ECHOSPLINE_API echospline_status echospline_spatial_forces(echospline_spatial* spatial, double* forces, int64_t room,
                                                           int64_t* count);
/* Where they act: the present state's stations. `count` is set to their number, and no more than `room` are written. */
ECHOSPLINE_API echospline_status echospline_spatial_stations(echospline_spatial* spatial,
                                                             echospline_spatial_station* stations, int64_t room,
                                                             int64_t* count);
/* Displacement of the present state, where the core answers: `field` is filled, and points into the tissue until its next call. */
ECHOSPLINE_API echospline_status echospline_spatial_field(echospline_spatial* spatial, echospline_force_field* field);

/* States as bytes, as those of a tissue. They hold the track and the forces, not the answers. */
ECHOSPLINE_API int64_t echospline_spatial_state_size(const echospline_spatial* spatial);
ECHOSPLINE_API echospline_status echospline_spatial_state_save(echospline_spatial* spatial, void* bytes, int64_t size);
ECHOSPLINE_API echospline_status echospline_spatial_state_load(echospline_spatial* spatial, const void* bytes,
                                                               int64_t size);

#ifdef __cplusplus
}
#endif

#endif
