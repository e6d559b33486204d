// Where deformed places come from: X + u(X) = p on the lattice of a picture's pixels, and whether tissue folds there.
//
// Two steps of the fixed point X = p - u(X) everywhere, then Newton's method where a place is not close enough, which is near the
// needle. The gradient is that of central differences.
#pragma once
#include <cmath>
#include <cstdint>

#include "array.hpp"
#include "level_begin.hpp"

namespace echospline::ECHOSPLINE_CORE {

constexpr int MOST_NEWTON_STEPS = 30;
constexpr double DIFFERENCE = 1e-2;       // mm; half the distance over which a gradient is taken
constexpr double LONGEST_STEP = 0.5;      // mm; folds throw Newton far
constexpr double LEAST_JACOBIAN = 1e-6;   // below it a step of the fixed point is made instead
constexpr double FOLDS_AROUND_TIP = 4.0;  // mm; beyond, no needle folds tissue

/// What was found of a lattice.
struct Traced {
  double residual = 0;         // largest distance midway between places from the forward map of the origin there, mm
  int64_t folded = 0;          // places at which tissue is turned inside out, or to which none leads
  double jacobian = INFINITY;  // smallest there
  double place[3] = {0, 0, 0};
};

inline double determinant(const double (&J)[3][3]) {
  return J[0][0] * (J[1][1] * J[2][2] - J[1][2] * J[2][1]) - J[0][1] * (J[1][0] * J[2][2] - J[1][2] * J[2][0]) +
         J[0][2] * (J[1][0] * J[2][1] - J[1][1] * J[2][0]);
}

/// Traces places back; memory is reserved by `reserve`. A field is called as field(points, count, displacement), (count, 3) mm both.
class Tracer {
 public:
  bool reserve(int64_t places) {
    return (places <= room_) || (missed_.reserve(places) && jacobian_.reserve(places) && miss_.reserve(3 * places) &&
                                 active_.reserve(places) && near_.reserve(18 * places) && moved_.reserve(18 * places) &&
                                 ((room_ = places) > 0));
  }

  /// Origins X (rows, columns, 3) of places p. `inside(X)` says whether tissue is shown there; tip may be nullptr.
  template <class Field, class Inside>
  Traced trace(const Field& field, const Inside& inside, const double* p, int64_t columns, int64_t rows, double close,
               const double* tip, double* X) {
    const int64_t n = columns * rows;
    origins(field, p, n, close, X);
    Traced found;
    found.residual = residual(field, inside, p, columns, rows, X);
    if (tip) {
      int64_t count = 0;
      for (int64_t i = 0; i < n; ++i)
        if (distance(X + 3 * i, tip) < FOLDS_AROUND_TIP) active_[count++] = i;
      gradients(field, X, count);
      for (int64_t k = 0; k < count; ++k) {
        double J[3][3];
        jacobian_at(k, count, J);
        jacobian_[active_[k]] = determinant(J);
      }
    }
    for (int64_t i = 0; i < n; ++i) {
      if (!((jacobian_[i] <= 0 || missed_[i] > close) && inside(X + 3 * i))) continue;
      ++found.folded;
      if (!(jacobian_[i] < found.jacobian)) continue;
      found.jacobian = jacobian_[i];
      for (int k = 0; k < 3; ++k) found.place[k] = X[3 * i + k];
    }
    return found;
  }

 private:
  int64_t room_ = 0;
  Array<double> missed_, jacobian_, miss_, near_, moved_;
  Array<int64_t> active_;

  static double distance(const double* a, const double* b) {
    return std::sqrt((a[0] - b[0]) * (a[0] - b[0]) + (a[1] - b[1]) * (a[1] - b[1]) + (a[2] - b[2]) * (a[2] - b[2]));
  }

  template <class Field>
  void origins(const Field& field, const double* p, int64_t n, double close, double* X) {
    double* miss = miss_.data();
    field(p, n, miss);
    for (int64_t i = 0; i < 3 * n; ++i) X[i] = p[i] - miss[i];
    field(X, n, miss);
    int64_t count = 0;
    for (int64_t i = 0; i < n; ++i) {
      double* m = miss + 3 * i;
      for (int k = 0; k < 3; ++k) m[k] += X[3 * i + k] - p[3 * i + k];
      missed_[i] = std::sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2]), jacobian_[i] = 1;
      for (int k = 0; k < 3; ++k)
        X[3 * i + k] -= m[k];  // a second step, without a third look where the first miss was small
      if (missed_[i] > close) active_[count++] = i;
    }
    for (int step = 0; count > 0; ++step) {
      look(field, p, X, count);
      int64_t left = 0;
      for (int64_t k = 0; k < count; ++k)
        if (missed_[active_[k]] > close) active_[left++] = active_[k];
      count = left;
      if (step == MOST_NEWTON_STEPS) break;
      gradients(field, X, count);
      for (int64_t k = 0; k < count; ++k) improve(k, count, X);
    }
  }

  /// Miss of the active places.
  template <class Field>
  void look(const Field& field, const double* p, const double* X, int64_t count) {
    double *at = near_.data(), *moved = moved_.data();
    for (int64_t k = 0; k < count; ++k)
      for (int d = 0; d < 3; ++d) at[3 * k + d] = X[3 * active_[k] + d];
    field(at, count, moved);
    for (int64_t k = 0; k < count; ++k) {
      const int64_t i = active_[k];
      double* m = &miss_[3 * i];
      for (int d = 0; d < 3; ++d) m[d] = at[3 * k + d] + moved[3 * k + d] - p[3 * i + d];
      missed_[i] = std::sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2]);
    }
  }

  /// Displacement around the active places, to either side along every axis.
  template <class Field>
  void gradients(const Field& field, const double* X, int64_t count) {
    for (int side = 0; side < 6; ++side)
      for (int64_t k = 0; k < count; ++k)
        for (int d = 0; d < 3; ++d)
          near_[3 * (side * count + k) + d] =
              X[3 * active_[k] + d] + (side / 2 == d ? (side % 2 ? -DIFFERENCE : DIFFERENCE) : 0);
    if (count > 0) field(near_.data(), 6 * count, moved_.data());
  }
  void jacobian_at(int64_t k, int64_t count, double (&J)[3][3]) const {
    for (int c = 0; c < 3; ++c)
      for (int d = 0; d < 3; ++d)
        J[c][d] = (c == d) +
                  (moved_[3 * (2 * d * count + k) + c] - moved_[3 * ((2 * d + 1) * count + k) + c]) / (2 * DIFFERENCE);
  }

  /// One step of Newton's method for an active place.
  void improve(int64_t k, int64_t count, double* X) {
    const int64_t i = active_[k];
    double J[3][3];
    jacobian_at(k, count, J);
    const double det = jacobian_[i] = determinant(J);
    const double* m = &miss_[3 * i];
    double step[3] = {-m[0], -m[1], -m[2]};
    if (std::fabs(det) > LEAST_JACOBIAN)
      for (int c = 0; c < 3; ++c) {  // Cramer's rule
        double other[3][3];
        for (int r = 0; r < 3; ++r)
          for (int d = 0; d < 3; ++d) other[r][d] = d == c ? -m[r] : J[r][d];
        step[c] = determinant(other) / det;
      }
    const double length = std::sqrt(step[0] * step[0] + step[1] * step[1] + step[2] * step[2]);
    const double share = length > LONGEST_STEP ? LONGEST_STEP / length : 1;
    for (int d = 0; d < 3; ++d) X[3 * i + d] += share * step[d];
  }

  /// Largest miss midway between four places, where tissue is shown, mm.
  template <class Field, class Inside>
  double residual(const Field& field, const Inside& inside, const double* p, int64_t columns, int64_t rows,
                  const double* X) {
    double *at = near_.data(), *aim = at + 3 * room_, *moved = moved_.data();
    int64_t count = 0;
    for (int64_t r = 0; r + 1 < rows; ++r)
      for (int64_t c = 0; c + 1 < columns; ++c) {
        const int64_t i = 3 * (r * columns + c), right = i + 3, below = i + 3 * columns;
        for (int d = 0; d < 3; ++d) {
          at[3 * count + d] = (X[i + d] + X[right + d] + X[below + d] + X[below + 3 + d]) / 4;
          aim[3 * count + d] = (p[i + d] + p[right + d] + p[below + d] + p[below + 3 + d]) / 4;
        }
        if (inside(at + 3 * count)) ++count;
      }
    if (count > 0) field(at, count, moved);
    double worst = 0;
    for (int64_t k = 0; k < count; ++k) {
      double square = 0;
      for (int d = 0; d < 3; ++d) {
        const double gap = at[3 * k + d] + moved[3 * k + d] - aim[3 * k + d];
        square += gap * gap;
      }
      worst = std::fmax(worst, square);
    }
    return std::sqrt(worst);
  }
};

}  // namespace echospline::ECHOSPLINE_CORE
