// Displacement of elastic space or half space by many point forces, at many points: the sum of Kelvinlets and of their images.
//
// x lateral, y depth (the surface is y = 0), z elevation. For a force f at depth c, spread over a radius e (de Goes and James 2017): d the
// distance from the source, D that from its mirror image, a = 3 - 4 nu, times 1 / (16 pi mu (1 - nu)):
//   u = [a / R + 2 (1 - nu) e^2 / R^3] f + d (d . f) / R^3,   R^2 = |d|^2 + e^2,
// and where the surface slides the same of the mirrored force, where it is free Mindlin's image (1936), which is not spread.
#pragma once
#include "array.hpp"
#include "lanes.hpp"

namespace echospline::ECHOSPLINE_CORE {

/// What the surface y = 0 is.
enum class Top { none, free, sliding };

/// A point force in single precision.
struct PointForce {
  float x, y, z;     // place, mm
  float fx, fy, fz;  // force times 1 / (16 pi mu (1 - nu)), mm^2
  float spread;      // radius squared, mm^2
};

/// Sum at a vector of points.
struct Sum3 {
  Floats x{}, y{}, z{};
};

ECHOSPLINE_INLINE void add_kelvinlet(Sum3& u, Floats dx, Floats dy, Floats dz, float fx, float fy, float fz,
                                     float spread, float a, float b) {
  const Floats i1 = inverse_root(dx * dx + dy * dy + dz * dz + spread), i2 = i1 * i1, i3 = i1 * i2;
  const Floats direct = a * i1 + (b * spread) * i3, along = (dx * fx + dy * fy + dz * fz) * i3;
  u.x += direct * fx + dx * along;
  u.y += direct * fy + dy * along;
  u.z += direct * fz + dz * along;
}

/// Mindlin's image: R the distance from the mirrored source, Y the depth below it, q = 1 / (R + Y), h the part along the surface.
ECHOSPLINE_INLINE void add_mindlin(Sum3& u, Floats dx, Floats dy, Floats dz, Floats y, const PointForce& f, float a,
                                   float nu) {
  const float c = f.y, k = 4.0f * (1.0f - nu) * (1.0f - 2.0f * nu), b = 8.0f * (1.0f - nu) * (1.0f - nu) - a;
  const Floats Y = y + c, R2 = dx * dx + Y * Y + dz * dz;
  const Floats j1 = inverse_root(R2), j2 = j1 * j1, j3 = j1 * j2, j5 = j3 * j2;
  const Floats q = 1.0f / (R2 * j1 + Y), cy = c * y;
  const Floats A = j1 + 2.0f * cy * j3 + k * q;
  const Floats B = a * j3 - 6.0f * cy * j5 - k * j1 * q * q;
  const Floats s = a * dy * j3, t = 6.0f * cy * Y * j5 - k * j1 * q;
  const Floats hf = dx * f.fx + dz * f.fz, side = B * hf + (s + t) * f.fy;
  u.x += A * f.fx + dx * side;
  u.z += A * f.fz + dz * side;
  u.y += hf * (s - t) + f.fy * (b * j1 + (a * Y * Y - 2.0f * cy) * j3 + 6.0f * cy * Y * Y * j5);
}

template <Top TOP>
inline void add_forces(const PointForce* forces, int64_t count, float nu, Floats x, Floats y, Floats z, Sum3& u) {
  const float a = 3.0f - 4.0f * nu, b = 2.0f * (1.0f - nu);
  for (int64_t j = 0; j < count; ++j) {
    const PointForce& f = forces[j];
    const Floats dx = x - f.x, dy = y - f.y, dz = z - f.z;
    add_kelvinlet(u, dx, dy, dz, f.fx, f.fy, f.fz, f.spread, a, b);
    if constexpr (TOP == Top::sliding) add_kelvinlet(u, dx, y + f.y, dz, f.fx, -f.fy, f.fz, f.spread, a, b);
    if constexpr (TOP == Top::free) add_mindlin(u, dx, dy, dz, y, f, a, nu);
  }
}

/// A smooth displacement on a lattice, between its points by cubic convolution (R. G. Keys, IEEE Trans. ASSP 29, 1981).
struct SmoothLattice {
  const double* values;  // (nz, ny, nx, 3) mm
  int32_t shape[3];
  double per_mm[3], origin[3];

  /// Add the displacement at a point; beyond the lattice its outermost cells go on.
  void add(const double* point, double* u) const {
    int first[3];
    double weights[3][4];
    for (int k = 0; k < 3; ++k) {
      const double index = (point[k] - origin[k]) * per_mm[k];
      const int cell = static_cast<int>(smaller(larger(index, 1.0), shape[k] - 3.0));
      const double t = smaller(larger(index - cell, -1.0), 2.0);
      first[k] = cell - 1;
      weights[k][0] = ((-0.5 * t + 1.0) * t - 0.5) * t;
      weights[k][1] = (1.5 * t - 2.5) * t * t + 1.0;
      weights[k][2] = ((-1.5 * t + 2.0) * t + 0.5) * t;
      weights[k][3] = (0.5 * t - 0.5) * t * t;
    }
    Doubles4 sum[3] = {};  // twelve numbers of a row: four points along x, three components each
    for (int z = 0; z < 4; ++z)
      for (int y = 0; y < 4; ++y) {
        const double across = weights[2][z] * weights[1][y];
        const double* row = values + 3 * ((int64_t(first[2] + z) * shape[1] + first[1] + y) * shape[0] + first[0]);
        for (int k = 0; k < 3; ++k) {
          Doubles4 four;
          std::memcpy(&four, row + 4 * k, sizeof four);
          sum[k] += across * four;
        }
      }
    for (int k = 0; k < 12; ++k) u[k % 3] += weights[0][k / 3] * sum[k / 4][k % 4];
  }
};

/// Displacement of tissue by point forces and a smooth remainder, at any points; above a surface it goes on as it is there.
struct SpaceField {
  const PointForce* forces = nullptr;
  int64_t count = 0;
  float poisson = 0;
  Top top = Top::none;
  const SmoothLattice* smooth = nullptr;

  /// Displacement (n, 3) at points (n, 3), mm.
  void operator()(const double* points, int64_t n, double* out) const {
    if (top == Top::free)
      sum<Top::free>(points, n, out);
    else if (top == Top::sliding)
      sum<Top::sliding>(points, n, out);
    else
      sum<Top::none>(points, n, out);
  }

 private:
  template <Top TOP>
  void sum(const double* points, int64_t n, double* out) const {
    for (int64_t first = 0; first < n; first += LANES) {
      const int here = static_cast<int>(smaller<int64_t>(LANES, n - first));
      double below[3 * LANES];
      float p[3][LANES];
      for (int i = 0; i < LANES; ++i) {
        const double* point = points + 3 * (first + smaller(i, here - 1));
        for (int k = 0; k < 3; ++k) {
          const double at = k == 1 && TOP != Top::none ? larger(point[k], 0.0) : point[k];
          below[3 * i + k] = at, p[k][i] = static_cast<float>(at);
        }
      }
      Sum3 u;
      add_forces<TOP>(forces, count, poisson, load(p[0]), load(p[1]), load(p[2]), u);
      for (int i = 0; i < here; ++i) {
        double* to = out + 3 * (first + i);
        to[0] = u.x[i], to[1] = u.y[i], to[2] = u.z[i];
        if (smooth) smooth->add(below + 3 * i, to);
      }
    }
  }
};

}  // namespace echospline::ECHOSPLINE_CORE
