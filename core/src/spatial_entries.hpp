// What a level offers for tissue in space under a needle's forces. Arguments have been checked: pointers, sizes and finite numbers.
#pragma once
#include "../include/echospline/space.h"
#include "level.hpp"

namespace echospline {

/// Functions over one spatial tissue, which is opaque outside its level.
struct SpatialEntries {
  void* (*create)(const echospline_spatial_options& options);  // nullptr when memory runs out
  void (*destroy)(void* spatial);
  void (*reset)(void* spatial);
  echospline_status (*advance)(void* spatial, const echospline_pose& pose);
  int64_t (*wanted)(void* spatial, echospline_spatial_station* out);  // index, or -1 where none is; out may be nullptr
  echospline_status (*answer)(void* spatial, const double* rows);
  void (*load)(void* spatial, echospline_spatial_load& out);
  int64_t (*forces)(void* spatial, double* out, int64_t room);
  int64_t (*stations)(void* spatial, echospline_spatial_station* out, int64_t room);
  echospline_status (*field)(void* spatial, echospline_force_field& out);
  int64_t (*state_size)(const void* spatial);
  void (*state_save)(const void* spatial, void* bytes);
  echospline_status (*state_load)(void* spatial, const void* bytes, int64_t size, Message& message);
};

}  // namespace echospline
