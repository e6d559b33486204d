// A needle that sticks, slips and cuts, in the plane (D = 2) or in space (D = 3): forces on tissue whose answer to a point of the track is
// supplied from outside.
//
// The law is that of `mechanics/stick_slip.py`, with the same names. `SlipTissue` keeps what the tissue answers to each station:
// the displacement of the mesh by unit forces there (columns, single precision), and the mean displacement over the stations before
// it (rows). A step that needs a station which has no answer yet stops; once `answer` has supplied it the same step goes on. A
// supplier inside the core would call `answer` itself. Across the axis lie D - 1 units, the *frame*; in space it turns with the axis along
// the great circle, so that a side force stays the side stiffness times the gap as a vector, whichever way the needle is tilted.
#pragma once
#include <cmath>
#include <cstdint>
#include <cstring>

#include "array.hpp"
#include "echospline.h"
#include "level_begin.hpp"
#include "vec.hpp"

namespace echospline::ECHOSPLINE_CORE {

constexpr int MOST_STATIONS = 512;       // of a track: 640 mm at the usual spacing
constexpr int MOST_SLIP_SUBSTEPS = 400;  // of a step; a needle that jumps further is solved in longer ones
constexpr int MOST_REPEATS = 20;         // solutions of a substep, while front, cover and displacement come to agree
constexpr double AGREED = 1e-7;          // mm; front and cover agree when they change by less
constexpr double LEAST_CONTACT = 1e-9;   // mm; a piece that is covered less than this is not touched
constexpr double RUN_AHEAD = 1.5;  // travels of the needle that the front may advance in a substep: see the Python file
constexpr double SPRING_BACK = 1.0;       // travels of the needle that a station may spring back in a substep
constexpr double SAME_AXIS = 1e-9;        // axes that differ by less are one axis
constexpr double NO_LENGTH = 1e-9;        // mm; a shorter needle has no direction
constexpr double PIVOT_ROUNDING = 1e-13;  // N or mm; bounds hold within it
constexpr int MOST_GUESSES = 30;          // of the bounds that hold, before they change one at a time
constexpr int MOST_CHANGES = 20;          // one at a time, per unknown
constexpr int MOST_SWEEPS = 2000;         // if rounding keeps those from ending

/// Parameters of the law; units as in `echospline_force_options`.
template <int D>
struct SlipLawIn {
  double tip, friction_limit, bond, tip_stiffness, side_stiffness, viscosity, spacing, substep, dead_band;
  double low[D], high[D];  ///< corners of the tissue, mm
};

/// A material point of the track and its load: a hat over two spacings, as point forces where there is tissue.
template <int D>
struct SlipStationIn {
  Vec<D> place, axis, points[4];
  double weights[4];
  double before, share;  ///< part of the hat before the first point in the tissue, and in the tissue
  int count;             ///< of points
};

template <int D>
inline bool in_tissue(const SlipLawIn<D>& law, const Vec<D>& p) {
  for (int d = 0; d < D; ++d)
    if (!(p[d] >= law.low[d] && p[d] <= law.high[d])) return false;
  return true;
}

template <int D>
inline SlipStationIn<D> station_at(const SlipLawIn<D>& law, const Vec<D>& place, const Vec<D>& axis) {
  static const double at[4] = {-0.75, -0.25, 0.25, 0.75}, part[4] = {0.125, 0.375, 0.375, 0.125};
  SlipStationIn<D> s = {place, axis, {}, {}, 0, 0, 0};
  for (int i = 0; i < 4; ++i) {
    const Vec<D> p = place + law.spacing * at[i] * axis;
    if (!in_tissue(law, p)) {
      if (s.count == 0) s.before += part[i];
      continue;
    }
    s.points[s.count] = p, s.weights[s.count++] = part[i], s.share += part[i];
  }
  if (s.count == 0) s.before = 0;
  for (int i = 0; i < s.count; ++i) s.weights[i] /= s.share;
  return s;
}

/// Minimise z.A z / 2 - b.z with low <= z <= high, where beyond a bound z costs soft (z - bound)^2 / 2 (soft 0: a hard bound).
class BoxProgramme {
 public:
  Array<double> b, low, high, soft, z;
  Array<int32_t> held;  ///< -1: at low, 1: at high; a guess before `solve`

  bool reserve(int64_t most) {
    return A_.reserve(most * most) && S_.reserve(most * most) && b.reserve(most) && low.reserve(most) &&
           high.reserve(most) && soft.reserve(most) && z.reserve(most) && held.reserve(most) && rhs_.reserve(most) &&
           index_.reserve(most);
  }
  void begin(int64_t count) { n_ = count; }
  double& A(int64_t i, int64_t j) { return A_[i * n_ + j]; }

  /// False where A is not positive definite.
  bool solve() {
    for (int guess = 0; guess < MOST_GUESSES; ++guess) {
      if (!with_bounds()) return false;
      if (!correct(false)) return true;
    }
    for (int64_t change = 0; change < MOST_CHANGES * n_; ++change) {
      if (!with_bounds()) return false;
      if (!correct(true)) return true;
    }
    return sweep();
  }

 private:
  int64_t n_ = 0;
  Array<double> A_, S_, rhs_;
  Array<int64_t> index_;

  double bound(int64_t i) const { return held[i] > 0 ? high[i] : low[i]; }

  /// Minimum with the bounds that are held: Cholesky's factorisation of the free part, by rows.
  bool with_bounds() {
    int64_t m = 0;
    for (int64_t i = 0; i < n_; ++i) {
      if (held[i] != 0 && soft[i] == 0)
        z[i] = bound(i);
      else
        index_[m++] = i;
    }
    for (int64_t r = 0; r < m; ++r) {
      const int64_t i = index_[r];
      double sum = b[i];
      for (int64_t j = 0; j < n_; ++j)
        if (held[j] != 0 && soft[j] == 0) sum -= A_[i * n_ + j] * z[j];
      if (held[i] != 0) sum += soft[i] * bound(i);
      rhs_[r] = sum;
      for (int64_t c = r; c < m; ++c) S_[r * m + c] = A_[i * n_ + index_[c]];
      if (held[i] != 0) S_[r * m + r] += soft[i];
    }
    for (int64_t k = 0; k < m; ++k) {
      double* row = &S_[k * m];
      if (!(row[k] > 0)) return false;
      const double pivot = 1 / row[k];
      for (int64_t r = k + 1; r < m; ++r) {
        const double factor = row[r] * pivot;
        if (factor == 0) continue;
        double* other = &S_[r * m];
        for (int64_t c = r; c < m; ++c) other[c] -= factor * row[c];
        rhs_[r] -= factor * rhs_[k];
      }
    }
    for (int64_t k = m - 1; k >= 0; --k) {
      const double* row = &S_[k * m];
      double sum = rhs_[k];
      for (int64_t c = k + 1; c < m; ++c) sum -= row[c] * rhs_[c];
      rhs_[k] = sum / row[k];
      if (!std::isfinite(rhs_[k])) return false;
      z[index_[k]] = rhs_[k];
    }
    return true;
  }

  /// Correct the guess by the solution, all of it or only the first bound that is wrong (which ends: Murty 1974); false when it was right.
  bool correct(bool first_alone) {
    bool changed = false;
    for (int64_t i = 0; i < n_; ++i) {
      int32_t next = 0;
      if (held[i] == 0) {
        next = z[i] > high[i] + PIVOT_ROUNDING ? 1 : z[i] < low[i] - PIVOT_ROUNDING ? -1 : 0;
      } else {
        double pull = 0;
        if (soft[i] == 0) {
          pull = b[i];
          for (int64_t j = 0; j < n_; ++j) pull -= A_[i * n_ + j] * z[j];
        } else {
          pull = z[i] - bound(i);
        }
        if (held[i] > 0 ? pull > -PIVOT_ROUNDING : pull < PIVOT_ROUNDING) next = held[i];
      }
      if (next != held[i] && first_alone) {
        held[i] = next;
        return true;
      }
      if (next != held[i]) changed = true;
      index_[i] = next;
    }
    for (int64_t i = 0; i < n_; ++i) held[i] = static_cast<int32_t>(index_[i]);
    return changed;
  }

  /// Gauss-Seidel with bounds: slow, and always converges.
  bool sweep() {
    for (int64_t i = 0; i < n_; ++i) z[i] = 0;
    for (int s = 0; s < MOST_SWEEPS; ++s) {
      double change = 0, size = 1;
      for (int64_t i = 0; i < n_; ++i) {
        const double own = A_[i * n_ + i];
        if (!(own > 0)) return false;
        double pull = b[i];
        for (int64_t j = 0; j < n_; ++j) pull -= A_[i * n_ + j] * z[j];
        const double free = z[i] + pull / own;
        const double at = free > high[i] ? high[i] : free < low[i] ? low[i] : free;
        const double next = soft[i] == 0 ? at : (free * own + at * soft[i]) / (own + soft[i]);
        if (!std::isfinite(next)) return false;
        change = std::fmax(change, std::fabs(next - z[i])), size = std::fmax(size, std::fabs(next));
        z[i] = next;
      }
      if (change < 1e-14 * size) return true;
    }
    return false;
  }
};

/// A station of a state.
template <int D>
struct SlipContactIn {
  Vec<D> place, axis;
  double friction, side[D - 1], covered;  ///< N, N along each of the frame, mm
  Vec<D> moved;                           ///< displacement, mm
};

/// Units across an axis, at right angles to each other.
template <int D>
struct SlipFrame {
  Vec<D> n[D - 1];
};
inline Vec<2> normal_of(const Vec<2>& a) { return {{-a[1], a[0]}}; }
inline Vec<3> cross(const Vec<3>& a, const Vec<3>& b) {
  return {{a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]}};
}
inline SlipFrame<2> frame_of(const Vec<2>& axis) { return {{normal_of(axis)}}; }
/// In space any two units will do: the first lies across the coordinate that the axis has least of.
inline SlipFrame<3> frame_of(const Vec<3>& axis) {
  Vec<3> least = {};
  int at = 0;
  for (int d = 1; d < 3; ++d)
    if (std::fabs(axis[d]) < std::fabs(axis[at])) at = d;
  least[at] = 1;
  Vec<3> first = cross(axis, least);
  first = (1 / norm(first)) * first;
  return {{first, cross(axis, first)}};
}
/// Frame after the axis has turned: about the line at right angles to both, and not about itself.
inline SlipFrame<2> turned(const SlipFrame<2>&, const Vec<2>&, const Vec<2>& axis) { return frame_of(axis); }
inline SlipFrame<3> turned(const SlipFrame<3>& frame, const Vec<3>& before, const Vec<3>& axis) {
  if (axis[0] == before[0] && axis[1] == before[1] && axis[2] == before[2]) return frame;
  Vec<3> first = frame.n[0] - dot(frame.n[0], axis) / (1 + dot(before, axis)) * (before + axis);
  first = first - dot(first, axis) * axis;  // rounding does not add up
  first = (1 / norm(first)) * first;
  return {{first, cross(axis, first)}};
}
/// Axis that has turned from one to another by a share of the angle between them.
inline Vec<2> between(const Vec<2>& start, const Vec<2>& end, double share) {
  const double first = std::atan2(start[1], start[0]), pi = 3.14159265358979323846;
  double turn = std::fmod(std::atan2(end[1], end[0]) - first + pi, 2 * pi);
  turn = (turn < 0 ? turn + 2 * pi : turn) - pi;
  const double angle = first + share * turn;
  return {{std::cos(angle), std::sin(angle)}};
}
inline Vec<3> between(const Vec<3>& start, const Vec<3>& end, double share) {
  const double cosine = dot(start, end), angle = std::acos(std::fmin(1.0, cosine));
  const Vec<3> ahead = end - cosine * start;
  const double length = norm(ahead);
  if (length < SAME_AXIS * SAME_AXIS) return end;
  return std::cos(share * angle) * start + std::sin(share * angle) / length * ahead;
}

/// What needle and tissue remember.
template <int D>
struct SlipStateIn {
  bool directed = false;  ///< a pose with a direction has come
  Vec<D> tip = {}, axis = {}, entry = {};
  SlipFrame<D> frame = {};  ///< across the axis
  double depth = 0, push = 0, cut = 0;
  int64_t count = 0;
  Array<SlipContactIn<D>> contacts;

  void copy(const SlipStateIn& other) {
    directed = other.directed, tip = other.tip, axis = other.axis, entry = other.entry, frame = other.frame;
    depth = other.depth, push = other.push, cut = other.cut, count = other.count;
    for (int64_t j = 0; j < count; ++j) contacts[j] = other.contacts[j];
  }
  void clear() { directed = false, tip = axis = entry = {}, frame = {}, depth = push = cut = 0, count = 0; }
};

template <int D>
inline bool same(const Vec<D>& a, const Vec<D>& b) {
  for (int d = 0; d < D; ++d)
    if (a[d] != b[d]) return false;
  return true;
}

/// Needle and tissue: a state, the stations' answers, and the room in which a step works.
template <int D>
class SlipTissueIn {
 public:
  enum Outcome { done, no_memory, not_solved, needs_station };

  const SlipLawIn<D> law;
  const int64_t nodes;
  SlipStateIn<D> state;
  SlipStationIn<D> wanted = {};  ///< station that a call has asked for
  int64_t wanted_index = -1;

  SlipTissueIn(const SlipLawIn<D>& given, int64_t node_count) : law(given), nodes(node_count) {}
  bool build() { return make_room(8); }

  void rest() {
    state.clear();
    pending_ = false, wanted_index = -1;
  }

  /// The needle has moved to a pose in pose.dt seconds.
  Outcome advance(const echospline_pose& pose) {
    const Vec<D> entry = point_of<D>(pose.entry), tip = point_of<D>(pose.tip);
    if (!(pending_ && same(entry, pending_entry_) && same(tip, pending_tip_) && pose.dt == pending_dt_)) {
      work_.copy(state);
      next_ = 1;
    }
    pending_ = false, wanted_index = -1;
    const Vec<D> along = tip - entry;
    const double depth = norm(along);
    if (depth < NO_LENGTH) {  // it has no direction and touches nothing
      release(state);
      state.tip = tip, state.entry = entry, state.depth = 0;
      return done;
    }
    Vec<D> axis = (1 / depth) * along;
    const bool anew = !state.directed || dot(state.axis, axis) < 0;  // the first, or drawn out and turned
    const bool straight = anew || alike(axis, state.axis);
    if (straight && !anew) axis = state.axis;
    const Vec<D> from = anew ? entry : state.tip, axis0 = anew ? axis : state.axis;
    const double depth0 = anew ? 0 : state.depth;
    if (anew && next_ == 1) {
      release(work_);
      work_.directed = true, work_.axis = axis, work_.frame = frame_of(axis), work_.tip = entry, work_.depth = 0;
    }
    const double ahead = dot(tip - from, axis);
    const double held = ahead > law.dead_band ? law.dead_band : ahead < -law.dead_band ? -law.dead_band : ahead;
    const Vec<D> acting = tip - held * axis;
    double length = 0;
    if (state.count > 0 && !anew)
      length = std::fmax(0.0, dot(from - state.contacts[0].place - state.contacts[0].moved, axis0));
    const double travel = std::fmax(norm(acting - from), norm(acting - length * axis - from + length * axis0));
    const double parts = std::ceil(travel / law.substep - 1e-9);
    const int64_t count = parts > MOST_SLIP_SUBSTEPS ? MOST_SLIP_SUBSTEPS : parts > 1 ? static_cast<int64_t>(parts) : 1;
    const double parts_count = static_cast<double>(count);
    for (; next_ <= count; ++next_) {
      const double s = static_cast<double>(next_) / parts_count;
      const Vec<D> a = straight || next_ == count ? axis : between(axis0, axis, s);
      const Outcome outcome = substep(from + s * (acting - from), a, depth0 + s * (depth - depth0),
                                      travel / parts_count, pose.dt / parts_count);
      if (outcome != done) return wait(outcome, entry, tip, pose.dt);
    }
    work_.entry = entry;
    state.copy(work_);
    return done;
  }

  /// Supply the wanted station's answer. columns: (D, nodes, D), may be nullptr where no point lies in the tissue, or where there are no
  /// nodes; rows (index + 1, D, D).
  Outcome answer(const float* columns, const double* rows) {
    const int64_t j = wanted_index;
    if (j + 3 > room_ && !make_room(2 * room_)) return no_memory;
    if (!rows_[j].reserve(D * D * (j + 1))) return no_memory;
    if (columns && columns_[j].size() != D * D * nodes && !columns_[j].reserve(D * D * nodes)) return no_memory;
    if (columns)
      std::memcpy(columns_[j].data(), columns, static_cast<size_t>(D * D * nodes) * sizeof(float));
    else
      columns_[j].reserve(0);
    std::memcpy(rows_[j].data(), rows, static_cast<size_t>(D * D * (j + 1)) * sizeof(double));
    double* own = &rows_[j][D * D * j];
    for (int c = 0; c < D; ++c)
      for (int d = c + 1; d < D; ++d) own[D * c + d] = own[D * d + c] = (own[D * c + d] + own[D * d + c]) / 2;
    stations_[j] = wanted;
    answers_ = j + 1;
    wanted_index = -1;
    return done;
  }

  int64_t answers() const { return answers_; }
  const SlipStationIn<D>& station(int64_t j) const { return stations_[j]; }

  /// Share of the tip's force at a station; the front lies between two.
  double weight_at(double cut, int64_t count, int64_t j) const {
    int64_t first = static_cast<int64_t>(cut / law.spacing);
    if (first > count - 2) first = count - 2;
    const double beyond = cut / law.spacing - static_cast<double>(first);
    return j == first ? 1 - beyond : j == first + 1 ? beyond : 0;
  }
  /// Force at a station of a state, N.
  Vec<D> force_of(const SlipStateIn<D>& s, int64_t j) const {
    const SlipContactIn<D>& contact = s.contacts[j];
    const double along = contact.friction + (s.count > 1 ? weight_at(s.cut, s.count, j) * s.push : 0);
    Vec<D> f = along * s.axis;
    for (int d = 0; d < D - 1; ++d) f = f + contact.side[d] * s.frame.n[d];
    return f;
  }
  /// Force at every station of the state, (count, D) N.
  void forces(double* out) const { forces_of(state, out); }

  void load(echospline_needle_load& out) const
    requires(D == 2)
  {
    out.tip = state.push, out.cut = state.cut, out.friction = out.side = out.torque = 0;
    for (int64_t j = 0; j < state.count; ++j) {
      const SlipContactIn<D>& contact = state.contacts[j];
      const Vec<D> f = force_of(state, j), arm = contact.place + contact.moved - state.entry;
      out.friction += contact.friction, out.side += contact.side[0];
      out.torque += arm[0] * f[1] - arm[1] * f[0];
    }
  }

  /// Displacement of the mesh nodes, (nodes, D) mm: columns times forces.
  template <class Number>
  Outcome displacement(Number* out) {
    constexpr int64_t BLOCK = 2048;
    float sum[BLOCK];
    int64_t used = 0;
    for (int64_t j = 0; j < state.count; ++j) {
      const Vec<D> f = force_of(state, j);
      if (same(f, Vec<D>{})) continue;
      if (used == 0) {
        const Outcome missing = answered(state);
        if (missing != done) return missing;
      }
      if (stations_[j].count == 0) continue;
      for (int d = 0; d < D; ++d)
        if (f[d] != 0) factor_[used] = static_cast<float>(f[d]), column_[used++] = columns_[j].data() + d * D * nodes;
    }
    for (int64_t begin = 0; begin < D * nodes; begin += BLOCK) {
      const int64_t size = begin + BLOCK < D * nodes ? BLOCK : D * nodes - begin;
      for (int64_t i = 0; i < size; ++i) sum[i] = 0;
      int64_t k = 0;
      for (; k + 4 <= used; k += 4) {  // four at a time: the sum is read and written a quarter as often
        const float a = factor_[k], b = factor_[k + 1], c = factor_[k + 2], d = factor_[k + 3];
        const float *p = column_[k] + begin, *q = column_[k + 1] + begin, *r = column_[k + 2] + begin,
                    *s = column_[k + 3] + begin;
        for (int64_t i = 0; i < size; ++i) sum[i] += (a * p[i] + b * q[i]) + (c * r[i] + d * s[i]);
      }
      for (; k < used; ++k) {
        const float a = factor_[k];
        const float* p = column_[k] + begin;
        for (int64_t i = 0; i < size; ++i) sum[i] += a * p[i];
      }
      for (int64_t i = 0; i < size; ++i) out[begin + i] = static_cast<Number>(sum[i]);
    }
    return done;
  }

  /// Room for a state of `count` stations, to be loaded.
  bool room_for(int64_t count) {
    int64_t room = room_;
    while (room < count + 2) room *= 2;
    return room == room_ || make_room(room);
  }
  void drop_step() { pending_ = false, wanted_index = -1; }
  /// Forget what stations have been answered: something else answers from now on.
  void forget_answers() {
    drop_step();
    answers_ = 0;
  }
  /// Whether every station of the state has its answer; else asks for the first that has none.
  Outcome answered_all() { return answered(state); }

 private:
  SlipStateIn<D> work_;
  bool pending_ = false;
  Vec<D> pending_entry_ = {}, pending_tip_ = {};
  double pending_dt_ = 0;
  int64_t next_ = 1, room_ = 0, answers_ = 0;
  SlipStationIn<D> stations_[MOST_STATIONS + 2] = {};
  Array<float> columns_[MOST_STATIONS + 2];
  Array<double> rows_[MOST_STATIONS + 2];
  float factor_[D * MOST_STATIONS + 4] = {};
  const float* column_[D * MOST_STATIONS + 4] = {};
  BoxProgramme box_;
  Array<double> within_[D]
                       [D];  // compliance in the needle's frame, (k, k): along direction c at i by a force along d at j
  Array<double> free_[D],
      before_[D];  // where the shaft is beyond and beside the stations, in tissue at rest and as it was, mm
  Array<double> covered_, front_, force_;
  Array<Vec<D>> moved_;
  Array<int64_t> on_;

  bool make_room(int64_t room) {
    SlipStateIn<D> other[2];
    SlipStateIn<D>* kept[2] = {&state, &work_};
    for (int i = 0; i < 2; ++i) {
      if (!other[i].contacts.reserve(room)) return false;
      for (int64_t j = 0; j < kept[i]->count; ++j) other[i].contacts[j] = kept[i]->contacts[j];
    }
    for (int c = 0; c < D; ++c) {
      if (!free_[c].reserve(room) || !before_[c].reserve(room)) return false;
      for (int d = 0; d < D; ++d)
        if (!within_[c][d].reserve(room * room)) return false;
    }
    if (!covered_.reserve(room) || !front_.reserve(room) || !force_.reserve(D * room) || !moved_.reserve(room) ||
        !on_.reserve(room) || !box_.reserve(D * room + 1))
      return false;
    for (int i = 0; i < 2; ++i) kept[i]->contacts.swap(other[i].contacts);
    room_ = room;
    return true;
  }

  static void release(SlipStateIn<D>& s) {
    s.push = 0;
    for (int64_t j = 0; j < s.count; ++j) {
      SlipContactIn<D>& contact = s.contacts[j];
      contact = {contact.place, contact.axis, 0, {}, 0, {}};
    }
  }

  Outcome wait(Outcome outcome, const Vec<D>& entry, const Vec<D>& tip, double dt) {
    pending_ = outcome == needs_station;
    pending_entry_ = entry, pending_tip_ = tip, pending_dt_ = dt;
    return outcome;
  }

  Outcome want(int64_t index, const Vec<D>& place, const Vec<D>& axis) {
    wanted = station_at(law, place, axis), wanted_index = index;
    return needs_station;
  }

  bool matches(int64_t j, const Vec<D>& place, const Vec<D>& axis) const {
    return j < answers_ && same(stations_[j].place, place) && same(stations_[j].axis, axis);
  }

  /// Whether every station of a state has its answer; else asks for the first that has none.
  Outcome answered(const SlipStateIn<D>& s) {
    for (int64_t j = 0; j < s.count; ++j)
      if (!matches(j, s.contacts[j].place, s.contacts[j].axis)) return want(j, s.contacts[j].place, s.contacts[j].axis);
    return done;
  }

  /// Compliance block: displacement of station i, component c, by a unit force at j, component d; symmetric.
  double C(int64_t i, int c, int64_t j, int d) const {
    return i <= j ? rows_[j][D * D * i + D * c + d] : rows_[i][D * D * j + D * d + c];
  }

  void forces_of(const SlipStateIn<D>& s, double* out) const {
    for (int64_t j = 0; j < s.count; ++j) {
      const Vec<D> f = force_of(s, j);
      for (int d = 0; d < D; ++d) out[D * j + d] = f[d];
    }
  }

  Outcome substep(const Vec<D>& tip, const Vec<D>& axis, double depth, double travel, double dt) {
    SlipStateIn<D>& s = work_;
    bool touching = s.push > 0;
    for (int64_t j = 0; j < s.count && !touching; ++j) touching = s.contacts[j].covered > 0;
    if (!touching) {
      if (!in_tissue(law, tip)) {
        s.frame = turned(s.frame, s.axis, axis);
        s.tip = tip, s.axis = axis, s.depth = depth;
        return done;
      }
      if (!in_the_track(tip, axis)) {
        const Vec<D> place = entry_of(tip, axis, depth);
        if (!matches(0, place, axis)) return want(0, place, axis);
        s.contacts[0] = {place, axis, 0, {}, 0, {}};
        s.count = 1, s.push = s.cut = 0;
      }
    }
    const Outcome missing = answered(s);  // only now: a track that has just been left for another needs none
    if (missing != done) return missing;
    while (s.count < 2 || (static_cast<double>(s.count - 1) * law.spacing < s.cut + RUN_AHEAD * travel &&
                           stations_[s.count - 1].share > 0 && s.count < MOST_STATIONS)) {
      const int64_t j = s.count;
      const Vec<D> place = s.contacts[j - 1].place + law.spacing * axis;
      if (!matches(j, place, axis)) return want(j, place, axis);
      SlipContactIn<D> next = {place, axis, 0, {}, 0, {}};
      for (int64_t i = 0; i < j && j > 1; ++i) {
        const Vec<D> f = force_of(s, i);
        for (int c = 0; c < D; ++c)
          for (int d = 0; d < D; ++d) next.moved[c] += C(j, c, i, d) * f[d];
      }
      s.contacts[s.count++] = next;
    }
    return solve(tip, axis, depth, travel, dt);
  }

  static bool alike(const Vec<D>& a, const Vec<D>& b) {
    for (int d = 0; d < D; ++d)
      if (!(std::fabs(a[d] - b[d]) < SAME_AXIS)) return false;
    return true;
  }
  /// Length of what lies across an axis.
  static double beside(const Vec<D>& v, const Vec<D>& axis) {
    const SlipFrame<D> frame = frame_of(axis);
    double square = 0;
    for (int d = 0; d < D - 1; ++d) square += dot(v, frame.n[d]) * dot(v, frame.n[d]);
    return std::sqrt(square);
  }

  bool in_the_track(const Vec<D>& tip, const Vec<D>& axis) const {
    const SlipStateIn<D>& s = work_;
    if (s.count == 0) return false;
    Vec<D> last = s.contacts[0].place;
    if (s.count > 1) {
      last = {};
      for (int64_t j = 0; j < s.count; ++j) last = last + weight_at(s.cut, s.count, j) * s.contacts[j].place;
    }
    const Vec<D> first = s.contacts[0].place;
    return beside(tip - first, axis) <= law.spacing / 2 && beside(tip - last, axis) <= law.spacing / 2 &&
           dot(last - first, axis) >= 0;
  }

  Vec<D> entry_of(const Vec<D>& tip, const Vec<D>& axis, double depth) const {
    double way = depth;
    for (int d = 0; d < D; ++d)
      if (axis[d] != 0) way = std::fmin(way, (tip[d] - (axis[d] > 0 ? law.low[d] : law.high[d])) / axis[d]);
    Vec<D> entry = tip - std::fmax(way, 0.0) * axis;
    for (int d = 0; d < D; ++d) entry[d] = std::fmin(std::fmax(entry[d], law.low[d]), law.high[d]);
    return entry;
  }

  double cover(int64_t j, double eta, double cut) const {
    const double h = law.spacing;
    const double reach = std::fmin(eta, cut - h * static_cast<double>(j)) + h / 2 - stations_[j].before * h;
    const double most = stations_[j].share * h;
    const double w = reach < 0 ? 0 : reach > most ? most : reach;
    return w < LEAST_CONTACT ? 0 : w;
  }

  Outcome solve(const Vec<D>& tip, const Vec<D>& axis, double depth, double travel, double dt) {
    SlipStateIn<D>& s = work_;
    const int64_t k = s.count;
    const SlipFrame<D> frame = turned(s.frame, s.axis, axis);
    Vec<D> own[D] = {axis}, own0[D] = {s.axis};  // the axis, then those across; as they were
    for (int d = 1; d < D; ++d) own[d] = frame.n[d - 1], own0[d] = s.frame.n[d - 1];
    for (int64_t j = 0; j < k; ++j)
      for (int64_t i = 0; i <= j; ++i) {
        const double* B = &rows_[j][D * D * i];
        for (int d = 0; d < D; ++d) {
          Vec<D> moved = {};  // by a unit force along d at j
          for (int c = 0; c < D; ++c)
            for (int e = 0; e < D; ++e) moved[c] += B[D * c + e] * own[d][e];
          for (int c = 0; c < D; ++c) within_[c][d][i * k + j] = within_[d][c][j * k + i] = dot(own[c], moved);
        }
      }
    for (int64_t j = 0; j < k; ++j) {
      const SlipContactIn<D>& contact = s.contacts[j];
      const Vec<D> away = tip - contact.place, before = s.tip - contact.place - contact.moved;
      for (int d = 0; d < D; ++d) free_[d][j] = dot(away, own[d]), before_[d][j] = dot(before, own0[d]);
      moved_[j] = contact.moved;
    }
    const double last = static_cast<double>(k - 1) * law.spacing;
    double furthest = std::fmin(s.cut + RUN_AHEAD * travel, last), cut = s.cut, push = 0;
    double cut_before = 0, lag_before = 0;
    int64_t guessed = -1;
    for (int j = 0; j < k; ++j) covered_[j] = cover(j, free_[0][j] - dot(moved_[j], axis), cut);
    for (int repeat = 0; repeat < MOST_REPEATS; ++repeat) {
      int64_t m = 0;
      for (int64_t j = 0; j < k; ++j)
        if (covered_[j] > 0) on_[m++] = j;
      double touch = 0;
      for (int64_t j = 0; j < k; ++j) {
        front_[j] = weight_at(cut, k, j);
        if (stations_[j].share > 0) touch += front_[j];
      }
      assemble(m, touch, dt, guessed != m);
      guessed = m;
      if (!box_.solve()) return not_solved;
      push = box_.z[D * m];
      for (int64_t j = 0; j < D * k; ++j) force_[j] = 0;
      for (int d = 0; d < D; ++d)
        for (int64_t r = 0; r < m; ++r) force_[d * k + on_[r]] = box_.z[d * m + r];
      double back = 0, eta_front = 0;
      for (int64_t i = 0; i < k; ++i) {
        Vec<D> moved = {};  // in the needle's frame
        for (int64_t j = 0; j < k; ++j)
          for (int d = 0; d < D; ++d) {
            const double f = d == 0 ? force_[j] + front_[j] * push : force_[d * k + j];
            for (int c = 0; c < D; ++c) moved[c] += within_[c][d][i * k + j] * f;
          }
        moved_[i] = {};
        for (int c = 0; c < D; ++c) moved_[i] = moved_[i] + moved[c] * own[c];
        back = std::fmax(back, dot(s.contacts[i].moved - moved_[i], axis));
        eta_front += front_[i] * (free_[0][i] - dot(moved_[i], axis));
      }
      if (cut > s.cut && back > SPRING_BACK * travel)  // cut less far
        furthest = s.cut + (cut - s.cut) * SPRING_BACK * travel / back;
      const double lag = touch > 0 ? eta_front - law.tip / law.tip_stiffness : eta_front;
      double step = lag;
      if (repeat > 0 && cut != cut_before) {
        const double slope = (lag - lag_before) / (cut - cut_before);
        if (slope < 0) step = -lag / slope;
      }
      const double front = std::fmin(std::fmax(cut + step, s.cut), furthest);
      bool settled = std::fabs(front - cut) < AGREED;
      if (repeat + 1 == MOST_REPEATS) break;
      for (int64_t j = 0; j < k; ++j)
        if (std::fabs(cover(j, free_[0][j] - dot(moved_[j], axis), front) - covered_[j]) >= AGREED) settled = false;
      if (settled) break;
      cut_before = cut, lag_before = lag, cut = front;
      for (int64_t j = 0; j < k; ++j) covered_[j] = cover(j, free_[0][j] - dot(moved_[j], axis), cut);
    }
    for (int64_t j = 0; j < k; ++j) {
      SlipContactIn<D>& contact = s.contacts[j];
      contact.friction = force_[j], contact.covered = covered_[j], contact.moved = moved_[j];
      for (int d = 1; d < D; ++d) contact.side[d - 1] = force_[d * k + j];
    }
    s.tip = tip, s.axis = axis, s.frame = frame, s.depth = depth, s.push = push, s.cut = cut;
    return done;
  }

  /// The quadratic programme of friction, side and tip forces; `fresh`: guess which bounds hold from the state before.
  void assemble(int64_t m, double touch, double dt, bool fresh) {
    const SlipStateIn<D>& s = work_;
    const int64_t k = s.count;
    box_.begin(D * m + 1);
    double tip_along = 0;
    for (int64_t i = 0; i < k; ++i)
      for (int64_t j = 0; j < k; ++j)
        if (front_[i] != 0 && front_[j] != 0) tip_along += front_[i] * within_[0][0][i * k + j] * front_[j];
    for (int64_t r = 0; r < m; ++r) {
      const int64_t i = on_[r];
      const SlipContactIn<D>& contact = s.contacts[i];
      const double w = covered_[i], kept = contact.covered > w ? w / contact.covered : 1;
      for (int c = 0; c < D; ++c) {
        const int64_t row = c * m + r;
        double by_tip = 0;
        for (int64_t j = 0; j < k; ++j)
          if (front_[j] != 0) by_tip += within_[c][0][i * k + j] * front_[j];
        for (int d = 0; d < D; ++d)
          for (int64_t q = 0; q < m; ++q) box_.A(row, d * m + q) = within_[c][d][i * k + on_[q]];
        const double firm = (c == 0 ? law.bond : law.side_stiffness) * w;
        const double held = c == 0 ? contact.friction : contact.side[c - 1];
        box_.A(row, row) += 1 / firm;
        box_.A(row, D * m) = box_.A(D * m, row) = by_tip;
        box_.b[row] = kept * held / firm + free_[c][i] - before_[c][i];
        box_.high[row] = c == 0 ? law.friction_limit * w : HUGE_VAL, box_.low[row] = -box_.high[row];
        box_.soft[row] = c == 0 && law.viscosity > 0 ? dt / (law.viscosity * w) : 0;
        if (!fresh) continue;
        const double limit = law.friction_limit * contact.covered * (1 - 1e-9);
        box_.held[row] = c > 0 || contact.covered <= 0 ? 0
                         : contact.friction >= limit   ? 1
                         : contact.friction <= -limit  ? -1
                                                       : 0;
      }
    }
    const double pressing = law.tip_stiffness * touch;
    box_.A(D * m, D * m) = tip_along + (touch > 0 ? 1 / pressing : 1.0);
    box_.b[D * m] = 0;
    for (int64_t j = 0; j < k; ++j) box_.b[D * m] += front_[j] * free_[0][j];
    box_.low[D * m] = 0, box_.high[D * m] = law.tip * touch, box_.soft[D * m] = 0;
    if (fresh) box_.held[D * m] = s.push >= law.tip * touch * (1 - 1e-9) ? 1 : s.push <= 0 ? -1 : 0;
  }
};

// In the plane.
using SlipLaw = SlipLawIn<2>;
using SlipStation = SlipStationIn<2>;
using SlipContact = SlipContactIn<2>;
using SlipState = SlipStateIn<2>;
using SlipTissue = SlipTissueIn<2>;

}  // namespace echospline::ECHOSPLINE_CORE
