/*
 * green.h: how elastic tissue in the plane answers forces, evaluated in the core; part of the C interface.
 *
 * Conventions and errors are those of echospline.h. A *green* is made from tables that `GreenResponse.tables()` of the Python package writes
 * for a scene. Attached to a forced tissue it answers every station, so that `echospline_forced_advance` never returns
 * ECHOSPLINE_NEEDS_STATION and a host without Python runs Green's function. A green only changes its message: threads may share it if
 * none of them reads that.
 */
#ifndef ECHOSPLINE_GREEN_H
#define ECHOSPLINE_GREEN_H

#include "echospline.h"

#ifdef __cplusplus
extern "C" {
#endif

enum {                                /* method */
       ECHOSPLINE_GREEN_BOUNDARY = 0, /* closed forms, and forces outside every part of the tissue */
       ECHOSPLINE_GREEN_SOLVE = 1     /* quadratic triangles, factored by create */
};
enum {                                     /* kind of a condition */
       ECHOSPLINE_CONDITION_CLAMPED = 0,   /* no displacement */
       ECHOSPLINE_CONDITION_SLIDING_X = 1, /* no displacement along x, no traction along y */
       ECHOSPLINE_CONDITION_SLIDING_Y = 2,
       ECHOSPLINE_CONDITION_FREE = 3,     /* no traction */
       ECHOSPLINE_CONDITION_INTERFACE = 4 /* displacement and traction of two bodies agree */
};

/* Arrays are copied; those of the other method are not read. */
typedef struct echospline_green_options {
  uint32_t struct_size;
  int32_t level;
  int32_t method;
  uint32_t clamped; /* edges that do not move: bits of ECHOSPLINE_LEFT ... ECHOSPLINE_BOTTOM */
  uint32_t sliding; /* edges that move along themselves alone; others are free */
  int32_t shape[2]; /* nodes of the mesh whose displacement is wanted, 2 or more each; its extent is the tissue */
  int32_t reserved;
  double spacing[2]; /* mm */
  double origin[2];  /* first node, mm */
  double radius;     /* over which a force is spread, mm */

  /* boundary: bodies are bands from top to bottom, then round parts inside them */
  double weight; /* length that turns a traction into a displacement, over the shear modulus and thickness, mm^2/N */
  double pin_weight; /* of a clamped point beside a condition */
  double pin_radius; /* of the force at a clamped point, mm */
  double lattice; /* distance of the sources from the edges, mm, where their field is taken from a Chebyshev lattice on
                                  fine meshes; 0: it never is */
  const double* bodies;  /* (body_count, 2): Poisson's ratio in plane strain, shear modulus times thickness in N/mm */
  const double* depths;  /* (bands + 1) where bands begin and end, mm, ascending */
  const double* circles; /* (body_count - bands, 3): centre and radius of round parts, mm */
  const double* sources; /* (source_count, 2) places of the forces outside each body, in the order of the bodies, mm */
  const int32_t* source_counts; /* (body_count) */
  const double* conditions;     /* (condition_count, 4): place in mm and unit normal out of the first body */
  const int32_t* sides;         /* (condition_count, 3): kind, body, other body (-1 but at an interface) */
  const double* pins;           /* (pin_count, 2) clamped points, mm */
  const int32_t*
      order; /* (rank) unknowns that are kept, best first: sources x, y of every body, then its motions as a whole; pins */
  const double*
      right; /* (unknowns, rank) and (rank, rows): strengths are -right left conditions. NULL: found by create */
  const double* left;
  int64_t body_count, band_count, source_count, condition_count, pin_count, rank;

  /* solve: rectangles between lines, cut into two triangles */
  const double* lines_x; /* mm, ascending, from edge to edge */
  const double* lines_y;
  const double* moduli; /* (triangles, 2): Lame's parameters times thickness, N/mm */
  const uint8_t* held;  /* (nodes of the triangles, 2): 1 where a component does not move */
  int64_t line_x_count, line_y_count, triangle_count, held_count;
} echospline_green_options;

typedef struct echospline_green echospline_green;

/* Fill options with zeros but struct_size and best level. Does nothing when options is NULL or its struct_size is not set. */
ECHOSPLINE_API void echospline_green_defaults(echospline_green_options* options);
ECHOSPLINE_API echospline_status echospline_green_create(const echospline_green_options* options,
                                                         echospline_green** green);
ECHOSPLINE_API void echospline_green_destroy(
    echospline_green* green); /* after all forced tissues that it is attached to */
ECHOSPLINE_API const char* echospline_green_message(const echospline_green* green);

/* Displacement under load cases: forces (place_count, 2, case_count) N at places (place_count, 2) mm in the tissue. `mesh` gets that of
 * the nodes, (nodes, 2, case_count) mm, and `at` that of points (point_count, 2), (point_count, 2, case_count) mm; either may be NULL. */
ECHOSPLINE_API echospline_status echospline_green_answer(echospline_green* green, const double* places,
                                                         int64_t place_count, const double* forces, int64_t case_count,
                                                         const double* points, int64_t point_count, double* mesh,
                                                         int64_t mesh_count, double* at, int64_t at_count);

/* Let a green answer every station of a forced tissue of the same mesh, extent and level; NULL detaches it. Answers so far are forgotten,
 * the state stays. */
ECHOSPLINE_API echospline_status echospline_forced_attach(echospline_forced* forced, const echospline_green* green);
/* Displacement of any reference points in the tissue (point_count, 2) mm under the present forces; needs an attached green. */
ECHOSPLINE_API echospline_status echospline_forced_displacement_at(echospline_forced* forced, const double* points,
                                                                   int64_t point_count, double* displacement);

#ifdef __cplusplus
}
#endif

#endif
