// The kernel with the anchors already held: G(x, y), the field at x of a unit weight at y that no anchor feels.
//
//   G(x, y) = U(x, y) - [U_xB  P_x] L_B^-1 [U_By  P_y]'
//
// with U the kernel, P its motions and L_B the system (6) of the anchors B alone. A spline through anchors at zero and landmarks C with
// displacements d is G_:C w with G_CC w = d: no larger than what moves. Factored once per scene.
//
// Close to a clamped edge the weights of its anchors are large and of both signs. So that single precision is enough for their field, an anchor's
// kernel is taken less that of a neighbour, its parent (the nearest one before it); rows of [U P] and L_B are in these differences.
#pragma once
#include "array.hpp"
#include "grid.hpp"
#include "kernels.hpp"
#include "lanes.hpp"

namespace echospline::ECHOSPLINE_CORE {

constexpr int64_t ROW = 8;  // doubles: rows of small matrices are padded with zeros to whole cache lines

/// Sum of products of two rows of n doubles, n a multiple of ROW.
ECHOSPLINE_INLINE double dot(const double* a, const double* b, int64_t n) {
  Doubles s{}, t{};
  int64_t i = 0;
  for (; i + 2 * DOUBLE_LANES <= n; i += 2 * DOUBLE_LANES) {
    s += load(a + i) * load(b + i);
    t += load(a + i + DOUBLE_LANES) * load(b + i + DOUBLE_LANES);
  }
  for (; i < n; i += DOUBLE_LANES) s += load(a + i) * load(b + i);
  return total(s + t);
}
/// y += f x for rows of n doubles, n a multiple of ROW.
ECHOSPLINE_INLINE void add(double* y, double f, const double* x, int64_t n) {
  for (int64_t i = 0; i < n; i += DOUBLE_LANES) store(y + i, load(y + i) + f * load(x + i));
}

/// Inverse of a matrix (n, ld) in place, by Gauss and Jordan with row pivots; false where it is singular.
inline bool invert(double* A, int64_t n, int64_t ld, int64_t* pivots) {
  for (int64_t j = 0; j < n; ++j) {
    int64_t best = j;
    for (int64_t i = j + 1; i < n; ++i)
      if (std::fabs(A[i * ld + j]) > std::fabs(A[best * ld + j])) best = i;
    const double pivot = A[best * ld + j];
    if (!(std::fabs(pivot) > 0)) return false;
    pivots[j] = best;
    double* row = A + j * ld;
    if (best != j)
      for (int64_t l = 0; l < ld; ++l) {
        const double t = row[l];
        row[l] = A[best * ld + l], A[best * ld + l] = t;
      }
    row[j] = 1;
    for (int64_t l = 0; l < ld; ++l) row[l] /= pivot;
    for (int64_t i = 0; i < n; ++i)
      if (i != j) {
        const double f = A[i * ld + j];
        A[i * ld + j] = 0;
        add(A + i * ld, -f, row, ld);
      }
  }
  for (int64_t j = n; j-- > 0;)
    if (pivots[j] != j)
      for (int64_t i = 0; i < n; ++i) {
        const double t = A[i * ld + j];
        A[i * ld + j] = A[i * ld + pivots[j]], A[i * ld + pivots[j]] = t;
      }
  return true;
}

/// Anchors that hold one component of the displacement.
template <int D>
struct AnchorRow {
  int64_t count = 0;
  int64_t first = 0;       ///< where its entries begin in a row of [U P]
  Array<int32_t> anchor;   ///< (count)
  Array<int32_t> parent;   ///< of every one, before it in this row; -1 for the first
  Array<double> place[D];  ///< conditioned, (count rounded up to ROW)

  Vec<D> at(int64_t i) const {
    Vec<D> p;
    for (int d = 0; d < D; ++d) p[d] = place[d][i];
    return p;
  }
};

/// G of one set of anchors. Each holds all components of the displacement or some. Rows of [U P] have the anchors of the first component, then
/// those of the next, then the motions; the entry of an anchor is less that of its parent. Where the components are apart, each has a
/// system of its own, and the row of a component has its own anchors and motions alone.
template <int D>
struct AnchoredKernel {
  KernelOf<D> kernel;      ///< in conditioned coordinates (x - centre) / scale
  int c = 1;               ///< components of the kernel
  int systems = 1;         ///< c where the components are apart
  Vec<D> centre;           ///< mm
  double scale = 1;        ///< mm
  int64_t anchors = 0;     ///< b
  int64_t ld = 0;          ///< numbers in the longest row, rounded up to ROW
  Array<double> place[D];  ///< conditioned anchors, (b)
  AnchorRow<D> row[D];     ///< of every component
  bool alike = true;       ///< all anchors hold all components
  Array<double> inverse;   ///< L_B^-1 of every system, (systems, length of the longest row, ld)

  Vec<D> conditioned(const Vec<D>& p) const { return (1 / scale) * (p - centre); }
  Vec<D> anchor(int64_t i) const {
    Vec<D> p;
    for (int d = 0; d < D; ++d) p[d] = place[d][i];
    return p;
  }
  /// Entries of anchors in the row of a component, and with the motions.
  int64_t held_by(int a) const { return systems > 1 ? row[a].count : row[c - 1].first + row[c - 1].count; }
  int64_t order(int a) const { return held_by(a) + kernel.motions; }
  /// Whether component e acts on component a.
  bool acts(int e, int a) const { return systems == 1 || a == e; }
  /// What a spring of stiffness k adds to the diagonal, conditioned; 0 for an infinite one.
  double softness(double stiffness) const {
    double unit = kernel.per_spring / stiffness;
    for (int i = 0; i < kernel.length_power; ++i) unit /= scale;
    for (int i = 0; i > kernel.length_power; --i) unit *= scale;
    return unit;
  }

  /// Rows [U_xB P_x] of a conditioned point, (c, ld).
  void felt(const Vec<D>& x, double* out) const {
    for (int e = 0; e < c; ++e) {
      const AnchorRow<D>& own = row[e];
      const double* places[D];
      for (int d = 0; d < D; ++d) places[d] = own.place[d].data();
      kernel.along(kernel, e, x, places, own.count, out + own.first, ld);
      for (int a = 0; a < c; ++a) {
        if (!acts(e, a)) continue;
        double* entry = out + a * ld + own.first;
        for (int64_t i = own.count; i-- > 1;) entry[i] -= entry[own.parent[i]];
      }
    }
    if (systems == 1)
      kernel.motion(x, out + held_by(0), ld);
    else
      for (int a = 0; a < c; ++a) kernel.motion(x, out + a * ld + held_by(a), ld);
    for (int a = 0; a < c; ++a)
      for (int64_t i = order(a); i < ld; ++i) out[a * ld + i] = 0;
  }
  /// L_B^-1 of such rows, (c, ld).
  void held(const double* felt, double* out) const {
    for (int a = 0; a < c; ++a) {
      const double* own = inverse.data() + (systems > 1 ? a * longest_ * ld : 0);
      for (int64_t i = 0; i < order(a); ++i) out[a * ld + i] = dot(own + i * ld, felt + a * ld, ld);
      for (int64_t i = order(a); i < ld; ++i) out[a * ld + i] = 0;
    }
  }
  /// G between two conditioned points of which one's `felt` and the other's `held` are known.
  void green(const Vec<D>& x, const double* felt, const Vec<D>& y, const double* held, double (&G)[D][D]) const {
    kernel.at(kernel, x - y, G);
    for (int a = 0; a < c; ++a)
      for (int e = 0; e < c; ++e)
        if (acts(e, a)) G[a][e] -= dot(felt + a * ld, held + e * ld, ld);
  }

  enum Outcome { ready, no_memory, not_held };
  /// Assemble and factor L_B; `kernel_for(scale)` describes the kernel in coordinates divided by a scale.
  template <class KernelFor>
  Outcome build(const Anchor<D>* given, int64_t count, KernelFor kernel_for) {
    anchors = count;
    double extent = 0;
    for (int d = 0; d < D; ++d) {
      double low = INFINITY, high = -INFINITY;
      for (int64_t i = 0; i < count; ++i) low = smaller(low, given[i].place[d]), high = larger(high, given[i].place[d]);
      centre[d] = count ? 0.5 * (low + high) : 0;
      extent = larger(extent, high - low);
    }
    scale = extent > 0 ? extent / 2 : 1;
    kernel = kernel_for(scale);
    c = kernel.components, systems = kernel.apart ? c : 1;
    for (int d = 0; d < D; ++d) {
      if (!place[d].reserve(count)) return no_memory;
      for (int64_t i = 0; i < count; ++i) place[d][i] = conditioned(given[i].place)[d];
    }
    for (int e = 0; e < c; ++e)
      if (!build_row(given, e)) return no_memory;
    for (int a = 0; a < c; ++a) longest_ = larger(longest_, order(a));
    ld = rounded_up(longest_, ROW);
    Array<int64_t> pivots;
    Array<double> felt_rows;
    if (!inverse.reserve(systems * longest_ * ld) || !pivots.reserve(longest_) || !felt_rows.reserve(c * ld))
      return no_memory;
    int64_t at[D] = {};
    for (int64_t i = 0; i < count; ++i) {
      felt(anchor(i), felt_rows.data());
      for (int a = 0; a < c; ++a) {
        if (!holds(given[i], a)) continue;
        double* L = system(a);
        const int64_t n = held_by(a), entry = row[a].first + at[a]++;
        std::memcpy(L + entry * ld, &felt_rows[a * ld], static_cast<size_t>(order(a)) * sizeof(double));
        for (int j = 0; j < kernel.motions; ++j) L[(n + j) * ld + entry] = felt_rows[a * ld + n + j];
      }
    }
    for (loose = 0; loose < systems; ++loose) {
      const int first = systems > 1 ? loose : 0, beyond = systems > 1 ? loose + 1 : c;
      double* L = system(loose);
      if (!motions_determined(L, held_by(loose), felt_rows)) return not_held;
      // rows as differences, too
      for (int a = first; a < beyond; ++a) {
        const AnchorRow<D>& own = row[a];
        double* rows = L + own.first * ld;
        for (int64_t i = own.count; i-- > 1;) add(rows + i * ld, -1, rows + own.parent[i] * ld, ld);
        for (int64_t j = held_by(loose); j < order(loose); ++j)
          for (int64_t i = own.count; i-- > 1;) L[j * ld + own.first + i] -= L[j * ld + own.first + own.parent[i]];
      }
      if (!invert(L, order(loose), ld, pivots.data())) return not_held;
    }
    return ready;
  }
  int loose = 0;  ///< system that the anchors do not determine, after `not_held`

 private:
  int64_t longest_ = 0;  ///< row

  double* system(int a) { return inverse.data() + (systems > 1 ? a * longest_ * ld : 0); }
  /// Whether an anchor holds a component; the only one of a scalar kernel stands for all.
  bool holds(const Anchor<D>& given, int component) const { return c == 1 || given.held[component]; }
  bool build_row(const Anchor<D>* given, int component) {
    AnchorRow<D>& own = row[component];
    int64_t count = 0;
    for (int64_t i = 0; i < anchors; ++i) count += holds(given[i], component);
    own.count = count, alike = alike && count == anchors;
    own.first = systems > 1 || component == 0 ? 0 : row[component - 1].first + row[component - 1].count;
    if (!own.anchor.reserve(count) || !own.parent.reserve(count)) return false;
    for (int d = 0; d < D; ++d)
      if (!own.place[d].reserve(rounded_up(count, ROW))) return false;
    count = 0;
    for (int64_t i = 0; i < anchors; ++i) {
      if (!holds(given[i], component)) continue;
      own.anchor[count] = static_cast<int32_t>(i), own.parent[count] = -1;
      for (int d = 0; d < D; ++d) own.place[d][count] = place[d][i];
      double least = INFINITY;
      for (int64_t j = 0; j < count; ++j) {
        const Vec<D> gap = given[i].place - given[own.anchor[j]].place;
        if (dot(gap, gap) < least) least = dot(gap, gap), own.parent[count] = static_cast<int32_t>(j);
      }
      ++count;
    }
    return true;
  }
  /// Whether n entries of anchors leave no motion free: the rows of R' are independent (Gram and Schmidt, largest first).
  bool motions_determined(const double* L, int64_t n, Array<double>& room) const {
    const int p = kernel.motions;
    const int64_t wide = rounded_up(n, ROW);
    if (n < p || !room.reserve(p * wide)) return false;
    for (int j = 0; j < p; ++j)
      for (int64_t i = 0; i < n; ++i) room[j * wide + i] = L[(n + j) * ld + i];
    double first = 0;
    for (int j = 0; j < p; ++j) {
      int best = j;
      for (int l = j; l < p; ++l)
        if (square(room, l, wide) > square(room, best, wide)) best = l;
      const double length = std::sqrt(square(room, best, wide));
      if (j == 0) first = length;
      if (!(length > 1e-9 * first)) return false;
      for (int64_t i = 0; i < wide; ++i) {
        const double t = room[best * wide + i];
        room[best * wide + i] = room[j * wide + i], room[j * wide + i] = t / length;
      }
      for (int l = j + 1; l < p; ++l)
        add(room.data() + l * wide, -dot(room.data() + l * wide, room.data() + j * wide, wide), room.data() + j * wide,
            wide);
    }
    return true;
  }
  static double square(const Array<double>& room, int row, int64_t wide) {
    return dot(room.data() + row * wide, room.data() + row * wide, wide);
  }
};

}  // namespace echospline::ECHOSPLINE_CORE
