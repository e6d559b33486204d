// Tissue in space under a needle's forces at one processor level.
#pragma once
#include "../include/echospline/space_green.hpp"
#include "slip_bytes.hpp"
#include "spatial_entries.hpp"

namespace echospline::ECHOSPLINE_CORE {
namespace {

using SpatialSlip = SlipTissueIn<3>;

/// The law, and what answers it if the host does not.
struct SpatialTissue : SpatialSlip {
  SpaceGreen green;
  bool own_answers = false;

  using SpatialSlip::SpatialSlip;

  /// Repeat a call as long as it asks for a station that is answered here.
  template <class Call>
  Outcome answered_here(Call&& call) {
    Outcome outcome = call();
    while (outcome == needs_station && own_answers) {
      outcome = green.answer(*this);
      if (outcome != done) {
        forget_answers();
        return outcome;
      }
      outcome = call();
    }
    return outcome;
  }
};

inline SpatialTissue& spatial(void* s) { return *static_cast<SpatialTissue*>(s); }
inline const SpatialTissue& spatial(const void* s) { return *static_cast<const SpatialTissue*>(s); }

inline void* create_spatial(const echospline_spatial_options& o) {
  SlipLawIn<3> law = {o.tip,       o.friction_limit,  o.bond,    o.tip_stiffness, o.side_stiffness,
                      o.viscosity, o.station_spacing, o.substep, o.dead_band,     {},
                      {}};
  for (int d = 0; d < 3; ++d) law.low[d] = o.low[d], law.high[d] = o.high[d];
  SpatialTissue* made = create<SpatialTissue>(law, 0);
  if (!made) return nullptr;
  made->own_answers = o.source_count > 0;
  if (made->build() && (!made->own_answers || made->green.prepare(o))) return made;
  destroy(made);
  return nullptr;
}

inline void describe(const SlipStationIn<3>& s, int64_t index, echospline_spatial_station& out) {
  std::memset(&out, 0, sizeof out);
  out.index = index, out.point_count = s.count;
  for (int d = 0; d < 3; ++d) out.place[d] = s.place[d], out.axis[d] = s.axis[d];
  for (int i = 0; i < s.count; ++i) {
    out.weights[i] = s.weights[i];
    for (int d = 0; d < 3; ++d) out.points[3 * i + d] = s.points[i][d];
  }
}

/// Sums of the forces, as `stick_slip.load` and `wrench` take them.
inline void load_of(const SpatialSlip& own, echospline_spatial_load& out) {
  const SlipStateIn<3>& s = own.state;
  Vec<3> total = {}, torque = {};
  double side[2] = {};
  std::memset(&out, 0, sizeof out);
  out.tip = s.push, out.cut = s.cut;
  for (int64_t j = 0; j < s.count; ++j) {
    const SlipContactIn<3>& contact = s.contacts[j];
    const Vec<3> f = own.force_of(s, j);
    out.friction += contact.friction;
    for (int d = 0; d < 2; ++d) side[d] += contact.side[d];
    total = total + f, torque = torque + cross(contact.place + contact.moved - s.entry, f);
  }
  out.side = std::hypot(side[0], side[1]);
  for (int d = 0; d < 3; ++d) out.force[d] = total[d], out.torque[d] = torque[d];
}

inline echospline_status field_of(void* self, echospline_force_field& out) {
  SpatialTissue& own = spatial(self);
  const SpatialSlip::Outcome outcome = own.answered_here([&] { return own.answered_all(); });
  if (outcome != SpatialSlip::done) return slip_status<3>(outcome);
  return own.green.field(own, out) ? ECHOSPLINE_OK : ECHOSPLINE_OUT_OF_MEMORY;
}

constexpr SpatialEntries spatial_entries = {
    create_spatial,
    [](void* s) { destroy(&spatial(s)); },
    [](void* s) { spatial(s).rest(); },
    [](void* s, const echospline_pose& pose) {
      SpatialTissue& own = spatial(s);
      return slip_status<3>(own.answered_here([&] { return own.advance(pose); }));
    },
    [](void* s, echospline_spatial_station* out) {
      SpatialTissue& own = spatial(s);
      if (out && own.wanted_index >= 0) describe(own.wanted, own.wanted_index, *out);
      return own.wanted_index;
    },
    [](void* s, const double* rows) { return slip_status<3>(spatial(s).answer(nullptr, rows)); },
    [](void* s, echospline_spatial_load& out) { load_of(spatial(s), out); },
    [](void* s, double* out, int64_t room) {
      SpatialTissue& own = spatial(s);
      if (room >= own.state.count) own.forces(out);
      return own.state.count;
    },
    [](void* s, echospline_spatial_station* out, int64_t room) {
      const SpatialTissue& own = spatial(s);
      for (int64_t j = 0; j < smaller(own.state.count, room); ++j) {
        const SlipContactIn<3>& contact = own.state.contacts[j];
        describe(station_at(own.law, contact.place, contact.axis), j, out[j]);
      }
      return own.state.count;
    },
    field_of,
    [](const void* s) { return slip_size<3>(spatial(s)); },
    [](const void* s, void* bytes) { save_slip<3>(spatial(s), bytes); },
    [](void* s, const void* bytes, int64_t size, Message& message) {
      return load_slip<3>(spatial(s), bytes, size, "echospline_spatial_state_save", message);
    },
};

}  // namespace
}  // namespace echospline::ECHOSPLINE_CORE
