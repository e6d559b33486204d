// Closed forms of plane elasticity: the field of a force below a top that is free, slides or is clamped.
//
// The formulas, their sources and their names are those of `mechanics/half_plane.py`, which this file is compared with.
#pragma once
#include <cmath>
#include <cstdint>

#include "kernels.hpp"
#include "level_begin.hpp"
#include "vec.hpp"

namespace echospline::ECHOSPLINE_CORE {

constexpr double CIRCLE = 6.283185307179586477;  // 2 pi
constexpr double SHALLOWEST = 1.0;               // radii: least depth of a force below a free or clamped top

/// Angle in the right half plane to 3e-16: nearest of three known ones, and the series of what is left (below tan pi / 16).
ECHOSPLINE_INLINE Doubles arctangent(Doubles t) {
  const Doubles size = greatest(t, -t), one = all(1.0);
  const Longs steep = size > one;
  const Doubles a = pick(steep, one / size, size);
  const Longs middle = a > all(0.19891236737965800691), upper = a > all(0.66817863791929891999);
  const Doubles known = pick(upper, one, pick(middle, all(0.41421356237309504880), Doubles{}));
  const Doubles angle = pick(upper, all(CIRCLE / 8), pick(middle, all(CIRCLE / 16), Doubles{}));
  const Doubles s = (a - known) / (one + a * known), z = s * s;
  Doubles p = z * (-1.0 / 23) + 1.0 / 21;
  for (int n = 19; n >= 3; n -= 2) p = p * z + (n % 4 == 1 ? 1.0 : -1.0) / n;
  const Doubles found = angle + (s + s * z * p), right = pick(steep, CIRCLE / 4 - found, found);
  return pick(t < Doubles{}, -right, right);
}
inline double arctangent(double t) { return std::atan(t); }

/// A complex number; std::complex would look for infinities in every product.
struct Complex {
  double re, im;
};
inline Complex operator+(Complex a, Complex b) { return {a.re + b.re, a.im + b.im}; }
inline Complex operator-(Complex a, Complex b) { return {a.re - b.re, a.im - b.im}; }
inline Complex operator*(Complex a, Complex b) { return {a.re * b.re - a.im * b.im, a.re * b.im + a.im * b.re}; }
inline Complex operator*(double s, Complex a) { return {s * a.re, s * a.im}; }
inline Complex conjugate(Complex a) { return {a.re, -a.im}; }

/// Displacement or traction by unit forces: [component][direction of the force].
struct Block {
  double v[2][2];
};

enum class Surface { none, free, sliding, clamped };

/// Homogeneous tissue below a straight top, or without end.
struct HalfPlane {
  double nu = 0;         ///< Poisson's ratio of the equivalent plane strain
  double stiffness = 1;  ///< shear modulus times thickness, N/mm
  Surface top = Surface::none;
  double surface = 0;  ///< depth of the top, mm

  /// 1 / (8 pi mu (1 - nu) thickness), mm/N.
  double scale() const { return 1 / (4 * CIRCLE * stiffness * (1 - nu)); }

  /// Displacement of p by unit forces at s that are spread over a radius (0: points), mm/N.
  __attribute__((noinline)) Block displacement(const Vec<2>& p, const Vec<2>& s, double radius) const {
    Block K;
    displacement(p[0] - s[0], p[1] - surface, depth(s, radius), radius, K.v);
    return K;
  }
  /// The same for one point or a lane of them: dx beside a force at depth c, y below the top.
  template <class Number>
  ECHOSPLINE_INLINE void displacement(Number dx, double y, double c, double radius, Number (&K)[2][2]) const {
    Number xx, yy, xy, yx;
    kelvin(dx, y - c, radius, xx, yy, xy);
    yx = xy;
    if (top == Surface::sliding) {
      Number mxx, myy, mxy;
      kelvin(dx, y + c, radius, mxx, myy, mxy);
      xx += mxx, yy -= myy, xy -= mxy, yx += mxy;
    } else if (top != Surface::none) {
      image(dx, y, c, radius, xx, yy, xy, yx);
    }
    const double k = scale();
    K[0][0] = k * xx, K[0][1] = k * xy, K[1][0] = k * yx, K[1][1] = k * yy;
  }
  double depth(const Vec<2>& s, double radius) const {
    const double c = s[1] - surface;
    return top == Surface::free || top == Surface::clamped ? std::fmax(c, SHALLOWEST * radius) : c;
  }

  /// Traction times thickness on a unit normal at p by unit forces at s, 1/mm.
  Block traction(const Vec<2>& p, const Vec<2>& normal, const Vec<2>& s, double radius) const {
    const double dx = p[0] - s[0], y = p[1] - surface, c = depth(s, radius);
    Block T = kelvin_traction(dx, y - c, normal, radius);
    if (top == Surface::sliding) {
      const Block mirrored = kelvin_traction(dx, y + c, normal, radius);
      for (int i = 0; i < 2; ++i) T.v[i][0] += mirrored.v[i][0], T.v[i][1] -= mirrored.v[i][1];
    } else if (top != Surface::none) {
      image_traction(dx, y, c, normal, radius, T);
    }
    return T;
  }

  /// Shift along x, shift along y and rotation that the top allows: how many of them.
  int motions() const { return top == Surface::sliding ? 1 : top == Surface::clamped ? 0 : 3; }

 private:
  /// A blob in the endless plane, times 8 pi mu (1 - nu).
  template <class Number>
  ECHOSPLINE_INLINE void kelvin(Number dx, double dy, double radius, Number& xx, Number& yy, Number& xy) const {
    const double e2 = radius * radius;
    const Number inverse = 1.0 / (dx * dx + (dy * dy + e2)), x = dx * inverse;
    const Number diagonal = (0.5 * (3 - 4 * nu)) * logarithm(inverse) + (2 * (1 - nu) * e2) * inverse;
    xx = diagonal + dx * x, yy = diagonal + (dy * dy) * inverse, xy = dy * x;
  }

  /// Add the image above a free or clamped top.
  template <class Number>
  ECHOSPLINE_INLINE void image(Number dx, double y, double c, double radius, Number& xx, Number& yy, Number& xy,
                               Number& yx) const {
    const double a = 3 - 4 * nu, Y = y + c, cy = 2 * c * y;
    const Number inverse = 1.0 / (dx * dx + Y * Y);
    const Number x = dx * inverse, d = Y * inverse;  // 1 / w = x - i d
    const Number even = x * x - d * d, odd = 2.0 * x * d;
    double b;
    Number both, swap;
    if (top == Surface::free) {
      b = -1;
      const Number log = (0.25 * (a * a + 1)) * logarithm(inverse);
      both = (a * (y - c)) * x;
      swap = cy * odd - (4 * (1 - nu) * (1 - 2 * nu)) * arctangent(dx * (1 / Y));
      xx += log + a * dx * x - cy * even, yy += log + (a * Y) * d - cy * even;
    } else {
      b = a;
      const Number log = (-0.5 * a) * logarithm(inverse);
      both = (c - y) * x, swap = (-cy / a) * odd;
      xx += log - dx * x + (cy / a) * even, yy += log - Y * d + (cy / a) * even;
    }
    xy += both + swap, yx += both - swap;
    if (radius == 0) return;
    const double share = radius * radius / (2 * b);
    const Number up = (4 * y) * (even * d + odd * x), side = (4 * y) * (even * x - odd * d);
    xx += share * (a * even - up), yy -= share * (a * even + up);
    xy -= share * (a * odd + side), yx -= share * (a * odd - side);
  }

  Block kelvin_traction(double dx, double dy, const Vec<2>& n, double radius) const {
    const double e2 = radius * radius, d[2] = {dx, dy}, q = 1 / (dx * dx + dy * dy + e2);
    const double along = -(3 - 4 * nu) * q - 4 * (1 - nu) * e2 * q * q;
    const double lam = 2 * nu / (1 - 2 * nu);  // over mu
    const double volume = 2 * q + lam * (along + q + 2 * e2 * q * q), dn = d[0] * n[0] + d[1] * n[1];
    const double k = scale() * stiffness;
    Block T;
    for (int i = 0; i < 2; ++i)
      for (int j = 0; j < 2; ++j) {
        double t = (along + q) * n[j] * d[i] + volume * n[i] * d[j] - 4 * q * q * dn * d[i] * d[j];
        if (i == j) t += (along + q) * dn;
        T.v[i][j] = k * t;
      }
    return T;
  }

  void image_traction(double dx, double y, double c, const Vec<2>& normal, double radius, Block& T) const {
    const double a = 3 - 4 * nu, e2 = radius * radius, b = top == Surface::free ? -1 : a;
    const double per = 1 / (CIRCLE * (1 + a)), Y = y + c, size = 1 / (dx * dx + Y * Y);
    const Complex n = {normal[0], normal[1]}, w = {dx * size, -Y * size}, w2 = w * w, w3 = w2 * w, w4 = w2 * w2;
    for (int j = 0; j < 2; ++j) {
      const Complex F = j == 0 ? Complex{1, 0} : Complex{0, 1}, G = conjugate(F);
      const Complex first = (1 / b) * (a * (F * w) - Complex{0, 2 * c} * G * w2 - 2 * e2 * (G * w3));
      const Complex second = (1 / b) * (Complex{0, 4 * c} * G * w3 + 6 * e2 * (G * w4) - a * (F * w2));
      const Complex t =
          2 * first.re * n +
          (conjugate(first) + b * (F * conjugate(w)) - Complex{0, 2 * y} * conjugate(second)) * conjugate(n);
      T.v[0][j] += per * t.re, T.v[1][j] += per * t.im;
    }
  }
};

}  // namespace echospline::ECHOSPLINE_CORE
