// States of tissue under a needle's forces as bytes, in the plane (D = 2) and in space (D = 3).
//
// A fixed part, what it announces as numbers, and a checksum. In space the numbers hold the units across the needle's axis besides, which
// the plane's axis determines.
#pragma once
#include "../include/echospline/stick_slip.hpp"
#include "tissue_level.hpp"

namespace echospline::ECHOSPLINE_CORE {
namespace {

constexpr uint32_t SLIP_VERSION = 1;

struct SlipHeader {
  char magic[8];
  uint32_t version;
  int32_t directed;
  uint64_t fingerprint;
  int64_t count;  ///< of stations
};
static_assert(sizeof(SlipHeader) == 32);

template <int D>
struct SlipNumbers {
  static constexpr const char* magic = D == 2 ? "echoslip" : "echoslid";
  static constexpr int64_t fixed = 3 * D + 3 + (D == 3 ? 2 * D : 0);  ///< of the needle
  static constexpr int64_t each = 4 * D + 1;                          ///< of a station
};

template <int D>
inline echospline_status slip_status(typename SlipTissueIn<D>::Outcome outcome) {
  using Tissue = SlipTissueIn<D>;
  switch (outcome) {
    case Tissue::done: return ECHOSPLINE_OK;
    case Tissue::needs_station: return ECHOSPLINE_NEEDS_STATION;
    case Tissue::no_memory: return ECHOSPLINE_OUT_OF_MEMORY;
    default: return ECHOSPLINE_NOT_SOLVED;
  }
}

template <int D>
inline uint64_t fingerprint_of(const SlipTissueIn<D>& own) {
  return checksum(&own.law, sizeof own.law, checksum(&own.nodes, sizeof own.nodes));
}

template <int D>
inline int64_t slip_size_of(int64_t count) {
  const int64_t numbers = SlipNumbers<D>::fixed + count * SlipNumbers<D>::each;
  return static_cast<int64_t>(sizeof(SlipHeader) + sizeof(uint64_t)) + numbers * static_cast<int64_t>(sizeof(double));
}
template <int D>
inline int64_t slip_size(const SlipTissueIn<D>& own) {
  return slip_size_of<D>(own.state.count);
}

/// Numbers of a state one after another, on their way out or in.
template <int D, class Number, class Do>
inline void each_number(Number& s, Do&& act) {
  for (int d = 0; d < D; ++d) act(s.tip.v[d]);
  for (int d = 0; d < D; ++d) act(s.axis.v[d]);
  for (int d = 0; d < D; ++d) act(s.entry.v[d]);
  act(s.depth), act(s.push), act(s.cut);
  for (int n = 0; D == 3 && n < D - 1; ++n)
    for (int d = 0; d < D; ++d) act(s.frame.n[n].v[d]);
}
template <int D, class Contact, class Do>
inline void each_number_of(Contact& c, Do&& act) {
  for (int d = 0; d < D; ++d) act(c.place.v[d]);
  for (int d = 0; d < D; ++d) act(c.axis.v[d]);
  act(c.friction);
  for (int d = 0; d < D - 1; ++d) act(c.side[d]);
  act(c.covered);
  for (int d = 0; d < D; ++d) act(c.moved.v[d]);
}

template <int D>
ECHOSPLINE_SET_UP void save_slip(const SlipTissueIn<D>& own, void* bytes) {
  const SlipStateIn<D>& s = own.state;
  SlipHeader header;
  std::memset(&header, 0, sizeof header);
  std::memcpy(header.magic, SlipNumbers<D>::magic, sizeof header.magic);
  header.version = SLIP_VERSION, header.directed = s.directed, header.fingerprint = fingerprint_of(own);
  header.count = s.count;
  unsigned char* p = static_cast<unsigned char*>(bytes);
  std::memcpy(p, &header, sizeof header);
  p += sizeof header;
  const auto put = [&](const double& v) { std::memcpy(p, &v, sizeof v), p += sizeof v; };
  each_number<D>(s, put);
  for (int64_t j = 0; j < s.count; ++j) each_number_of<D>(s.contacts[j], put);
  const uint64_t sum = checksum(bytes, p - static_cast<unsigned char*>(bytes));
  std::memcpy(p, &sum, sizeof sum);
}

template <int D>
inline bool unit(const Vec<D>& v) {
  return std::fabs(dot(v, v) - 1) < 1e-6;
}

/// Whether axis and frame are units at right angles.
template <int D>
inline bool framed(const SlipStateIn<D>& s) {
  bool right = unit(s.axis);
  for (int n = 0; n < D - 1; ++n) {
    right = right && unit(s.frame.n[n]) && std::fabs(dot(s.frame.n[n], s.axis)) < 1e-6;
    for (int m = 0; m < n; ++m) right = right && std::fabs(dot(s.frame.n[n], s.frame.n[m])) < 1e-6;
  }
  return right;
}

inline echospline_status refuse_slip(Message& message, const char* writer, const char* why) {
  std::snprintf(message.text, sizeof message.text, "a state must be bytes that %s wrote for the same options; %s",
                writer, why);
  return ECHOSPLINE_WRONG_STATE;
}

template <int D>
ECHOSPLINE_SET_UP echospline_status load_slip(SlipTissueIn<D>& own, const void* bytes, int64_t size, const char* writer,
                                              Message& message) {
  const unsigned char* p = static_cast<const unsigned char*>(bytes);
  const auto refuse = [&](const char* why) { return refuse_slip(message, writer, why); };
  SlipHeader header;
  if (size < slip_size_of<D>(0)) return refuse("these are too few");
  std::memcpy(&header, p, sizeof header);
  if (std::memcmp(header.magic, SlipNumbers<D>::magic, sizeof header.magic) != 0)
    return refuse("these begin differently");
  if (header.version != SLIP_VERSION) return refuse("these are of another version: save the state again");
  const int64_t count = header.count;
  if (count < 0 || count == 1 || count > MOST_STATIONS || size != slip_size_of<D>(count))
    return refuse("their number does not fit the stations that they announce");
  uint64_t sum;
  std::memcpy(&sum, p + size - sizeof sum, sizeof sum);
  if (sum != checksum(bytes, size - static_cast<int64_t>(sizeof sum))) return refuse("these are damaged");
  if (header.fingerprint != fingerprint_of(own)) return refuse("these belong to other options");
  p += sizeof header;
  bool small = true;
  const auto take = [&](double& v) {
    std::memcpy(&v, p, sizeof v), p += sizeof v;
    if (!(std::fabs(v) <= 1e9)) small = false;
  };
  SlipStateIn<D> read;  // without its stations
  each_number<D>(read, take);
  if (D == 2 && header.directed) read.frame = frame_of(read.axis);
  if (!small || (header.directed ? !framed(read) : count > 0) || read.push < 0 || read.cut < 0 ||
      read.cut > own.law.spacing * static_cast<double>(count))
    return refuse("a number in these is out of its range");
  const unsigned char* stations = p;
  for (int64_t j = 0; j < count; ++j) {
    SlipContactIn<D> contact = {};
    each_number_of<D>(contact, take);
    if (!small || !unit(contact.axis) || contact.covered < 0) return refuse("a station in these is out of its range");
  }
  if (!own.room_for(count)) return ECHOSPLINE_OUT_OF_MEMORY;
  own.drop_step();
  SlipStateIn<D>& s = own.state;
  s.directed = header.directed != 0, s.tip = read.tip, s.axis = read.axis, s.entry = read.entry;
  s.depth = read.depth, s.push = read.push, s.cut = read.cut, s.count = count;
  s.frame = read.frame;
  p = stations;
  for (int64_t j = 0; j < count; ++j) each_number_of<D>(s.contacts[j], take);
  return ECHOSPLINE_OK;
}

}  // namespace
}  // namespace echospline::ECHOSPLINE_CORE
