// Tissue under a needle's forces at one processor level, and its states as bytes.
#pragma once
#include "../include/echospline/green.hpp"
#include "force_entries.hpp"
#include "tissue_level.hpp"

namespace echospline::ECHOSPLINE_CORE {
namespace {

constexpr char SLIP_MAGIC[8] = {'e', 'c', 'h', 'o', 's', 'l', 'i', 'p'};
constexpr uint32_t SLIP_VERSION = 1;

/// Fixed part of a state's bytes; stations follow, then the checksum of both.
struct SlipHeader {
  char magic[8];
  uint32_t version;
  int32_t directed;
  uint64_t fingerprint;
  int64_t count;
  double tip[2], axis[2], entry[2], depth, push, cut;
};
struct SlipSaved {
  double place[2], axis[2], friction, side, covered, moved[2];
};
static_assert(sizeof(SlipHeader) == 104 && sizeof(SlipSaved) == 72);

inline GreenTissue& forced(void* f) { return *static_cast<GreenTissue*>(f); }
inline const GreenTissue& forced(const void* f) { return *static_cast<const GreenTissue*>(f); }

inline echospline_status status_of(SlipTissue::Outcome outcome) {
  switch (outcome) {
    case SlipTissue::done: return ECHOSPLINE_OK;
    case SlipTissue::needs_station: return ECHOSPLINE_NEEDS_STATION;
    case SlipTissue::no_memory: return ECHOSPLINE_OUT_OF_MEMORY;
    default: return ECHOSPLINE_NOT_SOLVED;
  }
}

inline uint64_t fingerprint_of(const SlipTissue& own) {
  return checksum(&own.law, sizeof own.law, checksum(&own.nodes, sizeof own.nodes));
}

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

inline void save_slip(const void* f, void* bytes) {
  const SlipTissue& own = forced(f);
  const SlipState& s = own.state;
  SlipHeader header;
  std::memset(&header, 0, sizeof header);
  std::memcpy(header.magic, SLIP_MAGIC, sizeof header.magic);
  header.version = SLIP_VERSION, header.directed = s.directed, header.fingerprint = fingerprint_of(own);
  header.count = s.count, header.depth = s.depth, header.push = s.push, header.cut = s.cut;
  for (int d = 0; d < 2; ++d) header.tip[d] = s.tip[d], header.axis[d] = s.axis[d], header.entry[d] = s.entry[d];
  unsigned char* p = static_cast<unsigned char*>(bytes);
  std::memcpy(p, &header, sizeof header);
  p += sizeof header;
  for (int64_t j = 0; j < s.count; ++j, p += sizeof(SlipSaved)) {
    const SlipContact& c = s.contacts[j];
    const SlipSaved saved = {{c.place[0], c.place[1]}, {c.axis[0], c.axis[1]}, c.friction, c.side, c.covered,
                             {c.moved[0], c.moved[1]}};
    std::memcpy(p, &saved, sizeof saved);
  }
  const uint64_t sum = checksum(bytes, p - static_cast<unsigned char*>(bytes));
  std::memcpy(p, &sum, sizeof sum);
}

inline bool small(const double* v, int count) {
  for (int i = 0; i < count; ++i)
    if (!(std::fabs(v[i]) <= 1e9)) return false;
  return true;
}
inline bool unit(const double (&v)[2]) { return std::fabs(v[0] * v[0] + v[1] * v[1] - 1) < 1e-6; }

inline echospline_status refuse_slip(Message& message, const char* why) {
  std::snprintf(message.text, sizeof message.text,
                "a state must be bytes that echospline_forced_state_save wrote for the same options; %s", why);
  return ECHOSPLINE_WRONG_STATE;
}

inline echospline_status load_slip(void* f, const void* bytes, int64_t size, Message& message) {
  SlipTissue& own = forced(f);
  const unsigned char* p = static_cast<const unsigned char*>(bytes);
  SlipHeader header;
  const int64_t fixed = static_cast<int64_t>(sizeof header + sizeof(uint64_t));
  if (size < fixed) return refuse_slip(message, "these are too few");
  std::memcpy(&header, p, sizeof header);
  if (std::memcmp(header.magic, SLIP_MAGIC, sizeof header.magic) != 0)
    return refuse_slip(message, "these begin differently");
  if (header.version != SLIP_VERSION) return refuse_slip(message, "these are of another version: save the state again");
  const int64_t count = header.count;
  if (count < 0 || count == 1 || count > MOST_STATIONS ||
      size != fixed + count * static_cast<int64_t>(sizeof(SlipSaved)))
    return refuse_slip(message, "their number does not fit the stations that they announce");
  uint64_t sum;
  std::memcpy(&sum, p + size - sizeof sum, sizeof sum);
  if (sum != checksum(bytes, size - static_cast<int64_t>(sizeof sum))) return refuse_slip(message, "these are damaged");
  if (header.fingerprint != fingerprint_of(own)) return refuse_slip(message, "these belong to other options");
  if (!small(header.tip, 9) || (header.directed ? !unit(header.axis) : count > 0) || header.push < 0 ||
      header.cut < 0 || header.cut > own.law.spacing * static_cast<double>(count))
    return refuse_slip(message, "a number in these is out of its range");
  for (int64_t j = 0; j < count; ++j) {
    SlipSaved saved;
    std::memcpy(&saved, p + sizeof header + j * static_cast<int64_t>(sizeof saved), sizeof saved);
    if (!small(saved.place, 9) || !unit(saved.axis) || saved.covered < 0)
      return refuse_slip(message, "a station in these is out of its range");
  }
  if (!own.room_for(count)) return ECHOSPLINE_OUT_OF_MEMORY;
  own.drop_step();
  SlipState& s = own.state;
  s.directed = header.directed != 0, s.tip = point_of<2>(header.tip), s.axis = point_of<2>(header.axis);
  s.entry = point_of<2>(header.entry), s.depth = header.depth, s.push = header.push, s.cut = header.cut;
  s.count = count;
  for (int64_t j = 0; j < count; ++j) {
    SlipSaved saved;
    std::memcpy(&saved, p + sizeof header + j * static_cast<int64_t>(sizeof saved), sizeof saved);
    s.contacts[j] = {point_of<2>(saved.place), point_of<2>(saved.axis), saved.friction, saved.side, saved.covered,
                     point_of<2>(saved.moved)};
  }
  return ECHOSPLINE_OK;
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
    [](const void* f) {
      return static_cast<int64_t>(sizeof(SlipHeader) + sizeof(uint64_t)) +
             forced(f).state.count * static_cast<int64_t>(sizeof(SlipSaved));
    },
    save_slip,
    load_slip,
};

}  // namespace
}  // namespace echospline::ECHOSPLINE_CORE
