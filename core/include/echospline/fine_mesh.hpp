// A node per pixel: the field of a landmark spline on a fine plane mesh from a coarse one.
//
// Far from its landmarks a spline is smooth, so cubic interpolation between the points of a coarse mesh carries it. Near a
// landmark the kernel is not, and the error there is that landmark's weight times the kernel less its own interpolant: both are evaluated
// within a few coarse cells of every landmark and added. Nothing of the size (pixels x landmarks) is read.
#pragma once
#include "grid.hpp"
#include "kernels.hpp"

namespace echospline::ECHOSPLINE_CORE {

constexpr int32_t CELLS = 96;  // coarse cells along an edge of the mesh, at most
constexpr int32_t REACH = 4;   // coarse cells around a landmark within which its kernel is corrected

/// Every few nodes of a plane mesh, one more before the first and two more after the last, for the cubic.
template <int D>
struct CoarseGrid {
  int32_t stride[D];
  Grid<D> grid;

  void build(const Grid<D>& fine) {
    for (int d = 0; d < D; ++d) {
      stride[d] = larger<int32_t>(1, (fine.shape[d] - 1 + CELLS - 1) / CELLS);
      grid.shape[d] = (fine.shape[d] - 1 + stride[d] - 1) / stride[d] + 4;
      grid.spacing[d] = fine.spacing[d] * stride[d];
      grid.origin[d] = fine.origin[d] - grid.spacing[d];
    }
  }
};

template <int D, class Real>
struct Planes;

/// The field on the fine mesh, computed when it is asked for.
template <class Kernel, class Real>
class FineField {
 public:
  static constexpr int D = 2, planes = Kernel::scalar ? 1 : D;
  static constexpr int SIDE = 2 * REACH + 4;  // coarse points along a side of the region around a landmark

  Planes<D, Real> field;  ///< (ny, nx) per component, mm

  bool build(const Grid<D>& fine, const CoarseGrid<D>& coarse) {
    fine_ = fine, coarse_ = coarse;
    const int64_t wide = rounded_up(larger<int64_t>(fine.shape[0], (2 * REACH + 1) * coarse.stride[0]), 64);
    return field.reserve(fine.size()) && taps_[0].reserve(coarse.stride[0]) && taps_[1].reserve(coarse.stride[1]) &&
           rows_.reserve(SIDE * planes * wide + 4 * D * wide) && fill_taps(wide);
  }

  /// Interpolate the field at the coarse points; `correct` adds what that leaves out of every landmark's.
  void compute(const Real* coarse_x, const Real* coarse_y) {
    interpolate(coarse_x, 0);
    interpolate(coarse_y, 1);
  }

  /// Add what interpolation leaves out of one landmark's field.
  void correct(const Real* place, const Real* weight, const Kernel& kernel, const Vec<D>& centre, double scale) {
    const Grid<D>& coarse = coarse_.grid;
    const int64_t nx = fine_.shape[0], ny = fine_.shape[1];
    double at[D], step[D], first[D];
    int64_t cell[D], begin[D], end[D];
    for (int d = 0; d < D; ++d) {
      at[d] = place[d] * scale + centre[d];
      cell[d] = static_cast<int64_t>(std::floor((at[d] - coarse.origin[d]) / coarse.spacing[d]));
      begin[d] = larger<int64_t>(0, (cell[d] - 1 - REACH) * coarse_.stride[d]);
      end[d] = smaller<int64_t>(d == 0 ? nx : ny, (cell[d] + REACH) * coarse_.stride[d]);
      if (begin[d] >= end[d]) return;
      step[d] = fine_.spacing[d] / scale;
      first[d] = (fine_.origin[d] - at[d]) / scale;
    }
    // fine place f lies in the coarse cell that begins with coarse point f / stride + 1
    const int64_t x0 = begin[0] / coarse_.stride[0] * coarse_.stride[0], count = end[0] - x0;
    const int64_t j0 = begin[1] / coarse_.stride[1], j1 = (end[1] - 1) / coarse_.stride[1] + 4;
    Real* interpolated = rows_.data();
    for (int64_t j = j0; j < j1; ++j) {
      Real row[planes][SIDE + 4];
      const double y = first[1] + static_cast<double>(j - 1) * coarse_.stride[1] * step[1];
      const int64_t points = (count - 1) / coarse_.stride[0] + 4;
      for (int64_t i = 0; i < points; i += Lanes<Real>::count) {
        Vector<Real> offset[D] = {}, f[planes];
        for (int l = 0; l < Lanes<Real>::count; ++l)
          offset[0][l] =
              static_cast<Real>(first[0] + (x0 + static_cast<double>(i + l - 1) * coarse_.stride[0]) * step[0]);
        offset[1] = all<Real>(static_cast<Real>(y));
        response(kernel, offset, weight, f);
        for (int d = 0; d < planes; ++d)
          for (int l = 0; l < smaller<int64_t>(Lanes<Real>::count, points - i); ++l) row[d][i + l] = f[d][l];
      }
      for (int d = 0; d < planes; ++d) along_x(row[d], count, interpolated + ((j - j0) * planes + d) * wide_);
    }
    Real* sum = rows_.data() + SIDE * planes * wide_;
    for (int64_t y = begin[1]; y < end[1]; ++y) {
      const int64_t j = y / coarse_.stride[1] - j0;
      for (int d = 0; d < planes; ++d) {
        const Real* const row[4] = {
            interpolated + (j * planes + d) * wide_, interpolated + ((j + 1) * planes + d) * wide_,
            interpolated + ((j + 2) * planes + d) * wide_, interpolated + ((j + 3) * planes + d) * wide_};
        along_y(taps_[1][y % coarse_.stride[1]], row, count, sum + d * wide_);
      }
      Vector<Real> offset[D] = {}, f[planes];
      offset[1] = all<Real>(static_cast<Real>(first[1] + static_cast<double>(y) * step[1]));
      for (int64_t x = 0; x < count; x += Lanes<Real>::count) {
        const Real start = static_cast<Real>(first[0] + static_cast<double>(x0 + x) * step[0]);
        for (int l = 0; l < Lanes<Real>::count; ++l)
          offset[0][l] = start + static_cast<Real>(l) * static_cast<Real>(step[0]);
        response(kernel, offset, weight, f);
        for (int d = 0; d < planes; ++d) store(sum + d * wide_ + x, f[d] - load(sum + d * wide_ + x));
      }
      for (int d = 0; d < D; ++d) {
        Real* out = field.u[d].data() + y * nx + x0;
        const Real* rest = sum + (Kernel::scalar ? 0 : d) * wide_;
        const Real factor = Kernel::scalar ? weight[d] : Real(1);
        for (int64_t x = begin[0] - x0; x < count; ++x) out[x] += factor * rest[x];
      }
    }
  }

 private:
  struct Taps {
    Real w[4];
  };
  Grid<D> fine_;
  CoarseGrid<D> coarse_;
  Array<Taps>
      taps_[D];  ///< weights of the four coarse points around each place in a coarse cell (Lagrange, exact for cubics)
  Array<Real> rows_;
  int64_t wide_ = 0;

  bool fill_taps(int64_t wide) {
    wide_ = wide;
    for (int d = 0; d < D; ++d)
      for (int32_t i = 0; i < coarse_.stride[d]; ++i) {
        const double t = static_cast<double>(i) / coarse_.stride[d];
        taps_[d][i] = {{static_cast<Real>(-t * (t - 1) * (t - 2) / 6),
                        static_cast<Real>((t + 1) * (t - 1) * (t - 2) / 2),
                        static_cast<Real>(-(t + 1) * t * (t - 2) / 2), static_cast<Real>((t + 1) * t * (t - 1) / 6)}};
      }
    return true;
  }

  /// Cubic along x of a coarse row at `count` fine places, the first of them at the second coarse point.
  void along_x(const Real* row, int64_t count, Real* out) const {
    const int32_t stride = coarse_.stride[0];
    for (int64_t x = 0; x < count; x += stride, ++row)
      for (int32_t i = 0; i < smaller<int64_t>(stride, count - x); ++i) {
        const Taps& t = taps_[0][i];
        out[x + i] = t.w[0] * row[0] + t.w[1] * row[1] + t.w[2] * row[2] + t.w[3] * row[3];
      }
  }
  static void along_y(const Taps& t, const Real* const (&row)[4], int64_t count, Real* out) {
    for (int64_t x = 0; x < count; ++x)
      out[x] = t.w[0] * row[0][x] + t.w[1] * row[1][x] + t.w[2] * row[2][x] + t.w[3] * row[3][x];
  }

  void interpolate(const Real* coarse_field, int d) {
    const int64_t nx = fine_.shape[0], ny = fine_.shape[1], mx = coarse_.grid.shape[0];
    int64_t next = 0;  // coarse rows that have been interpolated along x are kept in a ring of four
    for (int64_t y = 0; y < ny; ++y) {
      const int64_t j = y / coarse_.stride[1];
      for (; next < j + 4; ++next) along_x(coarse_field + next * mx, nx, rows_.data() + next % 4 * wide_);
      const Real* const row[4] = {rows_.data() + j % 4 * wide_, rows_.data() + (j + 1) % 4 * wide_,
                                  rows_.data() + (j + 2) % 4 * wide_, rows_.data() + (j + 3) % 4 * wide_};
      along_y(taps_[1][y % coarse_.stride[1]], row, nx, field.u[d].data() + y * nx);
    }
  }

  /// Kernel times weight at an offset.
  template <class Number>
  ECHOSPLINE_INLINE static void response(const Kernel& kernel, const Number (&offset)[D], const Real* weight,
                                         Number (&f)[planes]) {
    Number U[planes][planes];
    kernel.at(offset, U);
    for (int d = 0; d < planes; ++d) {
      if constexpr (Kernel::scalar)
        f[d] = U[0][0];
      else
        f[d] = U[d][0] * weight[0] + U[d][1] * weight[1];
    }
  }
};

}  // namespace echospline::ECHOSPLINE_CORE
