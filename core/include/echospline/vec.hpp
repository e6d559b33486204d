// Points and displacements in the plane (D = 2) or in space (D = 3).
#pragma once
#include <cmath>
#include <cstdint>

#include "level_begin.hpp"

namespace echospline::ECHOSPLINE_CORE {

/// Coordinates (x lateral, y depth, z elevation), mm unless conditioned.
template <int D>
struct Vec {
  double v[D];

  double& operator[](int d) { return v[d]; }
  double operator[](int d) const { return v[d]; }
};

template <int D>
inline Vec<D> operator+(Vec<D> a, const Vec<D>& b) {
  for (int d = 0; d < D; ++d) a[d] += b[d];
  return a;
}
template <int D>
inline Vec<D> operator-(Vec<D> a, const Vec<D>& b) {
  for (int d = 0; d < D; ++d) a[d] -= b[d];
  return a;
}
template <int D>
inline Vec<D> operator*(double s, Vec<D> a) {
  for (int d = 0; d < D; ++d) a[d] *= s;
  return a;
}
template <int D>
inline double dot(const Vec<D>& a, const Vec<D>& b) {
  double s = 0;
  for (int d = 0; d < D; ++d) s += a[d] * b[d];
  return s;
}
template <int D>
inline double norm(const Vec<D>& a) {
  return std::sqrt(dot(a, a));
}
/// Part of u across a unit vector; all of it where there is no axis.
template <int D>
inline Vec<D> across(const Vec<D>& u, const Vec<D>& axis) {
  return u - dot(u, axis) * axis;
}
template <int D>
inline Vec<D> point_of(const double* p) {
  Vec<D> a;
  for (int d = 0; d < D; ++d) a[d] = p[d];
  return a;
}

}  // namespace echospline::ECHOSPLINE_CORE
