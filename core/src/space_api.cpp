// C interface of scenes in space: volumes, slices through them, and fields of point forces. Arguments are checked here.
#include <cmath>
#include <cstdarg>
#include <cstdint>
#include <cstdio>
#include <cstdlib>

#include "../include/echospline/space.h"
#include "space_entries.hpp"

struct echospline_volume {
  const echospline::Level* level;
  void* volume;  // nullptr after a create that failed
  echospline::Message message;
};

namespace {

using echospline::Message;

constexpr int32_t MOST_ALONG = 4096;                     // voxels or pixels
constexpr int64_t MOST_VOXELS = (int64_t(1) << 31) - 1;  // indices fit 32 bits
constexpr int64_t MOST_FORCES = int64_t(1) << 24;        // a gigabyte is a mistake
constexpr double FURTHEST = 1e6, LARGEST_FORCE = 1e12;   // mm, N

__attribute__((format(printf, 3, 4))) echospline_status refuse(Message& message, echospline_status status,
                                                               const char* format, ...) {
  va_list arguments;
  va_start(arguments, format);
  std::vsnprintf(message.text, sizeof message.text, format, arguments);
  va_end(arguments);
  return status;
}

bool near_enough(double x) { return x >= -FURTHEST && x <= FURTHEST; }  // no where x is not a number

echospline_status check_options(const echospline_volume_options& o, Message& message) {
  int64_t voxels = 1;
  for (int k = 0; k < 3; ++k) {
    if (o.shape[k] < 1 || o.shape[k] > MOST_ALONG)
      return refuse(message, ECHOSPLINE_WRONG_SIZE, "shape of a volume must be 1 to %d voxels each; got %d x %d x %d",
                    MOST_ALONG, o.shape[0], o.shape[1], o.shape[2]);
    voxels *= o.shape[k];
    if (!(o.spacing[k] >= 1e-4 && o.spacing[k] <= FURTHEST))
      return refuse(message, ECHOSPLINE_WRONG_VALUE, "spacing must be three positive numbers in mm; got (%g, %g, %g)",
                    o.spacing[0], o.spacing[1], o.spacing[2]);
    if (!near_enough(o.origin[k]))
      return refuse(message, ECHOSPLINE_WRONG_VALUE, "origin must be three numbers in mm; got (%g, %g, %g)",
                    o.origin[0], o.origin[1], o.origin[2]);
  }
  if (voxels > MOST_VOXELS)
    return refuse(message, ECHOSPLINE_WRONG_SIZE, "a volume must have at most %lld voxels; got %lld",
                  static_cast<long long>(MOST_VOXELS), static_cast<long long>(voxels));
  return ECHOSPLINE_OK;
}

echospline_status check_slice(const echospline_slice& s, const double* lattice, int64_t count, int64_t bytes,
                              Message& message) {
  if (s.struct_size != sizeof s)
    return refuse(message, ECHOSPLINE_WRONG_SIZE, "struct_size of the slice must be %zu; got %u", sizeof s,
                  s.struct_size);
  if (s.columns < 1 || s.rows < 1 || s.columns > MOST_ALONG || s.rows > MOST_ALONG || s.step < 1 || s.step > MOST_ALONG)
    return refuse(message, ECHOSPLINE_WRONG_SIZE, "columns, rows and step must be from 1 to %d; got %d, %d and %d",
                  MOST_ALONG, s.columns, s.rows, s.step);
  const int64_t expected =
      int64_t((s.columns - 1 + s.step - 1) / s.step + 1) * ((s.rows - 1 + s.step - 1) / s.step + 1) * 3;
  if (count != expected)
    return refuse(message, ECHOSPLINE_WRONG_SIZE, "the lattice must hold %lld numbers; got %lld",
                  static_cast<long long>(expected), static_cast<long long>(count));
  if (bytes != int64_t(s.columns) * s.rows)
    return refuse(message, ECHOSPLINE_WRONG_SIZE, "the picture takes %lld bytes; got %lld",
                  static_cast<long long>(int64_t(s.columns) * s.rows), static_cast<long long>(bytes));
  if (s.background < 0 || s.background > 255)
    return refuse(message, ECHOSPLINE_WRONG_VALUE, "background must be a grey level from 0 to 255; got %d",
                  s.background);
  for (int k = 0; k < 3; ++k)
    if (!(std::fabs(s.normal[k]) <= 1.001))
      return refuse(message, ECHOSPLINE_WRONG_VALUE, "normal must be a unit vector; got (%g, %g, %g)", s.normal[0],
                    s.normal[1], s.normal[2]);
  for (int64_t k = 0; k < count; ++k)
    if (!near_enough(lattice[k]))
      return refuse(message, ECHOSPLINE_WRONG_VALUE, "the lattice must hold numbers in mm; number %lld is %g",
                    static_cast<long long>(k), lattice[k]);
  for (int row = 0; s.spread && row < s.rows; ++row)
    if (!(s.spread[row] >= 0.0f && s.spread[row] <= 1e3f))
      return refuse(message, ECHOSPLINE_WRONG_VALUE, "spread must be zero or a length in mm; row %d has %g", row,
                    static_cast<double>(s.spread[row]));
  return ECHOSPLINE_OK;
}

/// What a field of forces must be, without its level.
echospline_status check_field(const echospline_force_field& f) {
  if (f.struct_size != sizeof f || f.force_count < 0 || f.force_count > MOST_FORCES) return ECHOSPLINE_WRONG_SIZE;
  if (f.force_count && (!f.places || !f.forces || !f.radii)) return ECHOSPLINE_NULL_POINTER;
  if (f.top < ECHOSPLINE_TOP_NONE || f.top > ECHOSPLINE_TOP_SLIDING) return ECHOSPLINE_WRONG_VALUE;
  if (!(f.poisson > -1.0 && f.poisson < 0.5) || !(f.shear_modulus > 0 && f.shear_modulus <= LARGEST_FORCE))
    return ECHOSPLINE_WRONG_VALUE;
  for (int64_t k = 0; k < 3 * f.force_count; ++k)
    if (!near_enough(f.places[k]) || !(std::fabs(f.forces[k]) <= LARGEST_FORCE)) return ECHOSPLINE_WRONG_VALUE;
  for (int64_t j = 0; j < f.force_count; ++j) {
    const double radius = f.radii[j], depth = f.places[3 * j + 1];
    if (!(radius > 0 && radius <= FURTHEST)) return ECHOSPLINE_WRONG_VALUE;
    if (f.top != ECHOSPLINE_TOP_NONE && !(depth > 0)) return ECHOSPLINE_WRONG_VALUE;
  }
  if (!f.lattice) return ECHOSPLINE_OK;
  int64_t numbers = 3;
  for (int k = 0; k < 3; ++k) {
    if (f.lattice_shape[k] < 4 || f.lattice_shape[k] > MOST_ALONG) return ECHOSPLINE_WRONG_SIZE;
    if (!(f.lattice_spacing[k] >= 1e-4 && f.lattice_spacing[k] <= FURTHEST) || !near_enough(f.lattice_origin[k]))
      return ECHOSPLINE_WRONG_VALUE;
    numbers *= f.lattice_shape[k];
  }
  if (numbers > MOST_VOXELS) return ECHOSPLINE_WRONG_SIZE;
  for (int64_t k = 0; k < numbers; ++k)
    if (!near_enough(f.lattice[k])) return ECHOSPLINE_WRONG_VALUE;
  return ECHOSPLINE_OK;
}

echospline_status check_trace(echospline_volume* volume, const echospline_slice& slice, const double* places,
                              int64_t count, const double* tip, double close, const echospline_trace_report& report) {
  if (!volume->volume) return ECHOSPLINE_FAILED_HANDLE;
  if (report.struct_size != sizeof report)
    return refuse(volume->message, ECHOSPLINE_WRONG_SIZE, "struct_size of the report must be %zu; got %u",
                  sizeof report, report.struct_size);
  if (const echospline_status status =
          check_slice(slice, places, count, int64_t(slice.columns) * slice.rows, volume->message))
    return status;
  for (int k = 0; tip && k < 3; ++k)
    if (!near_enough(tip[k]))
      return refuse(volume->message, ECHOSPLINE_WRONG_VALUE, "tip must be three numbers in mm; got (%g, %g, %g)",
                    tip[0], tip[1], tip[2]);
  if (!(close >= 1e-7 && close <= FURTHEST))
    return refuse(volume->message, ECHOSPLINE_WRONG_VALUE, "close must be a length in mm, 1e-7 or more; got %g", close);
  return ECHOSPLINE_OK;
}

echospline_status traced(echospline_volume* volume, echospline_status status) {
  if (status == ECHOSPLINE_OUT_OF_MEMORY)
    return refuse(volume->message, status, "memory for tracing the lattice ran out");
  return status == ECHOSPLINE_OK ? status
                                 : refuse(volume->message, status, "the tissue's displacement could not be computed");
}

}  // namespace

extern "C" {

echospline_status echospline_volume_create(const echospline_volume_options* options, const uint8_t* voxels,
                                           echospline_volume** volume) {
  if (!volume) return ECHOSPLINE_NULL_POINTER;
  *volume = nullptr;
  if (!options || !voxels) return ECHOSPLINE_NULL_POINTER;
  if (options->struct_size != sizeof *options) return ECHOSPLINE_WRONG_SIZE;
  auto* handle = static_cast<echospline_volume*>(std::calloc(1, sizeof(echospline_volume)));
  if (!handle) return ECHOSPLINE_OUT_OF_MEMORY;
  *volume = handle;
  handle->level = echospline::find_level(options->level);
  if (!handle->level)
    return refuse(handle->message, ECHOSPLINE_WRONG_VALUE, "the processor level %d is not available here",
                  options->level);
  if (const echospline_status status = check_options(*options, handle->message)) return status;
  handle->volume = handle->level->space->create_volume(*options, voxels);
  if (!handle->volume)
    return refuse(handle->message, ECHOSPLINE_OUT_OF_MEMORY, "a volume of %d x %d x %d voxels does not fit into memory",
                  options->shape[0], options->shape[1], options->shape[2]);
  return ECHOSPLINE_OK;
}

void echospline_volume_destroy(echospline_volume* volume) {
  if (!volume) return;
  if (volume->volume) volume->level->space->destroy_volume(volume->volume);
  std::free(volume);
}

const char* echospline_volume_message(const echospline_volume* volume) {
  return volume ? volume->message.text : "the volume must not be NULL";
}

echospline_status echospline_volume_slice(echospline_volume* volume, const echospline_slice* slice,
                                          const double* lattice, int64_t count, uint8_t* out, int64_t bytes,
                                          int64_t* outside) {
  if (!volume || !slice || !lattice || !out) return ECHOSPLINE_NULL_POINTER;
  if (!volume->volume) return ECHOSPLINE_FAILED_HANDLE;
  if (const echospline_status status = check_slice(*slice, lattice, count, bytes, volume->message)) return status;
  const int64_t pixels = volume->level->space->slice(volume->volume, *slice, lattice, out);
  if (pixels < 0)
    return refuse(volume->message, ECHOSPLINE_OUT_OF_MEMORY, "a slice of %d columns does not fit into memory",
                  slice->columns);
  if (outside) *outside = pixels;
  return ECHOSPLINE_OK;
}

echospline_status echospline_force_field_at(const echospline_force_field* field, const double* points, int64_t count,
                                            double* displacement) {
  if (!field || !points || !displacement) return ECHOSPLINE_NULL_POINTER;
  if (count < 0) return ECHOSPLINE_WRONG_SIZE;
  if (const echospline_status status = check_field(*field)) return status;
  const echospline::Level* level = echospline::find_level(field->level);
  if (!level) return ECHOSPLINE_WRONG_VALUE;
  for (int64_t k = 0; k < 3 * count; ++k)
    if (!near_enough(points[k])) return ECHOSPLINE_WRONG_VALUE;
  return level->space->force_field(*field, points, count, displacement) ? ECHOSPLINE_OK : ECHOSPLINE_OUT_OF_MEMORY;
}

echospline_status echospline_volume_trace(echospline_volume* volume, const echospline_slice* slice,
                                          const echospline_force_field* field, const double* places, int64_t count,
                                          const double* tip, double close, double* lattice,
                                          echospline_trace_report* report) {
  if (!volume || !slice || !field || !places || !lattice || !report) return ECHOSPLINE_NULL_POINTER;
  if (const echospline_status status = check_trace(volume, *slice, places, count, tip, close, *report)) return status;
  if (const echospline_status status = check_field(*field))
    return refuse(volume->message, status,
                  "the field must hold finite numbers below 1e6 mm, positive radii and forces below the surface");
  return traced(volume, volume->level->space->trace(volume->volume, *slice, field, nullptr, places, tip, close, lattice,
                                                    *report));
}

echospline_status echospline_volume_trace_tissue(echospline_volume* volume, const echospline_slice* slice,
                                                 echospline_tissue* tissue, const double* places, int64_t count,
                                                 const double* tip, double close, double* lattice,
                                                 echospline_trace_report* report) {
  if (!volume || !slice || !places || !lattice || !report) return ECHOSPLINE_NULL_POINTER;
  if (const echospline_status status = check_trace(volume, *slice, places, count, tip, close, *report)) return status;
  echospline::TissueView view;
  if (const echospline_status status = echospline::view_of(tissue, view, volume->message)) return status;
  if (view.counts->dimension != 3)
    return refuse(volume->message, ECHOSPLINE_WRONG_VALUE, "the tissue must be one in space; got dimension %d",
                  view.counts->dimension);
  return traced(volume, volume->level->space->trace(volume->volume, *slice, nullptr, &view, places, tip, close, lattice,
                                                    *report));
}

}  // extern "C"
