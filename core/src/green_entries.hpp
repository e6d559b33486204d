// What a level offers for Green's function of tissue. Arguments have been checked: pointers, sizes, finite numbers, indices.
#pragma once
#include "../include/echospline/green.h"
#include "level.hpp"

namespace echospline {

struct GreenEntries {
  /// `green` is nullptr unless the status is OK.
  echospline_status (*create)(const echospline_green_options& options, void** green);
  void (*destroy)(void* green);
  bool (*answer)(const void* green, const double* places, int64_t place_count, const double* forces, int64_t cases,
                 const double* points, int64_t point_count, double* mesh, double* at);  // false when memory runs out
  bool (*attach)(void* forced, const void* green);  // the same; green may be nullptr
  echospline_status (*displacement_at)(void* forced, const double* points, int64_t count, double* displacement);
};

}  // namespace echospline
