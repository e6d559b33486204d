// Tissue in the plane under a needle's forces at one processor level.
#pragma once
#include "../include/echospline/green.hpp"
#include "force_entries.hpp"
#include "slip_bytes.hpp"

namespace echospline::ECHOSPLINE_CORE {
namespace {

inline GreenTissue& forced(void* f) { return *static_cast<GreenTissue*>(f); }
inline const GreenTissue& forced(const void* f) { return *static_cast<const GreenTissue*>(f); }

inline echospline_status status_of(SlipTissue::Outcome outcome) { return slip_status<2>(outcome); }

inline void describe(const SlipStation& s, int64_t index, echospline_station& out) {
  std::memset(&out, 0, sizeof out);
  out.index = index, out.point_count = s.count;
  for (int d = 0; d < 2; ++d) out.place[d] = s.place[d], out.axis[d] = s.axis[d];
  for (int i = 0; i < s.count; ++i) {
    out.weights[i] = s.weights[i];
    for (int d = 0; d < 2; ++d) out.points[2 * i + d] = s.points[i][d];
  }
}

inline void* create_forced(const echospline_forced_options& o) {
  const SlipLaw law = {o.tip,
                       o.friction_limit,
                       o.bond,
                       o.tip_stiffness,
                       o.side_stiffness,
                       o.viscosity,
                       o.station_spacing,
                       o.substep,
                       o.dead_band,
                       {o.low[0], o.low[1]},
                       {o.high[0], o.high[1]}};
  GreenTissue* made = create<GreenTissue>(law, o.node_count);
  if (made && !made->build()) {
    destroy(made);
    return nullptr;
  }
  return made;
}

constexpr ForceEntries force_entries = {
    create_forced,
    [](void* f) { destroy(&forced(f)); },
    [](void* f) { forced(f).rest(); },
    [](void* f, const echospline_pose& pose) {
      GreenTissue& own = forced(f);
      return status_of(own.answered_by_green([&] { return own.advance(pose); }));
    },
    [](void* f, echospline_station* out) {
      SlipTissue& own = forced(f);
      if (out && own.wanted_index >= 0) describe(own.wanted, own.wanted_index, *out);
      return own.wanted_index;
    },
    [](void* f, echospline_station* out, int64_t room) {
      SlipTissue& own = forced(f);
      for (int64_t j = 0; j < smaller(own.answers(), room); ++j) describe(own.station(j), j, out[j]);
      return own.answers();
    },
    [](void* f) { return static_cast<int64_t>(forced(f).wanted.count); },
    [](void* f, const float* columns, const double* rows) { return status_of(forced(f).answer(columns, rows)); },
    [](void* f, echospline_needle_load& out) { forced(f).load(out); },
    [](void* f, double* out, int64_t room) {
      SlipTissue& own = forced(f);
      if (room >= own.state.count) own.forces(out);
      return own.state.count;
    },
    [](void* f, double* out) {
      GreenTissue& own = forced(f);
      return status_of(own.answered_by_green([&] { return own.displacement(out); }));
    },
    [](void* f, float* out) {
      GreenTissue& own = forced(f);
      return status_of(own.answered_by_green([&] { return own.displacement(out); }));
    },
    [](const void* f) { return slip_size<2>(forced(f)); },
    [](const void* f, void* bytes) { save_slip<2>(forced(f), bytes); },
    [](void* f, const void* bytes, int64_t size, Message& message) {
      return load_slip<2>(forced(f), bytes, size, "echospline_forced_state_save", message);
    },
};

}  // namespace
}  // namespace echospline::ECHOSPLINE_CORE
