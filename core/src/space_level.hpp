// Volumes and fields of forces at one processor level.
#pragma once
#include <new>

#include "../include/echospline/force_field.hpp"
#include "../include/echospline/tracing.hpp"
#include "../include/echospline/volume.hpp"
#include "space_entries.hpp"

namespace echospline::ECHOSPLINE_CORE {
namespace {

void destroy_volume(void* volume) {
  static_cast<Volume*>(volume)->~Volume();
  std::free(volume);
}

void* create_volume(const echospline_volume_options& options, const uint8_t* voxels) {
  void* memory = std::malloc(sizeof(Volume));
  if (!memory) return nullptr;
  Volume* volume = new (memory) Volume;
  if (volume->prepare(options, voxels)) return volume;
  destroy_volume(volume);
  return nullptr;
}

/// A field of the interface, as the core sums it.
struct GivenField {
  Array<PointForce> forces;
  SmoothLattice smooth;
  SpaceField sum;

  bool prepare(const echospline_force_field& field) {
    if (!forces.reserve(field.force_count)) return false;
    const double scale = 1.0 / (16.0 * 3.14159265358979323846 * field.shear_modulus * (1.0 - field.poisson));
    for (int64_t j = 0; j < field.force_count; ++j) {
      const double *place = field.places + 3 * j, *f = field.forces + 3 * j;
      const double radius = field.radii[j];
      forces[j] = {static_cast<float>(place[0]),       static_cast<float>(place[1]),
                   static_cast<float>(place[2]),       static_cast<float>(f[0] * scale),
                   static_cast<float>(f[1] * scale),   static_cast<float>(f[2] * scale),
                   static_cast<float>(radius * radius)};
    }
    const Top top = field.top == ECHOSPLINE_TOP_FREE      ? Top::free
                    : field.top == ECHOSPLINE_TOP_SLIDING ? Top::sliding
                                                          : Top::none;
    smooth = {field.lattice, {}, {}, {}};
    for (int k = 0; field.lattice && k < 3; ++k) {
      smooth.shape[k] = field.lattice_shape[k];
      smooth.per_mm[k] = 1.0 / field.lattice_spacing[k], smooth.origin[k] = field.lattice_origin[k];
    }
    sum = {forces.data(), field.force_count, static_cast<float>(field.poisson), top, field.lattice ? &smooth : nullptr};
    return true;
  }
};

bool sum_forces(const echospline_force_field& field, const double* points, int64_t count, double* displacement) {
  GivenField given;
  if (!given.prepare(field)) return false;
  given.sum(points, count, displacement);
  return true;
}

echospline_status trace(const void* self, const echospline_slice& slice, const echospline_force_field* field,
                        const TissueView* tissue, const double* places, const double* tip, double close,
                        double* lattice, echospline_trace_report& report) {
  const auto& volume = *static_cast<const Volume*>(self);
  const int64_t columns = (slice.columns - 1 + slice.step - 1) / slice.step + 1;
  const int64_t rows = (slice.rows - 1 + slice.step - 1) / slice.step + 1;
  Tracer tracer;
  GivenField given;
  if (!tracer.reserve(columns * rows) || (field && !given.prepare(*field))) return ECHOSPLINE_OUT_OF_MEMORY;
  const auto inside = [&](const double* X) { return volume.contains(X); };
  Traced found;
  echospline_status status = ECHOSPLINE_OK;
  if (field) {
    found = tracer.trace(given.sum, inside, places, columns, rows, close, tip, lattice);
  } else {
    const auto moved = [&](const double* points, int64_t count, double* u) {
      if (status == ECHOSPLINE_OK) status = tissue->functions->displacement_at(tissue->self, points, count, u);
      if (status != ECHOSPLINE_OK) std::memset(u, 0, static_cast<size_t>(3 * count) * sizeof(double));
    };
    found = tracer.trace(moved, inside, places, columns, rows, close, tip, lattice);
  }
  report.residual = found.residual, report.folded = found.folded, report.jacobian = found.jacobian;
  for (int k = 0; k < 3; ++k) report.place[k] = found.place[k];
  return status;
}

const SpaceEntries space_entries = {
    create_volume,
    destroy_volume,
    [](const void* volume, const echospline_slice& slice, const double* lattice, uint8_t* out) {
      return static_cast<const Volume*>(volume)->slice(slice, lattice, out);
    },
    sum_forces,
    trace,
};

}  // namespace
}  // namespace echospline::ECHOSPLINE_CORE
