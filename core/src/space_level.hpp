// Volumes and fields of forces at one processor level.
#pragma once
#include <new>

#include "../include/echospline/force_field.hpp"
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

bool sum_forces(const echospline_force_field& field, const double* points, int64_t count, double* displacement) {
  Array<PointForce> forces;
  if (!forces.reserve(field.force_count)) return false;
  const double scale = 1.0 / (16.0 * 3.14159265358979323846 * field.shear_modulus * (1.0 - field.poisson));
  for (int64_t j = 0; j < field.force_count; ++j) {
    const double *place = field.places + 3 * j, *f = field.forces + 3 * j;
    const double radius = field.radii[j];
    forces[j] = {static_cast<float>(place[0]),       static_cast<float>(place[1]),     static_cast<float>(place[2]),
                 static_cast<float>(f[0] * scale),   static_cast<float>(f[1] * scale), static_cast<float>(f[2] * scale),
                 static_cast<float>(radius * radius)};
  }
  const float nu = static_cast<float>(field.poisson);
  if (field.top == ECHOSPLINE_TOP_FREE)
    force_field<Top::free>(forces.data(), field.force_count, nu, points, count, displacement);
  else if (field.top == ECHOSPLINE_TOP_SLIDING)
    force_field<Top::sliding>(forces.data(), field.force_count, nu, points, count, displacement);
  else
    force_field<Top::none>(forces.data(), field.force_count, nu, points, count, displacement);
  if (field.lattice) {
    SmoothLattice smooth = {field.lattice, {}, {}, {}};
    for (int k = 0; k < 3; ++k) {
      smooth.shape[k] = field.lattice_shape[k];
      smooth.per_mm[k] = 1.0 / field.lattice_spacing[k], smooth.origin[k] = field.lattice_origin[k];
    }
    for (int64_t i = 0; i < count; ++i) smooth.add(points + 3 * i, displacement + 3 * i);
  }
  return true;
}

const SpaceEntries space_entries = {
    create_volume,
    destroy_volume,
    [](const void* volume, const echospline_slice& slice, const double* lattice, uint8_t* out) {
      return static_cast<const Volume*>(volume)->slice(slice, lattice, out);
    },
    sum_forces,
};

}  // namespace
}  // namespace echospline::ECHOSPLINE_CORE
