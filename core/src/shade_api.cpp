// C interface of a display's picture: arguments are checked here.
#include <cmath>
#include <cstdint>
#include <cstring>

#include "../include/echospline/echospline.h"
#include "picture_entries.hpp"

namespace {

constexpr int32_t MOST_PIXELS_ALONG = 16384;  // as in picture_api.cpp
constexpr int32_t MOST_SLIDERS = sizeof echospline_look{}.depth_gains / sizeof(double);

bool within(double value, double low, double high) {
  return value >= low && value <= high;
}  // no where it is no number

}  // namespace

extern "C" {

void echospline_look_defaults(echospline_look* look) {
  if (!look || look->struct_size != sizeof *look) return;
  std::memset(look, 0, sizeof *look);
  look->struct_size = sizeof *look;
  look->recorded_range = look->dynamic_range = 60;
}

echospline_status echospline_shade(const echospline_look* look, const uint8_t* grey, int32_t columns, int32_t rows,
                                   uint8_t* rgba, int64_t bytes) {
  if (!look || !grey || !rgba) return ECHOSPLINE_NULL_POINTER;
  if (look->struct_size != sizeof *look || columns < 1 || rows < 1 || columns > MOST_PIXELS_ALONG ||
      rows > MOST_PIXELS_ALONG || bytes != 4 * int64_t(columns) * rows || look->depth_gain_count < 0 ||
      look->depth_gain_count > MOST_SLIDERS)
    return ECHOSPLINE_WRONG_SIZE;
  const echospline::Level* level = echospline::find_level(look->level);
  if (!level || (look->invert & ~1) || (look->flip & ~1) || !within(look->gain, -100, 100) ||
      !within(look->recorded_range, 1, 300) || !within(look->dynamic_range, 1, 300))
    return ECHOSPLINE_WRONG_VALUE;
  for (int32_t k = 0; k < look->depth_gain_count; ++k)
    if (!within(look->depth_gains[k], -100, 100)) return ECHOSPLINE_WRONG_VALUE;
  level->picture->shade(*look, grey, columns, rows, rgba);
  return ECHOSPLINE_OK;
}

}  // extern "C"
