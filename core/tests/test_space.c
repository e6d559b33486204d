/* A needle in space over the C interface alone: a host that answers and half space that answers itself, a plane through a volume under the
 * field, states as bytes, options that are refused. */
#include "echospline/space.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { SOURCES = 2, UNKNOWNS = 3 * SOURCES + 6, CONDITIONS = 3, SIDE = 40, LATTICE = 6, POINTS = 5 * 5 };

#define REQUIRE(right)                                                                                              \
  if (!(right)) {                                                                                                   \
    printf("line %d: expected %s; %s; %s\n", __LINE__, #right, spatial ? echospline_spatial_message(spatial) : "-", \
           other ? echospline_spatial_message(other) : "-");                                                        \
    return 1;                                                                                                       \
  }

/* No boundary force answers: the tissue is half space, whose compliance is known to be right. */
static double answers[UNKNOWNS * 3 * CONDITIONS];
static const double sources[3 * SOURCES] = {-30, 10, 0, 30, 10, 0},
                                conditions[3 * CONDITIONS] = {-20, 10, 0, 20, 10, 0, 0, 30, 0};
static const uint32_t faces[CONDITIONS] = {ECHOSPLINE_LEFT, ECHOSPLINE_RIGHT, ECHOSPLINE_BOTTOM};

static echospline_spatial_options half_space(void) {
  echospline_spatial_options o;
  memset(&o, 0, sizeof o);
  o.struct_size = sizeof o;
  echospline_spatial_defaults(&o);
  for (int d = 0; d < 3; ++d) {
    o.low[d] = d == 1 ? 0 : -20, o.high[d] = d == 1 ? 30 : 20;
    o.lattice_shape[d] = LATTICE, o.lattice_spacing[d] = 10, o.lattice_origin[d] = o.low[d] - 5;
  }
  o.top = ECHOSPLINE_TOP_FREE, o.clamped = ECHOSPLINE_LEFT | ECHOSPLINE_BOTTOM, o.sliding = ECHOSPLINE_RIGHT;
  o.radius = 1.5;
  o.sources = sources, o.source_count = SOURCES;
  o.conditions = conditions, o.condition_faces = faces, o.condition_count = CONDITIONS;
  o.answers = answers, o.answer_count = UNKNOWNS * 3 * CONDITIONS;
  return o;
}

/* In along a slanting line that turns, and out again. */
static echospline_pose pose_at(int step) {
  const double depth = step < 60 ? 0.45 * step : 0.45 * (120 - step), turn = 0.002 * step;
  echospline_pose pose = {{-4, 0, -3}, {0, 0, 0}, 0, 1.0 / 60};
  const double axis[3] = {0.4 + turn, 0.8, 0.3 - turn};
  const double length = sqrt(axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2]);
  for (int d = 0; d < 3; ++d) pose.tip[d] = pose.entry[d] + depth * axis[d] / length;
  return pose;
}

int main(void) {
  echospline_spatial *spatial = NULL, *other = NULL;
  echospline_spatial_options options = half_space();
  REQUIRE(echospline_spatial_create(&options, &spatial) == ECHOSPLINE_OK);
  REQUIRE(echospline_spatial_create(&options, &other) == ECHOSPLINE_OK);

  /* In: the tip carries its force, the sum of the stations' forces is the load's, and tissue moves along. */
  echospline_spatial_load load;
  static double forces[3 * 512];
  static echospline_spatial_station stations[512];
  int64_t count = 0, listed = 0;
  for (int step = 1; step < 60; ++step) {
    const echospline_pose pose = pose_at(step);
    REQUIRE(echospline_spatial_advance(spatial, &pose) == ECHOSPLINE_OK);
  }
  REQUIRE(echospline_spatial_needle(spatial, &load) == ECHOSPLINE_OK);
  REQUIRE(fabs(load.tip - 0.4) < 1e-6 && load.friction > 0.02 && load.side > 1e-3 && load.cut > 5);
  REQUIRE(echospline_spatial_forces(spatial, forces, 512, &count) == ECHOSPLINE_OK && count > 8);
  REQUIRE(echospline_spatial_stations(spatial, stations, 512, &listed) == ECHOSPLINE_OK && listed == count);
  for (int d = 0; d < 3; ++d) {
    double sum = 0;
    for (int64_t j = 0; j < count; ++j) sum += forces[3 * j + d];
    REQUIRE(fabs(sum - load.force[d]) < 1e-12);
  }
  for (int64_t j = 0; j < count; ++j) REQUIRE(stations[j].index == j && stations[j].point_count <= 4);
  echospline_force_field field;
  memset(&field, 0, sizeof field);
  field.struct_size = sizeof field;
  REQUIRE(echospline_spatial_field(spatial, &field) == ECHOSPLINE_OK && field.force_count > count);
  const double at[6] = {0, 8, 0, 1e3, 1e3, 1e3};
  double u[6];
  REQUIRE(echospline_force_field_at(&field, at, 2, u) == ECHOSPLINE_OK);
  REQUIRE(u[1] > 0.05 && fabs(u[4]) < 1e-2);

  /* A plane through a volume: traced back through that field, and sliced. */
  uint8_t* voxels = malloc(SIDE * SIDE * SIDE);
  if (!voxels) return 1;
  for (int i = 0; i < SIDE * SIDE * SIDE; ++i) voxels[i] = (uint8_t)(6 * (i % SIDE));
  echospline_volume_options shape = {sizeof shape, 0, {SIDE, SIDE, SIDE}, 0, {1, 1, 1}, {-19.5, 0, -19.5}};
  echospline_volume* volume = NULL;
  REQUIRE(echospline_volume_create(&shape, voxels, &volume) == ECHOSPLINE_OK);
  double places[3 * POINTS], lattice[3 * POINTS];
  uint8_t drawn[2][33 * 33], mask[33 * 33];
  for (int i = 0; i < POINTS; ++i)
    places[3 * i] = -8 + 4 * (i % 5), places[3 * i + 1] = 2 + 4 * (i / 5), places[3 * i + 2] = 0;
  for (int i = 0; i < 33 * 33; ++i) mask[i] = i % 33 < 20;
  float spread[33];
  for (int i = 0; i < 33; ++i) spread[i] = 0.5f;
  echospline_slice slice = {sizeof slice, 33, 33, 8, {0, 0, 1}, spread, mask, 7, 0};
  echospline_trace_report report;
  memset(&report, 0, sizeof report);
  report.struct_size = sizeof report;
  REQUIRE(echospline_volume_trace(volume, &slice, &field, places, 3 * POINTS, pose_at(59).tip, 1e-3, lattice,
                                  &report) == ECHOSPLINE_OK);
  REQUIRE(report.folded == 0 && report.residual > 0);
  double moved[3 * POINTS];
  REQUIRE(echospline_force_field_at(&field, lattice, POINTS, moved) == ECHOSPLINE_OK);
  for (int i = 0; i < 3 * POINTS; ++i) REQUIRE(fabs(lattice[i] + moved[i] - places[i]) < 2e-3);
  int64_t outside = -1;
  REQUIRE(echospline_volume_slice(volume, &slice, places, 3 * POINTS, drawn[0], 33 * 33, &outside) == ECHOSPLINE_OK);
  REQUIRE(outside == 0);
  REQUIRE(echospline_volume_slice(volume, &slice, lattice, 3 * POINTS, drawn[1], 33 * 33, &outside) == ECHOSPLINE_OK);
  int changed = 0;
  for (int i = 0; i < 33 * 33; ++i) {
    REQUIRE(mask[i] || (drawn[0][i] == 7 && drawn[1][i] == 7));
    changed += drawn[0][i] != drawn[1][i];
    /* the volume is a ramp along x, and every pixel half a millimetre further */
    REQUIRE(!mask[i] || abs(drawn[0][i] - (int)(6 * (19.5 - 8 + 0.5 * (i % 33)) + 0.5)) <= 1);
  }
  REQUIRE(changed > 100);
  for (int i = 0; i < 3 * POINTS; ++i) places[i] += 1000;
  REQUIRE(echospline_volume_slice(volume, &slice, places, 3 * POINTS, drawn[0], 33 * 33, &outside) == ECHOSPLINE_OK);
  REQUIRE(outside == 20 * 33);
  echospline_volume_destroy(volume);
  free(voxels);

  /* A saved state goes on elsewhere, to the last bit; a damaged one is refused. */
  const int64_t size = echospline_spatial_state_size(spatial);
  unsigned char* bytes = malloc(2 * (size_t)size);
  if (!bytes) return 1;
  REQUIRE(echospline_spatial_state_save(spatial, bytes, size - 1) == ECHOSPLINE_WRONG_SIZE);
  REQUIRE(echospline_spatial_state_save(spatial, bytes, size) == ECHOSPLINE_OK);
  REQUIRE(echospline_spatial_state_load(other, bytes, size) == ECHOSPLINE_OK);
  for (int step = 60; step < 120; ++step) {
    const echospline_pose pose = pose_at(step);
    REQUIRE(echospline_spatial_advance(spatial, &pose) == ECHOSPLINE_OK);
    REQUIRE(echospline_spatial_advance(other, &pose) == ECHOSPLINE_OK);
  }
  REQUIRE(echospline_spatial_state_size(spatial) == echospline_spatial_state_size(other));
  const int64_t after = echospline_spatial_state_size(spatial);
  unsigned char* saved[2] = {malloc((size_t)after), malloc((size_t)after)};
  if (!saved[0] || !saved[1]) return 1;
  REQUIRE(echospline_spatial_state_save(spatial, saved[0], after) == ECHOSPLINE_OK);
  REQUIRE(echospline_spatial_state_save(other, saved[1], after) == ECHOSPLINE_OK);
  REQUIRE(memcmp(saved[0], saved[1], (size_t)after) == 0);
  bytes[size / 2] ^= 1;
  REQUIRE(echospline_spatial_state_load(other, bytes, size) == ECHOSPLINE_WRONG_STATE);
  REQUIRE(echospline_spatial_state_load(other, bytes, 3) == ECHOSPLINE_WRONG_STATE);
  free(bytes), free(saved[0]), free(saved[1]);

  /* Back to rest, nothing moves. */
  REQUIRE(echospline_spatial_reset(spatial) == ECHOSPLINE_OK);
  REQUIRE(echospline_spatial_field(spatial, &field) == ECHOSPLINE_OK && field.force_count == 0);
  REQUIRE(echospline_force_field_at(&field, at, 1, u) == ECHOSPLINE_OK && u[0] == 0 && u[1] == 0 && u[2] == 0);
  echospline_spatial_destroy(other);
  other = NULL;

  /* A host answers: stiff tissue, which hardly moves. */
  options.source_count = 0;
  REQUIRE(echospline_spatial_create(&options, &other) == ECHOSPLINE_OK);
  REQUIRE(echospline_spatial_wanted(other, &stations[0]) == ECHOSPLINE_WRONG_VALUE);
  const echospline_pose deep = pose_at(40);
  echospline_status status;
  int asked = 0;
  while ((status = echospline_spatial_advance(other, &deep)) == ECHOSPLINE_NEEDS_STATION) {
    REQUIRE(echospline_spatial_wanted(other, &stations[0]) == ECHOSPLINE_OK);
    static double rows[9 * 512];
    const int64_t numbers = 9 * (stations[0].index + 1);
    memset(rows, 0, sizeof rows);
    for (int d = 0; d < 3; ++d) rows[9 * stations[0].index + 4 * d] = 1e-6;
    REQUIRE(echospline_spatial_answer(other, rows, numbers - 1) == ECHOSPLINE_WRONG_SIZE);
    REQUIRE(echospline_spatial_answer(other, rows, numbers) == ECHOSPLINE_OK);
    REQUIRE(++asked < 40);
  }
  REQUIRE(status == ECHOSPLINE_OK && asked > 6);
  REQUIRE(echospline_spatial_needle(other, &load) == ECHOSPLINE_OK && fabs(load.tip - 0.4) < 1e-6);
  REQUIRE(echospline_spatial_field(other, &field) == ECHOSPLINE_WRONG_VALUE);
  echospline_spatial_destroy(other);
  other = NULL;

  /* What does not fit is refused in a sentence. */
  options = half_space();
  options.answer_count -= 1;
  REQUIRE(echospline_spatial_create(&options, &other) == ECHOSPLINE_WRONG_SIZE);
  REQUIRE(strstr(echospline_spatial_message(other), "answers must hold 12 x 9 numbers; got 107"));
  REQUIRE(echospline_spatial_advance(other, &deep) == ECHOSPLINE_FAILED_HANDLE);
  echospline_spatial_destroy(other);
  other = NULL;
  REQUIRE(echospline_spatial_create(NULL, &other) == ECHOSPLINE_NULL_POINTER);
  echospline_spatial_destroy(other);
  other = NULL;
  REQUIRE(echospline_spatial_advance(NULL, &deep) == ECHOSPLINE_NULL_POINTER);
  echospline_spatial_destroy(spatial);
  return 0;
}
