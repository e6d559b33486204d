// Green's function of tissue at one processor level.
#pragma once
#include "../include/echospline/green.hpp"
#include "force_level.hpp"
#include "green_entries.hpp"

namespace echospline::ECHOSPLINE_CORE {
namespace {

inline echospline_status create_green(const echospline_green_options& options, void** green) {
  *green = nullptr;
  Green* made = create<Green>();
  if (!made) return ECHOSPLINE_OUT_OF_MEMORY;
  const Green::Outcome outcome = made->build(options);
  if (outcome == Green::done) {
    *green = made;
    return ECHOSPLINE_OK;
  }
  destroy(made);
  return outcome == Green::not_held ? ECHOSPLINE_NOT_HELD : ECHOSPLINE_OUT_OF_MEMORY;
}

inline bool attach_green(void* f, const void* green) {
  GreenTissue& own = forced(f);
  if (!own.stations.attach(static_cast<const Green*>(green))) return false;
  own.forget_answers();
  return true;
}

inline echospline_status green_displacement_at(void* f, const double* points, int64_t count, double* displacement) {
  GreenTissue& own = forced(f);
  const SlipTissue::Outcome outcome = own.answered_by_green([&] { return own.answered_all(); });
  if (outcome != SlipTissue::done) return status_of(outcome);
  return own.stations.displacement_at(own, points, count, displacement) ? ECHOSPLINE_OK : ECHOSPLINE_OUT_OF_MEMORY;
}

const GreenEntries green_entries = {
    create_green,
    [](void* g) { destroy(static_cast<Green*>(g)); },
    [](const void* g, const double* places, int64_t place_count, const double* forces, int64_t cases,
       const double* points, int64_t point_count, double* mesh, double* at) {
      return static_cast<const Green*>(g)->answer(places, place_count, forces, cases, points, point_count, mesh, at);
    },
    attach_green,
    green_displacement_at,
};

}  // namespace
}  // namespace echospline::ECHOSPLINE_CORE
