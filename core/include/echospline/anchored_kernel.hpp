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

/// G of one set of anchors. Rows of [U P] have all anchors for the first component, then for the next, then the motions; the entry of an
/// anchor is less that of its parent.
template <int D>
struct AnchoredKernel {
  KernelOf<D> kernel;      ///< in conditioned coordinates (x - centre) / scale
  int c = 1;               ///< components of the kernel
  Vec<D> centre;           ///< mm
  double scale = 1;        ///< mm
  int64_t anchors = 0;     ///< b
  int64_t order = 0;       ///< m = b c + motions
  int64_t ld = 0;          ///< m rounded up to ROW
  int64_t padded = 0;      ///< b rounded up to ROW
  Array<double> place[D];  ///< conditioned anchors, (padded)
  Array<int32_t> parent;   ///< of every anchor, before it; -1 for the first
  Array<double> inverse;   ///< L_B^-1, (m, ld)

  Vec<D> conditioned(const Vec<D>& p) const { return (1 / scale) * (p - centre); }
  Vec<D> anchor(int64_t i) const {
    Vec<D> p;
    for (int d = 0; d < D; ++d) p[d] = place[d][i];
    return p;
  }
  /// What a spring of stiffness k adds to the diagonal, conditioned; 0 for an infinite one.
  double softness(double stiffness) const {
    double unit = kernel.per_spring / stiffness;
    for (int i = 0; i < kernel.length_power; ++i) unit /= scale;
    for (int i = 0; i > kernel.length_power; --i) unit *= scale;
    return unit;
  }

  /// Rows [U_xB P_x] of a conditioned point, (c, ld).
  void felt(const Vec<D>& x, double* out) const {
    const double* places[D];
    for (int d = 0; d < D; ++d) places[d] = place[d].data();
    kernel.along(kernel, x, places, anchors, out, ld);
    for (int a = 0; a < c; ++a)
      for (int e = 0; e < c; ++e) {
        double* entry = out + a * ld + e * anchors;
        for (int64_t i = anchors; i-- > 1;) entry[i] -= entry[parent[i]];
      }
    kernel.motion(x, out + anchors * c, ld);
    for (int a = 0; a < c; ++a)
      for (int64_t i = order; i < ld; ++i) out[a * ld + i] = 0;
  }
  /// L_B^-1 of such rows, (c, ld).
  void held(const double* felt, double* out) const {
    for (int a = 0; a < c; ++a) {
      for (int64_t i = 0; i < order; ++i) out[a * ld + i] = dot(inverse.data() + i * ld, felt + a * ld, ld);
      for (int64_t i = order; i < ld; ++i) out[a * ld + i] = 0;
    }
  }
  /// G between two conditioned points of which one's `felt` and the other's `held` are known.
  void green(const Vec<D>& x, const double* felt, const Vec<D>& y, const double* held, double (&G)[D][D]) const {
    kernel.at(kernel, x - y, G);
    for (int a = 0; a < c; ++a)
      for (int e = 0; e < c; ++e) G[a][e] -= dot(felt + a * ld, held + e * ld, ld);
  }

  enum Outcome { ready, no_memory, not_held };
  /// Assemble and factor L_B for anchors in mm; `kernel_for(scale)` describes the kernel in coordinates divided by a scale.
  template <class KernelFor>
  Outcome build(const Vec<D>* points, int64_t count, KernelFor kernel_for) {
    anchors = count;
    double extent = 0;
    for (int d = 0; d < D; ++d) {
      double low = INFINITY, high = -INFINITY;
      for (int64_t i = 0; i < count; ++i) low = smaller(low, points[i][d]), high = larger(high, points[i][d]);
      centre[d] = count ? 0.5 * (low + high) : 0;
      extent = larger(extent, high - low);
    }
    scale = extent > 0 ? extent / 2 : 1;
    kernel = kernel_for(scale);
    c = kernel.components, order = count * c + kernel.motions, ld = rounded_up(order, ROW),
    padded = rounded_up(count, ROW);
    for (int d = 0; d < D; ++d) {
      if (!place[d].reserve(padded)) return no_memory;
      for (int64_t i = 0; i < count; ++i) place[d][i] = conditioned(points[i])[d];
    }
    Array<int64_t> pivots;
    Array<double> row;
    if (!inverse.reserve(order * ld) || !pivots.reserve(order) || !row.reserve(c * ld) || !find_parents(points))
      return no_memory;
    for (int64_t i = 0; i < count; ++i) {
      felt(conditioned(points[i]), row.data());
      for (int a = 0; a < c; ++a) {
        std::memcpy(inverse.data() + (a * count + i) * ld, row.data() + a * ld,
                    static_cast<size_t>(order) * sizeof(double));
        for (int j = 0; j < kernel.motions; ++j)
          inverse[(count * c + j) * ld + a * count + i] = row[a * ld + count * c + j];
      }
    }
    if (!motions_determined(row)) return not_held;
    // rows as differences, too
    for (int64_t a = 0; a < c; ++a)
      for (int64_t i = count; i-- > 1;)
        add(&inverse[(a * count + i) * ld], -1, &inverse[(a * count + parent[i]) * ld], ld);
    for (int64_t j = count * c; j < order; ++j)
      for (int64_t a = 0; a < c; ++a)
        for (int64_t i = count; i-- > 1;) inverse[j * ld + a * count + i] -= inverse[j * ld + a * count + parent[i]];
    return invert(inverse.data(), order, ld, pivots.data()) ? ready : not_held;
  }

 private:
  bool find_parents(const Vec<D>* points) {
    if (!parent.reserve(anchors)) return false;
    for (int64_t i = 0; i < anchors; ++i) {
      parent[i] = -1;
      double least = INFINITY;
      for (int64_t j = 0; j < i; ++j)
        if (dot(points[i] - points[j], points[i] - points[j]) < least)
          least = dot(points[i] - points[j], points[i] - points[j]), parent[i] = static_cast<int32_t>(j);
    }
    return true;
  }
  /// Whether the anchors leave no motion free: the rows of R' are independent (Gram and Schmidt, largest first).
  bool motions_determined(Array<double>& room) {
    const int p = kernel.motions;
    const int64_t n = anchors * c, wide = rounded_up(n, ROW);
    if (n < p || !room.reserve(p * wide)) return false;
    for (int j = 0; j < p; ++j)
      for (int64_t i = 0; i < n; ++i) room[j * wide + i] = inverse[(n + j) * ld + i];
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
