// Kernels of landmark splines: the field at an offset from a unit weight. Their constants make every kernel positive definite beside held
// anchors, and 16 pi (8 pi for the thin plate in space) times the fundamental solution, so that a spring of stiffness k adds that over k.
#pragma once
#include <cmath>
#include <type_traits>

#include "lanes.hpp"
#include "vec.hpp"

namespace echospline::ECHOSPLINE_CORE {

constexpr double PI = 3.14159265358979323846;

ECHOSPLINE_INLINE double logarithm(double x) { return x > 0 ? std::log(x) : 0.0; }
ECHOSPLINE_INLINE double root(double x) { return std::sqrt(x); }
ECHOSPLINE_INLINE double inverse_root(double x) { return 1 / std::sqrt(x); }

/// U(r) = r^2 ln r^2 in the plane, equation (3), and -r in space; one scalar serves all components, with the affine motions of equation (5).
template <int D>
struct ThinPlate {
  static constexpr int components = 1;
  static constexpr bool scalar = true;                 ///< one number at an offset serves all components
  static constexpr int motions = D + 1;                ///< polynomials
  static constexpr int length_power = D == 2 ? 2 : 1;  ///< of the kernel's values
  static constexpr double per_spring = D == 2 ? 16 * PI : 8 * PI;

  static ThinPlate from(double, double) { return {}; }

  /// U at an offset, for a scalar or a vector of numbers.
  template <class Number>
  ECHOSPLINE_INLINE void at(const Number (&offset)[D], Number (&U)[1][1]) const {
    Number r2 = offset[0] * offset[0];
    for (int d = 1; d < D; ++d) r2 += offset[d] * offset[d];
    if constexpr (D == 2)
      U[0][0] = r2 * logarithm(r2);
    else
      U[0][0] = -root(r2);
  }
  /// Add U at an offset times a weight.
  template <class Number, class Real>
  ECHOSPLINE_INLINE void respond(const Number (&offset)[D], const Real* weight, Number (&u)[D]) const {
    Number U[1][1];
    at(offset, U);
    for (int d = 0; d < D; ++d) u[d] += weight[d] * U[0][0];
  }
  /// U at squared distance r2 less U at other2 in the plane, single precision; `less` is the difference of the two. Accurate to the last digits of the difference, where each U is much larger.
  template <class Number>
  ECHOSPLINE_INLINE static Number difference(const Number& r2, const Number& other2, const Number& less) {
    // r2 ln r2 - other2 ln other2 = less ln r2 + other2 ln(r2 / other2), the last logarithm by its series where the ratio is near 1
    const Number s = less / (r2 + other2 + 1e-30f), z = s * s;
    const Number series = s * (2.0f + z * (0.66666667f + z * (0.4f + z * (0.28571429f + z * 0.22222222f))));
    const Number own = logarithm(r2), ratio = pick(z < 0.04f, series, own - logarithm(other2));
    return less * own + other2 * ratio;
  }
  /// Row (1, x, y[, z]) of R at a point.
  static void motion(const Vec<D>& x, double (&R)[1][motions]) {
    R[0][0] = 1;
    for (int d = 0; d < D; ++d) R[0][d + 1] = x[d];
  }
};

/// A thin plate per component of the displacement, each with anchors of its own: for scenes with sliding edges.
template <int D>
struct PlatesApart : ThinPlate<D> {
  static constexpr int components = D;

  static PlatesApart from(double, double) { return {}; }
};

/// Regularised fundamental solution of elasticity (Kelvin): a matrix couples the components, with the rigid motions. In the plane
/// -(lap(phi) I - c grad grad(phi)) with phi = s ln s, s = r^2 + radius^2, c = 1 / (2 (1 - nu)) and nu / (1 + nu) for nu in plane stress
/// (Davis et al. 1997); in space the regularised Kelvinlet (de Goes and James 2017).
template <int D>
struct Elastic {
  static constexpr int components = D;
  static constexpr bool scalar = false;
  static constexpr int motions = D == 2 ? 3 : 6;
  static constexpr int length_power = D == 2 ? 0 : -1;
  static constexpr double per_spring = 16 * PI;

  double coupling;  ///< c in the plane, 1 / (1 - nu) in space
  double radius2;   ///< square of the regularisation length, in the coordinates of the offsets

  static Elastic from(double coupling, double radius2) { return {coupling, radius2}; }

  template <class Number>
  ECHOSPLINE_INLINE void at(const Number (&offset)[D], Number (&U)[D][D]) const {
    Number own, both;
    parts(offset, own, both);
    for (int a = 0; a < D; ++a)
      for (int b = 0; b < D; ++b) {
        U[a][b] = both * offset[a] * offset[b];
        if (a == b) U[a][b] += own;
      }
  }
  /// Add U at an offset times a weight.
  template <class Number, class Real>
  ECHOSPLINE_INLINE void respond(const Number (&offset)[D], const Real* weight, Number (&u)[D]) const {
    Number own, both, along = weight[0] * offset[0];
    parts(offset, own, both);
    for (int d = 1; d < D; ++d) along += weight[d] * offset[d];
    along *= both;
    for (int d = 0; d < D; ++d) u[d] += own * weight[d] + along * offset[d];
  }
  /// Rigid motions at a point: shifts, then rotations.
  static void motion(const Vec<D>& x, double (&R)[D][motions]) {
    for (int a = 0; a < D; ++a)
      for (int j = 0; j < motions; ++j) R[a][j] = a == j ? 1 : 0;
    if constexpr (D == 2) {
      R[0][2] = -x[1], R[1][2] = x[0];
    } else {
      R[0][3] = -x[1], R[1][3] = x[0];  // about z
      R[1][4] = -x[2], R[2][4] = x[1];  // about x
      R[2][5] = -x[0], R[0][5] = x[2];  // about y
    }
  }

 private:
  /// What stands before the unit matrix and before x x' in U at an offset x.
  template <class Number>
  ECHOSPLINE_INLINE void parts(const Number (&offset)[D], Number& own, Number& both) const {
    typedef std::remove_cvref_t<decltype(entry(offset[0]))> Real;
    const Real c = static_cast<Real>(coupling), e2 = static_cast<Real>(radius2);
    Number r2 = offset[0] * offset[0];
    for (int d = 1; d < D; ++d) r2 += offset[d] * offset[d];
    const Number s = r2 + e2;
    if constexpr (D == 2) {
      const Number per = Real(1) / s;
      own = (Real(2) * c - Real(4)) * (logarithm(s) + Real(1)) - Real(4) * r2 * per, both = Real(4) * c * per;
    } else {
      const Number p = inverse_root(s), p3 = p * p * p;  // 1 / r_e, 1 / r_e^3
      own = p3 * ((Real(4) - c) * s + Real(2) * e2), both = c * p3;
    }
  }
  static float entry(Floats);
  static double entry(Doubles);
  static double entry(double);
};

/// A kernel as the algebra of landmarks sees it, which is the same for all: numbers and functions in double precision.
template <int D>
struct KernelOf {
  int components;            ///< c
  bool apart;                ///< components do not act on one another: each has a system of its own
  bool affine;               ///< every affine motion is free of energy; otherwise the rigid ones
  int motions;               ///< polynomials, of each system
  int length_power;          ///< of the kernel's values
  double per_spring;         ///< what a spring of stiffness k adds, times k
  double coupling, radius2;  ///< as `from` takes them
  void (*at)(const KernelOf& own, const Vec<D>& offset, double (&U)[D][D]);
  /// Field at x of component e at `count` places: a row of `count` numbers per component of the field, `stride` from one to the next.
  /// Where components are apart, row e alone is written.
  void (*along)(const KernelOf& own, int e, const Vec<D>& x, const double* const (&place)[D], int64_t count,
                double* out, int64_t stride);
  void (*motion)(const Vec<D>& x, double* out, int64_t stride);  ///< (c, motions); one row where components are apart
};

template <int D, class Kernel>
struct KernelFunctions {
  static constexpr int c = Kernel::components, rows = Kernel::scalar ? 1 : c;  ///< rows of the kernel's own matrix
  static void at(const KernelOf<D>& own, const Vec<D>& offset, double (&U)[D][D]) {
    double small[rows][rows];
    Kernel::from(own.coupling, own.radius2).at(offset.v, small);
    for (int a = 0; a < c; ++a)
      for (int e = 0; e < c; ++e) U[a][e] = !Kernel::scalar ? small[a % rows][e % rows] : a == e ? small[0][0] : 0;
  }
  static void along(const KernelOf<D>& own, int e, const Vec<D>& x, const double* const (&place)[D], int64_t count,
                    double* out, int64_t stride) {
    const Kernel kernel = Kernel::from(own.coupling, own.radius2);
    for (int64_t i = 0; i < count; i += DOUBLE_LANES) {
      Doubles offset[D], U[rows][rows];
      for (int d = 0; d < D; ++d) offset[d] = x[d] - load(place[d] + i);
      kernel.at(offset, U);
      for (int a = 0; a < rows; ++a) {
        double* row = out + (Kernel::scalar ? e : a) * stride;
        for (int64_t l = 0; l < smaller<int64_t>(DOUBLE_LANES, count - i); ++l)
          row[i + l] = U[a][Kernel::scalar ? 0 : e][l];
      }
    }
  }
  static void motion(const Vec<D>& x, double* out, int64_t stride) {
    double R[rows][Kernel::motions];
    Kernel::motion(x, R);
    for (int a = 0; a < rows; ++a)
      for (int j = 0; j < Kernel::motions; ++j) out[a * stride + j] = R[a][j];
  }
};

/// The description of a kernel for coordinates in which `coupling` and `radius2` hold.
template <int D, class Kernel>
KernelOf<D> kernel_of(double coupling, double radius2) {
  typedef KernelFunctions<D, Kernel> Functions;
  return {Kernel::components,
          Kernel::scalar && Kernel::components > 1,
          Kernel::scalar,
          Kernel::motions,
          Kernel::length_power,
          Kernel::per_spring,
          coupling,
          radius2,
          Functions::at,
          Functions::along,
          Functions::motion};
}

}  // namespace echospline::ECHOSPLINE_CORE
