/* A needle in rigid tissue, over the C interface alone: cutting force and friction in closed form, states as bytes, a cut track. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "echospline/echospline.h"

#define REQUIRE(right)                                                                         \
  if (!(right)) {                                                                              \
    printf("line %d: expected %s; %s\n", __LINE__, #right, echospline_forced_message(forced)); \
    return 1;                                                                                  \
  }

static echospline_forced* forced;
static float columns[4 * 6];
static double rows[4 * 64];
static int asked;

static echospline_status to(double depth) {
  echospline_pose pose;
  memset(&pose, 0, sizeof pose);
  pose.entry[0] = pose.tip[0] = 20, pose.tip[1] = depth, pose.dt = 0.01;
  echospline_status status;
  while ((status = echospline_forced_advance(forced, &pose)) == ECHOSPLINE_NEEDS_STATION) {
    echospline_station station;
    ++asked;
    if (echospline_forced_wanted(forced, &station) || station.index >= 64) return ECHOSPLINE_WRONG_VALUE;
    status = echospline_forced_answer(forced, columns, 4 * 6, rows, 4 * (station.index + 1));
    if (status != ECHOSPLINE_OK) return status;
  }
  return status;
}

int main(void) {
  echospline_forced_options options = {.struct_size = sizeof options};
  echospline_forced_defaults(&options);
  options.node_count = 6, options.high[0] = 40, options.high[1] = 30;
  REQUIRE(echospline_forced_create(&options, &forced) == ECHOSPLINE_OK);
  echospline_needle_load load;
  for (int k = 1; k <= 200; ++k) REQUIRE(to(0.1 * k) == ECHOSPLINE_OK);
  REQUIRE(echospline_forced_load(forced, &load) == ECHOSPLINE_OK);
  REQUIRE(fabs(load.tip - options.tip) < 1e-9);
  REQUIRE(fabs(load.cut - (20 - options.tip / options.tip_stiffness)) < 1e-5);
  REQUIRE(fabs(load.friction - options.friction_limit * load.cut) < 2e-3);
  REQUIRE(asked == 17); /* stations to 20 mm, 1.25 mm apart */

  const int64_t size = echospline_forced_state_size(forced);
  unsigned char* bytes = malloc((size_t)size);
  REQUIRE(bytes && echospline_forced_state_save(forced, bytes, size) == ECHOSPLINE_OK);
  for (int k = 200; k >= 0; --k) REQUIRE(to(0.1 * k) == ECHOSPLINE_OK);
  REQUIRE(to(10) == ECHOSPLINE_OK && echospline_forced_load(forced, &load) == ECHOSPLINE_OK);
  REQUIRE(load.tip == 0 && load.friction > 0.09); /* in its own track */
  const int before = asked;
  bytes[size / 2] ^= 1;
  REQUIRE(echospline_forced_state_load(forced, bytes, size) == ECHOSPLINE_WRONG_STATE);
  bytes[size / 2] ^= 1;
  REQUIRE(echospline_forced_state_load(forced, bytes, size) == ECHOSPLINE_OK);
  REQUIRE(echospline_forced_load(forced, &load) == ECHOSPLINE_OK && fabs(load.tip - options.tip) < 1e-9);
  double field[12];
  REQUIRE(echospline_forced_displacement(forced, field, 11) == ECHOSPLINE_WRONG_SIZE);
  REQUIRE(echospline_forced_displacement(forced, field, 12) == ECHOSPLINE_OK && field[0] == 0);
  REQUIRE(asked == before); /* the answers are still there */
  free(bytes);
  echospline_forced_destroy(forced);
  return 0;
}
