/* Green's function over the C interface alone: closed forms with forces outside the tissue and triangles answer alike, a needle whose
 * stations a green answers, states as bytes, tables that are refused. */
#include "echospline/green.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { ACROSS = 20, DOWN = 15, SOURCES = 2 * (ACROSS + DOWN), POINTS = 3 * SOURCES, UNKNOWNS = 2 * SOURCES + 3 };
enum { NODES = (ACROSS + 1) * (DOWN + 1), TRIANGLES = 2 * ACROSS * DOWN };
enum { HELD = 2 * (2 * ACROSS + 1) * (2 * DOWN + 1) };

#define REQUIRE(right)                                                                                           \
  if (!(right)) {                                                                                                \
    printf("line %d: expected %s; %s; %s\n", __LINE__, #right, forced ? echospline_forced_message(forced) : "-", \
           green[0] ? echospline_green_message(green[0]) : "-");                                                 \
    return 1;                                                                                                    \
  }

static double sources[2 * SOURCES], conditions[4 * POINTS], lines_x[ACROSS + 1], lines_y[DOWN + 1],
    moduli[2 * TRIANGLES];
static int32_t sides[3 * POINTS], order[UNKNOWNS], source_counts[1] = {SOURCES};
static uint8_t held[HELD];
static const double bodies[2] = {0.3, 0.02}, depths[2] = {0, DOWN};

/* A point of the outline of the tissue grown by `out`, at a share of the way round, and the normal there. */
static void outline(double share, double out, double* place) {
  const double width = ACROSS + 2 * out, height = DOWN + 2 * out;
  double s = share * 2 * (width + height);
  const int edge = s < width ? 0 : s < width + height ? 1 : s < 2 * width + height ? 2 : 3;
  s -= edge == 0 ? 0 : edge == 1 ? width : edge == 2 ? width + height : 2 * width + height;
  place[0] = (edge == 0 ? s : edge == 1 ? width : edge == 2 ? width - s : 0) - out;
  place[1] = (edge == 0 ? 0 : edge == 1 ? s : edge == 2 ? height : height - s) - out;
  place[2] = edge == 1 ? 1 : edge == 3 ? -1 : 0, place[3] = edge == 2 ? 1 : edge == 0 ? -1 : 0;
}

static void common(echospline_green_options* o, int32_t method) {
  o->struct_size = sizeof *o;
  echospline_green_defaults(o);
  o->method = method, o->clamped = ECHOSPLINE_LEFT | ECHOSPLINE_RIGHT | ECHOSPLINE_TOP | ECHOSPLINE_BOTTOM;
  o->shape[0] = ACROSS + 1, o->shape[1] = DOWN + 1, o->spacing[0] = o->spacing[1] = 1, o->radius = 0.4;
}

int main(void) {
  echospline_green* green[2] = {NULL, NULL};
  echospline_forced* forced = NULL;
  echospline_green_options boundary, solve;
  common(&boundary, ECHOSPLINE_GREEN_BOUNDARY);
  common(&solve, ECHOSPLINE_GREEN_SOLVE);
  for (int i = 0; i < SOURCES; ++i) {
    double place[4];
    outline((i + 0.5) / SOURCES, 2, place);
    sources[2 * i] = place[0], sources[2 * i + 1] = place[1];
  }
  for (int i = 0; i < POINTS; ++i) {
    outline((i + 0.5) / POINTS, 0, conditions + 4 * i);
    sides[3 * i] = ECHOSPLINE_CONDITION_CLAMPED, sides[3 * i + 2] = -1;
  }
  for (int i = 0; i < UNKNOWNS; ++i) order[i] = i;
  boundary.weight = 100, boundary.pin_weight = 1;
  boundary.bodies = bodies, boundary.depths = depths, boundary.sources = sources,
  boundary.source_counts = source_counts;
  boundary.conditions = conditions, boundary.sides = sides, boundary.order = order;
  boundary.body_count = boundary.band_count = 1, boundary.source_count = SOURCES, boundary.condition_count = POINTS;
  boundary.rank = UNKNOWNS;
  for (int i = 0; i <= ACROSS; ++i) lines_x[i] = i;
  for (int i = 0; i <= DOWN; ++i) lines_y[i] = i;
  for (int i = 0; i < TRIANGLES; ++i)
    moduli[2 * i] = 2 * bodies[1] * bodies[0] / (1 - 2 * bodies[0]), moduli[2 * i + 1] = bodies[1];
  for (int j = 0; j <= 2 * DOWN; ++j)
    for (int i = 0; i <= 2 * ACROSS; ++i)
      for (int d = 0; d < 2; ++d)
        held[2 * (j * (2 * ACROSS + 1) + i) + d] = i == 0 || j == 0 || i == 2 * ACROSS || j == 2 * DOWN;
  solve.lines_x = lines_x, solve.lines_y = lines_y, solve.moduli = moduli, solve.held = held;
  solve.line_x_count = ACROSS + 1, solve.line_y_count = DOWN + 1, solve.triangle_count = TRIANGLES,
  solve.held_count = HELD;

  REQUIRE(echospline_green_create(&boundary, &green[0]) == ECHOSPLINE_OK);
  REQUIRE(echospline_green_create(&solve, &green[1]) == ECHOSPLINE_OK);
  const double place[2] = {9.5, 7.25}, force[6] = {0.1, 0, 0.05, 0, 0.1, -0.02}, points[4] = {6.3, 4.1, 14.2, 10.7};
  static double mesh[2][6 * NODES];
  double at[2][12];
  for (int k = 0; k < 2; ++k)
    REQUIRE(echospline_green_answer(green[k], place, 1, force, 3, points, 2, mesh[k], 6 * NODES, at[k], 12) ==
            ECHOSPLINE_OK);
  double largest = 0, apart = 0;
  for (int i = 0; i < 12; ++i) largest = fmax(largest, fabs(at[0][i])), apart = fmax(apart, fabs(at[0][i] - at[1][i]));
  REQUIRE(largest > 0.01 && apart < 0.01 * largest);
  for (int i = 0; i < NODES;
       ++i) { /* the third load case is half the first less a fifth of the second; the edges hold still */
    const int x = i % (ACROSS + 1), y = i / (ACROSS + 1), edge = x == 0 || y == 0 || x == ACROSS || y == DOWN;
    for (int d = 0; d < 2; ++d) {
      const double* u = mesh[0] + (2 * i + d) * 3;
      REQUIRE(fabs(u[2] - (0.5 * u[0] - 0.2 * u[1])) < 1e-12 && (!edge || u[0] == 0));
      if (hypot(x - place[0], y - place[1]) > 2) REQUIRE(fabs(u[0] - mesh[1][(2 * i + d) * 3]) < 0.02 * largest);
    }
  }
  REQUIRE(echospline_green_answer(green[0], place, 1, force, 3, points, 2, mesh[0], 5, at[0], 12) ==
          ECHOSPLINE_WRONG_SIZE);
  REQUIRE(echospline_green_answer(green[0], NULL, 1, force, 3, NULL, 0, NULL, 0, NULL, 0) == ECHOSPLINE_NULL_POINTER);

  echospline_forced_options options = {.struct_size = sizeof options};
  echospline_forced_defaults(&options);
  options.node_count = NODES, options.high[0] = ACROSS, options.high[1] = DOWN;
  for (int k = 0; k < 2; ++k) {
    REQUIRE(echospline_forced_create(&options, &forced) == ECHOSPLINE_OK);
    REQUIRE(echospline_forced_attach(forced, green[k]) == ECHOSPLINE_OK);
    echospline_pose pose;
    memset(&pose, 0, sizeof pose);
    pose.entry[0] = pose.tip[0] = 9, pose.dt = 0.01;
    for (int step = 1; step <= 100; ++step) {
      pose.tip[1] = 0.1 * step;
      REQUIRE(echospline_forced_advance(forced, &pose) == ECHOSPLINE_OK);
    }
    REQUIRE(echospline_forced_displacement(forced, mesh[k], 2 * NODES) == ECHOSPLINE_OK);
    REQUIRE(echospline_forced_displacement_at(forced, points, 2, at[k]) == ECHOSPLINE_OK);
    const int64_t size = echospline_forced_state_size(forced);
    unsigned char* bytes = malloc((size_t)size);
    REQUIRE(bytes && echospline_forced_state_save(forced, bytes, size) == ECHOSPLINE_OK);
    REQUIRE(echospline_forced_reset(forced) == ECHOSPLINE_OK &&
            echospline_forced_attach(forced, NULL) == ECHOSPLINE_OK);
    REQUIRE(echospline_forced_displacement_at(forced, points, 2, at[k]) == ECHOSPLINE_WRONG_VALUE);
    REQUIRE(echospline_forced_attach(forced, green[k]) == ECHOSPLINE_OK);
    REQUIRE(echospline_forced_state_load(forced, bytes, size) == ECHOSPLINE_OK);
    free(bytes);
    double again[4];
    REQUIRE(echospline_forced_displacement_at(forced, points, 2, again) == ECHOSPLINE_OK);
    REQUIRE(memcmp(again, at[k], sizeof again) == 0);
    echospline_forced_destroy(forced), forced = NULL;
  }
  for (int i = 0; i < 4; ++i) REQUIRE(fabs(at[0][i]) > 1e-3 && fabs(at[0][i] - at[1][i]) < 2e-2);

  echospline_green* refused = NULL;
  boundary.rank = UNKNOWNS + 1;
  REQUIRE(echospline_green_create(&boundary, &refused) == ECHOSPLINE_WRONG_SIZE &&
          strstr(echospline_green_message(refused), "rank"));
  echospline_green_destroy(refused);
  memset(held, 0, sizeof held);
  REQUIRE(echospline_green_create(&solve, &refused) == ECHOSPLINE_NOT_HELD);
  echospline_green_destroy(refused);
  solve.struct_size = 8;
  REQUIRE(echospline_green_create(&solve, &refused) == ECHOSPLINE_WRONG_SIZE);
  REQUIRE(echospline_green_answer(refused, place, 1, force, 1, NULL, 0, NULL, 0, NULL, 0) == ECHOSPLINE_FAILED_HANDLE);
  echospline_green_destroy(refused);
  for (int k = 0; k < 2; ++k) echospline_green_destroy(green[k]);
  return 0;
}
