// Green's function of a homogeneous block of tissue in space: closed forms, and forces outside its faces that make the faces what they are.
//
// The numbers are those of `mechanics/space_response.py`, which makes the tables: places of the boundary forces, points on the faces with
// their conditions, and the matrix that takes what the needle does there to boundary forces (the method of fundamental solutions). The
// closed forms are those of `mechanics/half_space.py`, in double precision; their derivatives come from dual numbers.
#pragma once
#include <cmath>
#include <cstdint>

#include "array.hpp"
#include "force_field.hpp"
#include "space.h"
#include "stick_slip.hpp"
#include "vec.hpp"

namespace echospline::ECHOSPLINE_CORE {

/// A number and its derivatives along x, y and z.
struct Dual {
  double v, d[3];
};
inline Dual operator+(Dual a, const Dual& b) {
  a.v += b.v;
  for (int k = 0; k < 3; ++k) a.d[k] += b.d[k];
  return a;
}
inline Dual operator+(Dual a, double b) {
  a.v += b;
  return a;
}
inline Dual operator*(double b, Dual a) {
  a.v *= b;
  for (int k = 0; k < 3; ++k) a.d[k] *= b;
  return a;
}
inline Dual operator-(const Dual& a, const Dual& b) { return a + -1.0 * b; }
inline Dual operator-(const Dual& a, double b) { return a + -b; }
inline Dual operator*(const Dual& a, const Dual& b) {
  Dual c = {a.v * b.v, {}};
  for (int k = 0; k < 3; ++k) c.d[k] = a.v * b.d[k] + a.d[k] * b.v;
  return c;
}
inline double inverse(double a) { return 1 / a; }
inline double square_root(double a) { return std::sqrt(a); }
inline Dual inverse(const Dual& a) {
  const double v = 1 / a.v;
  return {v, {-v * v * a.d[0], -v * v * a.d[1], -v * v * a.d[2]}};
}
inline Dual square_root(const Dual& a) {
  const double v = std::sqrt(a.v), half = 0.5 / v;
  return {v, {half * a.d[0], half * a.d[1], half * a.d[2]}};
}

/// Displacement (first index) by unit forces (second), times 16 pi mu (1 - nu), as a matrix of numbers or of duals.
template <class T>
struct Response3 {
  T k[3][3];
};

/// Kelvinlet at a distance d: [a / R + 2 (1 - nu) e^2 / R^3] f + d (d . f) / R^3 with R^2 = |d|^2 + e^2.
template <class T>
inline Response3<T> kelvinlet(const T (&d)[3], double nu, double spread) {
  const T squared = d[0] * d[0] + d[1] * d[1] + d[2] * d[2] + spread;
  const T i1 = inverse(square_root(squared)), i3 = i1 * inverse(squared);
  const T direct = (3 - 4 * nu) * i1 + (2 * (1 - nu) * spread) * i3;
  Response3<T> G;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) G.k[i][j] = i == j ? d[i] * d[j] * i3 + direct : d[i] * d[j] * i3;
  return G;
}

/// A unit force at a source below the surface, spread over a radius (spread: its square), and its image.
template <class T>
__attribute__((noinline)) Response3<T> response_in_space(const T (&p)[3], const double* source, double nu,
                                                         double spread, Top top) {
  const double c = source[1], a = 3 - 4 * nu;
  const T d[3] = {p[0] - source[0], p[1] - c, p[2] - source[2]};
  Response3<T> G = kelvinlet(d, nu, spread);
  if (top == Top::none) return G;
  const T D[3] = {d[0], p[1] + c, d[2]};
  if (top == Top::sliding) {
    const Response3<T> mirrored = kelvinlet(D, nu, spread);
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) G.k[i][j] = j == 1 ? G.k[i][j] - mirrored.k[i][j] : G.k[i][j] + mirrored.k[i][j];
    return G;
  }
  // Mindlin's image: R the distance from the mirrored source, Y the depth below it, q = 1 / (R + Y)
  const double k = 4 * (1 - nu) * (1 - 2 * nu), b = 8 * (1 - nu) * (1 - nu) - a;
  const T Y = D[1], R = square_root(D[0] * D[0] + Y * Y + D[2] * D[2]), j1 = inverse(R);
  const T j2 = j1 * j1, j3 = j1 * j2, j5 = j3 * j2, q = inverse(R + Y), cy = c * p[1];
  const T A = j1 + 2.0 * (cy * j3) + k * q;
  const T B = a * j3 - 6.0 * (cy * j5) - k * (j1 * q * q);
  const T s = a * (d[1] * j3), t = 6.0 * (cy * Y * j5) - k * (j1 * q);
  for (int i = 0; i < 3; i += 2) {
    G.k[i][i] = G.k[i][i] + A;
    for (int j = 0; j < 3; j += 2) G.k[i][j] = G.k[i][j] + B * D[i] * D[j];
    G.k[i][1] = G.k[i][1] + D[i] * (s + t);
    G.k[1][i] = G.k[1][i] + D[i] * (s - t);
  }
  G.k[1][1] = G.k[1][1] + b * j1 + (a * (Y * Y) - 2.0 * cy) * j3 + 6.0 * (cy * Y * Y * j5);
  return G;
}

/// A block of tissue that answers the stations of a needle's track.
class SpaceGreen {
 public:
  /// Copy the tables; false when memory runs out. Numbers have been checked.
  ECHOSPLINE_SET_UP bool prepare(const echospline_spatial_options& o) {
    top_ = o.top == ECHOSPLINE_TOP_FREE ? Top::free : o.top == ECHOSPLINE_TOP_SLIDING ? Top::sliding : Top::none;
    nu_ = o.poisson, mu_ = o.shear_modulus, radius_ = o.radius, source_radius_ = o.source_radius;
    scale_ = 1 / (16 * 3.14159265358979323846 * mu_ * (1 - nu_));
    traction_ = o.traction_length, clamped_ = o.clamped, sliding_ = o.sliding;
    sources_ = o.source_count, conditions_ = o.condition_count;
    for (int k = 0; k < 3; ++k) {
      middle_[k] = (o.low[k] + o.high[k]) / 2;
      shape_[k] = o.lattice_shape[k], spacing_[k] = o.lattice_spacing[k], origin_[k] = o.lattice_origin[k];
    }
    motions_ = 0;
    for (int motion = 0; motion < 6; ++motion)
      if (top_ != Top::sliding || motion == 0 || motion == 2 || motion == 4) allowed_[motions_++] = motion;
    const int64_t points = int64_t(shape_[0]) * shape_[1] * shape_[2];
    if (!source_.reserve(3 * sources_) || !condition_.reserve(3 * conditions_) || !face_.reserve(conditions_) ||
        !matrix_.reserve(unknowns() * 3 * conditions_) || !held_.reserve(9 * conditions_) ||
        !outer_.reserve(sources_) || !point_.reserve(3 * points) || !values_.reserve(3 * points) ||
        !answer_.reserve(unknowns()))
      return false;
    std::memcpy(source_.data(), o.sources, static_cast<size_t>(3 * sources_) * sizeof(double));
    std::memcpy(condition_.data(), o.conditions, static_cast<size_t>(3 * conditions_) * sizeof(double));
    std::memcpy(face_.data(), o.condition_faces, static_cast<size_t>(conditions_) * sizeof(uint32_t));
    std::memcpy(matrix_.data(), o.answers, static_cast<size_t>(unknowns() * 3 * conditions_) * sizeof(double));
    int64_t i = 0;
    for (int z = 0; z < shape_[2]; ++z)
      for (int y = 0; y < shape_[1]; ++y)
        for (int x = 0; x < shape_[0]; ++x, i += 3)
          point_[i] = origin_[0] + spacing_[0] * x, point_[i + 1] = origin_[1] + spacing_[1] * y,
          point_[i + 2] = origin_[2] + spacing_[2] * z;
    return true;
  }
  int64_t unknowns() const { return 3 * sources_ + motions_; }

  /// Answer station j of a tissue that wants it: boundary forces and motions, and the mean displacement over every station so far.
  SlipTissueIn<3>::Outcome answer(SlipTissueIn<3>& tissue) {
    using Outcome = SlipTissueIn<3>;
    const int64_t j = tissue.wanted_index;
    const SlipStationIn<3>& station = tissue.wanted;
    if (j >= MOST_STATIONS + 2) return Outcome::no_memory;
    if (made_[j].size() != 3 * unknowns() && !made_[j].reserve(3 * unknowns())) return Outcome::no_memory;
    if (rows_.size() < 9 * (j + 1) && !rows_.reserve(9 * (j + 1 + 32))) return Outcome::no_memory;
    if (station.count > 0) solve(station, made_[j].data());
    for (int64_t i = 0; i <= j; ++i) {
      const SlipStationIn<3>& other = i == j ? station : tissue.station(i);
      double* mean = &rows_[9 * i];
      for (int e = 0; e < 9; ++e) mean[e] = 0;
      for (int k = 0; station.count > 0 && k < other.count; ++k) {
        double u[3][3];
        moved(below(other.points[k]), station, made_[j].data(), u);
        for (int e = 0; e < 9; ++e) mean[e] += other.weights[k] * u[e / 3][e % 3];
      }
    }
    return tissue.answer(nullptr, rows_.data());
  }

  /// Field of a state's forces; false when memory runs out. It points into this until the next call.
  bool field(const SlipTissueIn<3>& tissue, echospline_force_field& out) {
    const int64_t count = tissue.state.count;
    if (forces_.size() < 3 * count && !forces_.reserve(3 * (count + 32))) return false;
    if (place_.size() < 12 * count &&
        (!place_.reserve(12 * (count + 32)) || !load_.reserve(12 * (count + 32)) || !spread_.reserve(4 * (count + 32))))
      return false;
    tissue.forces(forces_.data());
    for (int64_t r = 0; r < unknowns(); ++r) answer_[r] = 0;
    int64_t used = 0;
    for (int64_t j = 0; j < count; ++j) {
      const double* f = &forces_[3 * j];
      const SlipStationIn<3>& station = tissue.station(j);
      if (station.count == 0 || (f[0] == 0 && f[1] == 0 && f[2] == 0)) continue;
      const double* made = made_[j].data();
      for (int64_t r = 0; r < unknowns(); ++r)
        answer_[r] += made[3 * r] * f[0] + made[3 * r + 1] * f[1] + made[3 * r + 2] * f[2];
      for (int k = 0; k < station.count; ++k) {
        const Vec<3> p = below(station.points[k]);
        int64_t at = used;
        for (int64_t other = used - 1; other >= 0 && other >= used - 4; --other)
          if (coincide(p, &place_[3 * other])) at = other;
        if (at == used) {
          for (int d = 0; d < 3; ++d) place_[3 * at + d] = p[d], load_[3 * at + d] = 0;
          spread_[used++] = radius_;
        }
        for (int d = 0; d < 3; ++d) load_[3 * at + d] += station.weights[k] * f[d];
      }
    }
    faces();
    std::memset(&out, 0, sizeof out);
    out.struct_size = sizeof out;
    out.top = top_ == Top::free      ? ECHOSPLINE_TOP_FREE
              : top_ == Top::sliding ? ECHOSPLINE_TOP_SLIDING
                                     : ECHOSPLINE_TOP_NONE;
    out.poisson = nu_, out.shear_modulus = mu_;
    out.places = place_.data(), out.forces = load_.data(), out.radii = spread_.data(), out.force_count = used;
    for (int k = 0; k < 3; ++k)
      out.lattice_shape[k] = shape_[k], out.lattice_spacing[k] = spacing_[k], out.lattice_origin[k] = origin_[k];
    out.lattice = values_.data();
    return true;
  }

 private:
  Top top_ = Top::none;
  double nu_ = 0, mu_ = 0, scale_ = 0, radius_ = 0, source_radius_ = 0, traction_ = 0;
  uint32_t clamped_ = 0, sliding_ = 0;
  int64_t sources_ = 0, conditions_ = 0, motions_ = 0;
  int allowed_[6] = {};
  double middle_[3] = {}, spacing_[3] = {}, origin_[3] = {};
  int32_t shape_[3] = {};
  Array<double> source_, condition_, matrix_, held_, point_, values_, answer_, rows_, forces_, place_, load_, spread_;
  Array<uint32_t> face_;
  Array<PointForce> outer_;
  Array<double> made_[MOST_STATIONS + 2];

  /// At least a force's radius below a surface: the image is that of a point.
  Vec<3> below(Vec<3> p) const {
    if (top_ != Top::none && p[1] < radius_) p[1] = radius_;
    return p;
  }

  /// Whether two forces act in one place. The hats of neighbours overlap by two points of four: half of the forces are another's.
  static bool coincide(const Vec<3>& p, const double* q) {
    for (int d = 0; d < 3; ++d)
      if (!(std::fabs(p[d] - q[d]) < 1e-9)) return false;
    return true;
  }

  /// Rigid motion at a point: shifts along x, y, z and turns about them.
  double motion(int which, const double* point, int direction) const {
    if (which < 3) return which == direction;
    const double p[3] = {point[0] - middle_[0], point[1] - middle_[1], point[2] - middle_[2]};
    const int axis = which - 3, next = (axis + 1) % 3, last = (axis + 2) % 3;
    return direction == next ? -p[last] : direction == last ? p[next] : 0;
  }

  /// Boundary forces and motions (unknowns, 3) by unit forces along x, y, z at a station.
  void solve(const SlipStationIn<3>& station, double* made) {
    const int64_t rows = 3 * conditions_;
    for (int64_t i = 0; i < conditions_; ++i) condition(i, station, &held_[9 * i]);
    for (int64_t r = 0; r < unknowns(); ++r) {
      const double* row = &matrix_[r * rows];
      double sum[3] = {};
      for (int64_t i = 0; i < rows; ++i)
        for (int d = 0; d < 3; ++d) sum[d] += row[i] * held_[3 * i + d];
      for (int d = 0; d < 3; ++d) made[3 * r + d] = sum[d];
    }
  }

  /// What a face's condition would hold at zero, (3, 3): component, direction of the force.
  void condition(int64_t i, const SlipStationIn<3>& station, double* out) const {
    const uint32_t face = face_[i];
    const int axis = face <= ECHOSPLINE_RIGHT ? 0 : face <= ECHOSPLINE_BOTTOM ? 1 : 2;
    const double normal = face & (ECHOSPLINE_RIGHT | ECHOSPLINE_BOTTOM | ECHOSPLINE_BACK) ? 1 : -1;
    const double* p = &condition_[3 * i];
    double G[3][3][3] = {}, u[3][3] = {};  // gradient: component, force, direction
    for (int k = 0; k < station.count; ++k) {
      const Vec<3> place = below(station.points[k]);
      const double weight = station.weights[k] * scale_;
      if (face & clamped_) {
        const double at[3] = {p[0], p[1], p[2]};
        const Response3<double> K = response_in_space(at, place.v, nu_, radius_ * radius_, top_);
        for (int c = 0; c < 3; ++c)
          for (int d = 0; d < 3; ++d) u[c][d] += weight * K.k[c][d];
        continue;
      }
      const Dual at[3] = {{p[0], {1, 0, 0}}, {p[1], {0, 1, 0}}, {p[2], {0, 0, 1}}};
      const Response3<Dual> K = response_in_space(at, place.v, nu_, radius_ * radius_, top_);
      for (int c = 0; c < 3; ++c)
        for (int d = 0; d < 3; ++d) {
          u[c][d] += weight * K.k[c][d].v;
          for (int e = 0; e < 3; ++e) G[c][d][e] += weight * K.k[c][d].d[e];
        }
    }
    for (int d = 0; d < 3; ++d)
      for (int c = 0; c < 3; ++c) {
        if ((face & clamped_) || ((face & sliding_) && c == axis)) {
          out[3 * c + d] = u[c][d];
          continue;
        }
        double traction = (G[c][d][axis] + G[axis][d][c]) * normal;
        if (c == axis) traction += 2 * nu_ / (1 - 2 * nu_) * (G[0][d][0] + G[1][d][1] + G[2][d][2]) * normal;
        out[3 * c + d] = traction_ * traction;
      }
  }

  /// Displacement at a point by unit forces at a station, (component, direction of the force), mm/N.
  void moved(const Vec<3>& p, const SlipStationIn<3>& station, const double* made, double (&u)[3][3]) const {
    for (int c = 0; c < 3; ++c)
      for (int d = 0; d < 3; ++d) u[c][d] = 0;
    const double at[3] = {p[0], p[1], p[2]};
    for (int k = 0; k < station.count; ++k) {
      const Vec<3> place = below(station.points[k]);
      const Response3<double> K = response_in_space(at, place.v, nu_, radius_ * radius_, top_);
      for (int c = 0; c < 3; ++c)
        for (int d = 0; d < 3; ++d) u[c][d] += station.weights[k] * K.k[c][d];
    }
    for (int64_t m = 0; m < sources_; ++m) {
      const Response3<double> K = response_in_space(at, &source_[3 * m], nu_, source_radius_ * source_radius_, top_);
      for (int c = 0; c < 3; ++c)
        for (int e = 0; e < 3; ++e)
          for (int d = 0; d < 3; ++d) u[c][d] += K.k[c][e] * made[3 * (3 * m + e) + d];
    }
    for (int c = 0; c < 3; ++c)
      for (int d = 0; d < 3; ++d) u[c][d] *= scale_;
    for (int64_t k = 0; k < motions_; ++k)
      for (int c = 0; c < 3; ++c)
        for (int d = 0; d < 3; ++d) u[c][d] += motion(allowed_[k], at, c) * made[3 * (3 * sources_ + k) + d];
  }

  /// What the faces do, on the lattice.
  void faces() {
    const float spread = static_cast<float>(source_radius_ * source_radius_);
    for (int64_t m = 0; m < sources_; ++m) {
      const double *s = &source_[3 * m], *f = &answer_[3 * m];
      outer_[m] = {static_cast<float>(s[0]),
                   static_cast<float>(s[1]),
                   static_cast<float>(s[2]),
                   static_cast<float>(f[0] * scale_),
                   static_cast<float>(f[1] * scale_),
                   static_cast<float>(f[2] * scale_),
                   spread};
    }
    const SpaceField sum = {outer_.data(), sources_, static_cast<float>(nu_), top_, nullptr};
    const int64_t points = int64_t(shape_[0]) * shape_[1] * shape_[2];
    sum(point_.data(), points, values_.data());
    for (int64_t i = 0; i < points; ++i)
      for (int64_t k = 0; k < motions_; ++k)
        for (int c = 0; c < 3; ++c)
          values_[3 * i + c] += motion(allowed_[k], &point_[3 * i], c) * answer_[3 * sources_ + k];
  }
};

}  // namespace echospline::ECHOSPLINE_CORE
