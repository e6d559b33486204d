// What a level offers for tissue under a needle's forces. Arguments have been checked: pointers, sizes and finite numbers.
#pragma once
#include "level.hpp"

namespace echospline {

/// Functions over one forced tissue, which is opaque outside its level.
struct ForceEntries {
  void* (*create)(const echospline_forced_options& options);  // nullptr when memory runs out
  void (*destroy)(void* forced);
  void (*reset)(void* forced);
  echospline_status (*advance)(void* forced, const echospline_pose& pose);
  int64_t (*wanted)(void* forced, echospline_station* out);  // index, or -1 where none is wanted; out may be nullptr
  int64_t (*stations)(void* forced, echospline_station* out, int64_t room);
  int64_t (*wanted_points)(void* forced);
  echospline_status (*answer)(void* forced, const float* columns, const double* rows);
  void (*load)(void* forced, echospline_needle_load& out);
  int64_t (*forces)(void* forced, double* out, int64_t room);
  echospline_status (*displacement)(void* forced, double* out);
  echospline_status (*displacement_single)(void* forced, float* out);
  int64_t (*state_size)(const void* forced);
  void (*state_save)(const void* forced, void* bytes);
  echospline_status (*state_load)(void* forced, const void* bytes, int64_t size, Message& message);
};

}  // namespace echospline
