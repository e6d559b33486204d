// Closed forms of plane elasticity: the field of a force below a top that is free, slides or is clamped.
//
// The formulas, their sources and their names are those of `mechanics/half_plane.py`, which this file is compared with.
#pragma once
#include <cmath>
#include <cstdint>

#include "level_begin.hpp"
#include "vec.hpp"

namespace echospline::ECHOSPLINE_CORE {

constexpr double CIRCLE = 6.283185307179586477;  // 2 pi
constexpr double SHALLOWEST = 1.0;               // radii: least depth of a force below a free or clamped top

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
  Block displacement(const Vec<2>& p, const Vec<2>& s, double radius) const {
    const double dx = p[0] - s[0], y = p[1] - surface, c = depth(s, radius);
    double xx, yy, xy, yx;
    kelvin(dx, y - c, radius, xx, yy, xy);
    yx = xy;
    if (top == Surface::sliding) {
      double mxx, myy, mxy;
      kelvin(dx, y + c, radius, mxx, myy, mxy);
      xx += mxx, yy -= myy, xy -= mxy, yx += mxy;
    } else if (top != Surface::none) {
      image(dx, y, c, radius, xx, yy, xy, yx);
    }
    const double k = scale();
    return {{{k * xx, k * xy}, {k * yx, k * yy}}};
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
  double depth(const Vec<2>& s, double radius) const {
    const double c = s[1] - surface;
    return top == Surface::free || top == Surface::clamped ? std::fmax(c, SHALLOWEST * radius) : c;
  }

  /// A blob in the endless plane, times 8 pi mu (1 - nu).
  void kelvin(double dx, double dy, double radius, double& xx, double& yy, double& xy) const {
    const double e2 = radius * radius, inverse = 1 / (dx * dx + dy * dy + e2), x = dx * inverse;
    const double diagonal = 0.5 * (3 - 4 * nu) * std::log(inverse) + 2 * (1 - nu) * e2 * inverse;
    xx = diagonal + dx * x, yy = diagonal + dy * dy * inverse, xy = dy * x;
  }

  /// Add the image above a free or clamped top.
  void image(double dx, double y, double c, double radius, double& xx, double& yy, double& xy, double& yx) const {
    const double a = 3 - 4 * nu, Y = y + c, inverse = 1 / (dx * dx + Y * Y);
    const double x = dx * inverse, d = Y * inverse;  // 1 / w = x - i d
    const double even = x * x - d * d, odd = 2 * x * d, cy = 2 * c * y;
    double b, both, swap;
    if (top == Surface::free) {
      b = -1;
      const double log = 0.25 * (a * a + 1) * std::log(inverse);
      both = a * dx * (y - c) * inverse;
      swap = cy * odd - 4 * (1 - nu) * (1 - 2 * nu) * std::atan2(dx, Y);
      xx += log + a * dx * x - cy * even, yy += log + a * Y * d - cy * even;
    } else {
      b = a;
      const double log = -0.5 * a * std::log(inverse);
      both = -(y - c) * x, swap = -(cy / a) * odd;
      xx += log - dx * x + (cy / a) * even, yy += log - Y * d + (cy / a) * even;
    }
    xy += both + swap, yx += both - swap;
    if (radius == 0) return;
    const double share = radius * radius / (2 * b);
    const double up = 4 * y * (even * d + odd * x), side = 4 * y * (even * x - odd * d);
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
