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

#ifdef __cplusplus
}
#endif

#endif
