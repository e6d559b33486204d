// What a level offers for scenes in space. Arguments have been checked: pointers, sizes and finite numbers.
#pragma once
#include "../include/echospline/space.h"
#include "level.hpp"
#include "tissue_entries.hpp"

namespace echospline {

struct SpaceEntries {
  void* (*create_volume)(const echospline_volume_options& options,
                         const uint8_t* voxels);  // nullptr when memory runs out
  void (*destroy_volume)(void* volume);
  int64_t (*slice)(const void* volume, const echospline_slice& slice, const double* lattice, uint8_t* out);
  bool (*force_field)(const echospline_force_field& field, const double* points, int64_t count,
                      double* displacement);  // false when memory runs out
  /// Trace a slice's lattice back through a field, or a tissue where field is nullptr.
  echospline_status (*trace)(const void* volume, const echospline_slice& slice, const echospline_force_field* field,
                             const TissueView* tissue, const double* places, const double* tip, double close,
                             double* lattice, echospline_trace_report& report);
};

}  // namespace echospline
