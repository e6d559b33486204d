// Tissue of one or a few materials that answers point forces: closed forms plus what the edges and the interfaces do.
//
// The method is that of `mechanics/boundary_forces.py`, where it is set up: forces outside every body, chosen by least squares such
// that the conditions on edges and interfaces hold. Unknowns are the strengths along x and y of every body's sources and
// its motions as a whole, body after body, then the forces at clamped points.
#pragma once
#include <cmath>
#include <cstdint>

#include "anchored_kernel.hpp"
#include "array.hpp"
#include "green.h"
#include "half_plane.hpp"
#include "level_begin.hpp"

namespace echospline::ECHOSPLINE_CORE {

constexpr double SMOOTH = 1e-3;  // accuracy to which the field of one source is interpolated from a Chebyshev lattice
constexpr double LATTICE_PAYS = 0.6;  // nodes of the lattice per mesh node, above which it is not used
constexpr double ON_EDGE = 1e-9;      // of the longer side: a point this near an edge lies on it

/// Mesh, extent and edges that both methods share.
struct GreenMesh {
  int64_t across = 0, down = 0;
  Vec<2> origin = {}, spacing = {}, low = {}, high = {};
  uint32_t clamped = 0, sliding = 0;

  void build(const echospline_green_options& o) {
    across = o.shape[0], down = o.shape[1], clamped = o.clamped, sliding = o.sliding;
    origin = low = point_of<2>(o.origin), spacing = point_of<2>(o.spacing);
    high = {
        {low[0] + spacing[0] * static_cast<double>(across - 1), low[1] + spacing[1] * static_cast<double>(down - 1)}};
  }
  int64_t nodes() const { return across * down; }
  Vec<2> node(int64_t i) const {
    return {{origin[0] + spacing[0] * static_cast<double>(i % across),
             origin[1] + spacing[1] * static_cast<double>(i / across)}};
  }
  double size() const { return std::fmax(high[0] - low[0], high[1] - low[1]); }
  bool contains(const Vec<2>& p) const {
    const double slack = ON_EDGE * size();
    return p[0] >= low[0] - slack && p[0] <= high[0] + slack && p[1] >= low[1] - slack && p[1] <= high[1] + slack;
  }
  /// Zero the components that an edge holds.
  void hold(const Vec<2>& p, double* u) const {
    const double slack = ON_EDGE * size();
    const double gap[4] = {p[0] - low[0], p[0] - high[0], p[1] - low[1], p[1] - high[1]};
    for (int edge = 0; edge < 4; ++edge) {
      if (std::fabs(gap[edge]) > slack) continue;
      if (clamped >> edge & 1) u[0] = u[1] = 0;
      if (sliding >> edge & 1) u[edge / 2] = 0;
    }
  }
};

/// A place and its forces in two load cases, which are answered together.
struct GreenForce {
  Vec<2> place, force[2];
};

/// Products of a row of n doubles with two others.
ECHOSPLINE_INLINE void two_products(const double* row, const double* a, const double* b, int64_t n, double& s,
                                    double& t) {
  Doubles S = {}, T = {};
  int64_t i = 0;
  for (; i + DOUBLE_LANES <= n; i += DOUBLE_LANES) {
    const Doubles c = load(row + i);
    S += c * load(a + i), T += c * load(b + i);
  }
  s = total(S), t = total(T);
  for (; i < n; ++i) s += row[i] * a[i], t += row[i] * b[i];
}

class BoundaryGreen {
 public:
  /// The options have been checked. False when memory runs out.
  ECHOSPLINE_SET_UP bool build(const echospline_green_options& o, const GreenMesh& mesh) {
    mesh_ = &mesh, radius_ = o.radius, weight_ = o.weight, pin_weight_ = o.pin_weight, pin_radius_ = o.pin_radius;
    bodies_ = o.body_count, bands_ = o.band_count, conditions_ = o.condition_count, pins_ = o.pin_count, rank_ = o.rank;
    if (!body_.reserve(bodies_) || !depth_.reserve(bands_ + 1) || !circle_.reserve(3 * (bodies_ - bands_)) ||
        !source_.reserve(o.source_count) || !condition_.reserve(conditions_) || !pin_.reserve(pins_) ||
        !body_at_.reserve(mesh.nodes()))
      return false;
    const Surface top = mesh.clamped & ECHOSPLINE_TOP   ? Surface::clamped
                        : mesh.sliding & ECHOSPLINE_TOP ? Surface::sliding
                                                        : Surface::free;
    int64_t first = 0;
    for (int64_t q = 0; q < bodies_; ++q) {
      Body& b = body_[q];
      b.base = {o.bodies[2 * q], o.bodies[2 * q + 1], top, mesh.low[1]};
      b.outside = b.base;
      if (q > 0 || top == Surface::clamped) b.outside.top = Surface::none;
      b.first_source = first, b.sources = o.source_counts[q], b.first = unknowns_;
      first += b.sources, unknowns_ += 2 * b.sources + b.outside.motions();
    }
    own_ = unknowns_, unknowns_ += 2 * pins_;
    for (int64_t i = 0; i <= bands_; ++i) depth_[i] = o.depths[i];
    for (int64_t i = 0; i < circle_.size(); ++i) circle_[i] = o.circles[i];
    for (int64_t i = 0; i < mesh.nodes(); ++i) body_at_[i] = static_cast<int32_t>(locate(mesh.node(i)));
    for (int64_t i = 0; i < o.source_count; ++i) source_[i] = point_of<2>(o.sources + 2 * i);
    for (int64_t i = 0; i < pins_; ++i) pin_[i] = point_of<2>(o.pins + 2 * i);
    for (int64_t i = 0; i < conditions_; ++i) {
      Condition& c = condition_[i];
      c.place = point_of<2>(o.conditions + 4 * i), c.normal = point_of<2>(o.conditions + 4 * i + 2);
      c.kind = o.sides[3 * i], c.body = o.sides[3 * i + 1], c.other = o.sides[3 * i + 2];
      rows_ += c.kind == ECHOSPLINE_CONDITION_INTERFACE ? 4 : 2;
    }
    rows_ += 2 * pins_;
    return factor(o) && evaluate(o.lattice);
  }

  int64_t unknowns() const { return unknowns_; }

  /// Strengths of the unknowns in two load cases, one after the other; so is the room for conditions and kept unknowns.
  void strengths(const GreenForce* forces, int64_t count, double* load, double* kept, double* a, double* b) const {
    const int64_t ld = padded(rows_), lk = padded(rank_);
    for (int64_t i = 0; i < 2 * ld; ++i) load[i] = 0;
    for (int64_t i = 0; i < count; ++i) add_load(forces[i], 2, radius_, load);
    for (int64_t r = 0; r < rank_; ++r)
      two_products(left_.data() + r * ld, load, load + ld, rows_, kept[r], kept[lk + r]);
    for (int64_t j = 0; j < unknowns_; ++j) {
      two_products(right_.data() + j * lk, kept, kept + lk, rank_, a[j], b[j]);
      a[j] = -a[j], b[j] = -b[j];
    }
    for (int64_t j = unknowns_; j < padded(unknowns_); ++j) a[j] = b[j] = 0;
  }
  int64_t load_room() const { return 2 * padded(rows_); }
  int64_t kept_room() const { return 2 * padded(rank_); }
  int64_t strengths_room() const { return padded(unknowns_); }
  /// Numbers that `field` works in.
  int64_t field_room() const { return 4 * lattice_x_ * (lattice_y_ + 1); }

  /// Displacement of the mesh nodes, (nodes, 2), in two load cases by strengths and forces.
  void field(const double* a, const double* b, const GreenForce* forces, int64_t count, double* room, double* u,
             double* v) const {
    const int64_t n = mesh_->nodes(), ld = padded(own_);
    if (lattice_x_ == 0) {
      for (int64_t i = 0; i < 2 * n; ++i) two_products(columns_.data() + i * ld, a, b, own_, u[i], v[i]);
    } else {
      const int64_t row = 4 * lattice_x_;
      double* along = room + row * lattice_y_;  // one mesh row, lattice columns
      for (int64_t i = 0; i < lattice_x_ * lattice_y_; ++i)
        for (int d = 0; d < 2; ++d)
          two_products(columns_.data() + (2 * i + d) * ld, a, b, own_, room[4 * i + d], room[4 * i + 2 + d]);
      for (int64_t y = 0; y < mesh_->down; ++y) {
        for (int64_t i = 0; i < row; ++i) along[i] = 0;
        for (int64_t l = 0; l < lattice_y_; ++l) {
          const double f = along_y_[y * lattice_y_ + l];
          for (int64_t i = 0; i < row; ++i) along[i] += f * room[l * row + i];
        }
        for (int64_t x = 0; x < mesh_->across; ++x) {
          double sum[4] = {};
          for (int64_t l = 0; l < lattice_x_; ++l)
            for (int k = 0; k < 4; ++k) sum[k] += along_x_[x * lattice_x_ + l] * along[4 * l + k];
          const int64_t i = 2 * (y * mesh_->across + x);
          u[i] = sum[0], u[i + 1] = sum[1], v[i] = sum[2], v[i + 1] = sum[3];
        }
      }
    }
    for (int64_t y = 0; y < mesh_->down; ++y)
      for (int64_t x = 0; x < mesh_->across; x += DOUBLE_LANES)
        add_closed(x, y, forces, count, a, b, u + 2 * y * mesh_->across, v + 2 * y * mesh_->across);
    for (int64_t i = 0; i < n; ++i) mesh_->hold(mesh_->node(i), u + 2 * i), mesh_->hold(mesh_->node(i), v + 2 * i);
  }

  /// Add to two rows of columns, which take the strengths of all but clamped points to the displacement of a point, times a weight;
  /// zero where an edge holds a component and `held` is asked for.
  void add_columns(const Vec<2>& p, double weight, double* x, double* y, bool held = true) const {
    const Body& b = body_[locate(p)];
    double moves[2] = {weight, weight};
    if (held) mesh_->hold(p, moves);
    x += b.first, y += b.first;
    for (int64_t j = 0; j < b.sources; ++j) {
      const Block K = b.outside.displacement(p, source_[b.first_source + j], 0);
      for (int d = 0; d < 2; ++d) x[2 * j + d] += moves[0] * K.v[0][d], y[2 * j + d] += moves[1] * K.v[1][d];
    }
    for (int m = 0; m < b.outside.motions(); ++m) {
      const Vec<2> v = motion(b, p, m);
      x[2 * b.sources + m] += moves[0] * v[0], y[2 * b.sources + m] += moves[1] * v[1];
    }
  }
  /// Displacement of a point by the closed form of forces of a load case, those at clamped points among them.
  Vec<2> closed_at(const Vec<2>& p, const double* c, const GreenForce* forces, int64_t count, int w) const {
    Vec<2> u = {};
    add_closed(p, body_[locate(p)].base, forces, count, w, c, u.v);
    mesh_->hold(p, u.v);
    return u;
  }

  /// Displacement of a point in a load case, mm.
  Vec<2> at(const Vec<2>& p, const double* c, const GreenForce* forces, int64_t count, int w) const {
    Vec<2> u = {};
    const Body& b = body_[locate(p)];
    for (int64_t j = 0; j < b.sources; ++j) {
      const Block K = b.outside.displacement(p, source_[b.first_source + j], 0);
      const double *f = c + b.first + 2 * j, (&k)[2][2] = K.v;
      u[0] += k[0][0] * f[0] + k[0][1] * f[1], u[1] += k[1][0] * f[0] + k[1][1] * f[1];
    }
    for (int m = 0; m < b.outside.motions(); ++m) {
      const Vec<2> v = motion(b, p, m);
      u = u + c[b.first + 2 * b.sources + m] * v;
    }
    add_closed(p, b.base, forces, count, w, c, u.v);
    mesh_->hold(p, u.v);
    return u;
  }

 private:
  struct Body {
    HalfPlane base, outside;
    int64_t first_source, sources, first;  ///< of the sources, and of the unknowns
  };
  struct Condition {
    Vec<2> place, normal;
    int32_t kind, body, other;
  };

  const GreenMesh* mesh_ = nullptr;
  double radius_ = 0, weight_ = 0, pin_weight_ = 0, pin_radius_ = 0;
  int64_t bodies_ = 0, bands_ = 0, conditions_ = 0, pins_ = 0, rank_ = 0, unknowns_ = 0, own_ = 0, rows_ = 0;
  int64_t lattice_x_ = 0, lattice_y_ = 0;  // points of the Chebyshev lattice; 0: strengths go to the mesh nodes at once
  Array<Body> body_;
  Array<double> depth_, circle_, right_, left_, columns_, along_x_, along_y_;
  Array<int32_t> body_at_;  // part of the tissue at each node
  Array<Vec<2>> source_, pin_;
  Array<Condition> condition_;

  static int64_t padded(int64_t n) { return rounded_up(n, ROW); }

  int64_t locate(const Vec<2>& p) const {
    int64_t body = 0;
    while (body < bands_ - 1 && p[1] >= depth_[body + 1]) ++body;
    for (int64_t q = 0; q < bodies_ - bands_; ++q)
      if (std::hypot(p[0] - circle_[3 * q], p[1] - circle_[3 * q + 1]) <= circle_[3 * q + 2]) body = bands_ + q;
    return body;
  }

  /// A motion as a whole, as large as the field of 1 N.
  Vec<2> motion(const Body& b, const Vec<2>& p, int m) const {
    const double k = b.outside.scale(), size = mesh_->size();
    if (m < 2) return {{m == 0 ? k : 0, m == 1 ? k : 0}};
    const Vec<2> centre = 0.5 * (mesh_->low + mesh_->high);
    return {{-k * (p[1] - centre[1]) / size, k * (p[0] - centre[0]) / size}};
  }

  /// Add the closed form of forces of a load case, and of those at clamped points.
  void add_closed(const Vec<2>& p, const HalfPlane& base, const GreenForce* forces, int64_t count, int w,
                  const double* c, double* u) const {
    for (int64_t i = 0; i < count; ++i) apply(base.displacement(p, forces[i].place, radius_), forces[i].force[w], 1, u);
    for (int64_t i = 0; i < pins_; ++i)
      apply(base.displacement(p, pin_[i], pin_radius_), point_of<2>(c + own_ + 2 * i), 1, u);
  }
  /// The same for nodes x, x + 1, ... of a mesh row, as many as a register holds, in both load cases; u and v are the row's.
  void add_closed(int64_t x, int64_t y, const GreenForce* forces, int64_t count, const double* a, const double* b,
                  double* u, double* v) const {
    const int64_t left = mesh_->across - x, nodes = left < DOUBLE_LANES ? left : DOUBLE_LANES;
    const int64_t first = y * mesh_->across + x;
    const int32_t body = body_at_[first];
    bool same = true;
    for (int64_t i = 1; i < nodes; ++i) same = same && body_at_[first + i] == body;
    if (!same) {
      for (int64_t i = 0; i < nodes; ++i) {
        const HalfPlane& base = body_[body_at_[first + i]].base;
        add_closed(mesh_->node(first + i), base, forces, count, 0, a, u + 2 * (x + i));
        add_closed(mesh_->node(first + i), base, forces, count, 1, b, v + 2 * (x + i));
      }
      return;
    }
    const HalfPlane& base = body_[body].base;
    const double depth = mesh_->node(first)[1] - base.surface;
    Doubles across, moved[2][2] = {};
    for (int i = 0; i < DOUBLE_LANES; ++i)
      across[i] = mesh_->origin[0] + mesh_->spacing[0] * static_cast<double>(x + i);
    const auto add = [&](const Vec<2>& place, const Vec<2>& f, const Vec<2>& g, double radius) {
      Doubles K[2][2];
      base.displacement(across - place[0], depth, base.depth(place, radius), radius, K);
      for (int d = 0; d < 2; ++d)
        moved[0][d] += K[d][0] * f[0] + K[d][1] * f[1], moved[1][d] += K[d][0] * g[0] + K[d][1] * g[1];
    };
    for (int64_t i = 0; i < count; ++i) add(forces[i].place, forces[i].force[0], forces[i].force[1], radius_);
    for (int64_t i = 0; i < pins_; ++i)
      add(pin_[i], point_of<2>(a + own_ + 2 * i), point_of<2>(b + own_ + 2 * i), pin_radius_);
    for (int64_t i = 0; i < nodes; ++i)
      for (int d = 0; d < 2; ++d) u[2 * (x + i) + d] += moved[0][d][i], v[2 * (x + i) + d] += moved[1][d][i];
  }

  static bool moves(const Condition& c) { return c.kind != ECHOSPLINE_CONDITION_FREE; }
  static bool pulls(const Condition& c) { return c.kind != ECHOSPLINE_CONDITION_CLAMPED; }

  /// Add displacement u and weighted traction t at a condition to its rows; returns how many there are.
  static int rows_of(const Condition& c, const double* u, const double* t, double sign, double* row) {
    switch (c.kind) {
      case ECHOSPLINE_CONDITION_CLAMPED: row[0] += sign * u[0], row[1] += sign * u[1]; return 2;
      case ECHOSPLINE_CONDITION_SLIDING_X: row[0] += sign * u[0], row[1] += sign * t[1]; return 2;
      case ECHOSPLINE_CONDITION_SLIDING_Y: row[0] += sign * t[0], row[1] += sign * u[1]; return 2;
      case ECHOSPLINE_CONDITION_FREE: row[0] += sign * t[0], row[1] += sign * t[1]; return 2;
      default:
        row[0] += sign * u[0], row[1] += sign * u[1];
        row[2] += sign * t[0], row[3] += sign * t[1];
        return 4;
    }
  }

  static void apply(const Block& K, const Vec<2>& f, double factor, double* u) {
    for (int d = 0; d < 2; ++d) u[d] += factor * (K.v[d][0] * f[0] + K.v[d][1] * f[1]);
  }

  /// Add what the forces at a place do to the conditions, on both sides of an interface, by the closed form below the top; conditions of
  /// the second load case follow those of the first.
  void add_load(const GreenForce& at, int cases, double radius, double* load) const {
    int64_t row = 0;
    const int64_t ld = padded(rows_);
    for (int64_t i = 0; i < conditions_; ++i) {
      const Condition& c = condition_[i];
      int count = 0;
      for (int side = 0; side < (c.other < 0 ? 1 : 2); ++side) {
        const HalfPlane& base = body_[side == 0 ? c.body : c.other].base;
        Block K = {}, T = {};
        if (moves(c)) K = base.displacement(c.place, at.place, radius);
        if (pulls(c)) T = base.traction(c.place, c.normal, at.place, radius);
        for (int w = 0; w < cases; ++w) {
          double u[2] = {}, t[2] = {};
          apply(K, at.force[w], 1, u), apply(T, at.force[w], weight_, t);
          count = rows_of(c, u, t, side == 0 ? 1 : -1, load + w * ld + row);
        }
      }
      row += count;
    }
    for (int64_t i = 0; i < pins_; ++i, row += 2) {
      const Block K = body_[locate(pin_[i])].base.displacement(pin_[i], at.place, radius);
      for (int w = 0; w < cases; ++w) apply(K, at.force[w], pin_weight_, load + w * ld + row);
    }
  }

  /// Column of the conditions under one unknown of unit strength, (rows) numbers.
  ECHOSPLINE_SET_UP void condition_column(int64_t unknown, double* column) const {
    if (unknown >= own_) {
      const int64_t k = (unknown - own_) / 2;
      const Vec<2> unit = {{(unknown - own_) % 2 == 0 ? 1.0 : 0.0, (unknown - own_) % 2 == 1 ? 1.0 : 0.0}};
      add_load({pin_[k], {unit, {}}}, 1, pin_radius_, column);
      return;
    }
    int64_t q = bodies_ - 1;
    while (unknown < body_[q].first) --q;
    const Body& b = body_[q];
    const int64_t j = unknown - b.first;
    const bool is_motion = j >= 2 * b.sources;
    const Vec<2> unit = {{j % 2 == 0 ? 1.0 : 0.0, j % 2 == 1 ? 1.0 : 0.0}};
    const auto moved = [&](const Vec<2>& p, double factor, double* u) {
      if (!is_motion) {
        apply(b.outside.displacement(p, source_[b.first_source + j / 2], 0), unit, factor, u);
        return;
      }
      const Vec<2> v = motion(b, p, static_cast<int>(j - 2 * b.sources));
      u[0] += factor * v[0], u[1] += factor * v[1];
    };
    int64_t row = 0;
    for (int64_t i = 0; i < conditions_; ++i) {
      const Condition& c = condition_[i];
      const int count = c.kind == ECHOSPLINE_CONDITION_INTERFACE ? 4 : 2;
      if (c.body == q || c.other == q) {
        double u[2] = {}, t[2] = {};
        if (moves(c)) moved(c.place, 1, u);
        if (pulls(c) && !is_motion)
          apply(b.outside.traction(c.place, c.normal, source_[b.first_source + j / 2], 0), unit, weight_, t);
        rows_of(c, u, t, c.body == q ? 1 : -1, column + row);
      }
      row += count;
    }
    for (int64_t i = 0; i < pins_; ++i, row += 2)
      if (locate(pin_[i]) == q) moved(pin_[i], pin_weight_, column + row);
  }

  /// The two factors of the least squares: given, or by Gram and Schmidt, twice, of the kept columns in their order.
  ECHOSPLINE_SET_UP bool factor(const echospline_green_options& o) {
    const int64_t ld = padded(rows_), lk = padded(rank_);
    if (!left_.reserve(rank_ * ld) || !right_.reserve(unknowns_ * lk)) return false;
    if (o.left) {
      for (int64_t r = 0; r < rank_; ++r)
        for (int64_t i = 0; i < rows_; ++i) left_[r * ld + i] = o.left[r * rows_ + i];
      for (int64_t j = 0; j < unknowns_; ++j)
        for (int64_t r = 0; r < rank_; ++r) right_[j * lk + r] = o.right[j * rank_ + r];
      return true;
    }
    Array<double> R, inverse;
    if (!R.reserve(rank_ * lk) || !inverse.reserve(rank_ * lk)) return false;
    for (int64_t k = 0; k < rank_; ++k) {
      double* own = left_.data() + k * ld;
      condition_column(o.order[k], own);
      for (int again = 0; again < 2; ++again)
        for (int64_t i = 0; i < k; ++i) {
          const double share = dot(left_.data() + i * ld, own, ld);
          add(own, -share, left_.data() + i * ld, ld);
          R[i * lk + k] += share;
        }
      const double length = std::sqrt(dot(own, own, ld));
      if (!(length > 0)) return true;  // the strengths become infinite, which `create` refuses
      R[k * lk + k] = length;
      for (int64_t i = 0; i < ld; ++i) own[i] /= length;
    }
    for (int64_t i = rank_; i-- > 0;) {  // inverse of R by rows from the last
      double* row = inverse.data() + i * lk;
      row[i] = 1;
      for (int64_t k = i + 1; k < rank_; ++k) add(row, -R[i * lk + k], inverse.data() + k * lk, lk);
      for (int64_t k = i; k < rank_; ++k) row[k] /= R[i * lk + i];
      for (int64_t k = i; k < rank_; ++k) right_[o.order[i] * lk + k] = row[k];
    }
    return true;
  }

  /// Columns that take strengths to the mesh nodes, or to a lattice from which they are interpolated.
  ECHOSPLINE_SET_UP bool evaluate(double distance) {
    if (bodies_ == 1 && distance > 0) {
      const int64_t nx = lattice_count(0, distance), ny = lattice_count(1, distance);
      if (static_cast<double>(nx * ny) <= LATTICE_PAYS * static_cast<double>(mesh_->nodes())) {
        lattice_x_ = nx, lattice_y_ = ny;
        if (!along_x_.reserve(mesh_->across * nx) || !along_y_.reserve(mesh_->down * ny)) return false;
        interpolation(0, nx, mesh_->across, along_x_.data());
        interpolation(1, ny, mesh_->down, along_y_.data());
      }
    }
    const int64_t count = lattice_x_ ? lattice_x_ * lattice_y_ : mesh_->nodes(), ld = padded(own_);
    if (!columns_.reserve(2 * count * ld)) return false;
    for (int64_t i = 0; i < count; ++i) {
      const Vec<2> p =
          lattice_x_ ? Vec<2>{{chebyshev(0, i % lattice_x_, lattice_x_), chebyshev(1, i / lattice_x_, lattice_y_)}}
                     : mesh_->node(i);
      add_columns(p, 1, columns_.data() + 2 * i * ld, columns_.data() + (2 * i + 1) * ld, false);
    }
    return true;
  }

  int64_t lattice_count(int d, double distance) const {
    const double reach = 2 * distance / (mesh_->high[d] - mesh_->low[d]);
    return static_cast<int64_t>(std::ceil(-std::log(SMOOTH) / std::log(reach + std::sqrt(1 + reach * reach)))) + 1;
  }
  double chebyshev(int d, int64_t i, int64_t count) const {
    const double middle = (mesh_->low[d] + mesh_->high[d]) / 2, half = (mesh_->high[d] - mesh_->low[d]) / 2;
    return middle - half * std::cos(CIRCLE / 2 * static_cast<double>(i) / static_cast<double>(count - 1));
  }
  /// Barycentric weights from Chebyshev points to mesh lines, (lines, points).
  ECHOSPLINE_SET_UP void interpolation(int d, int64_t count, int64_t lines, double* weights) const {
    const double tiny = 1e-12 * (mesh_->high[d] - mesh_->low[d]);
    for (int64_t i = 0; i < lines; ++i) {
      double* row = weights + i * count;
      const double x = mesh_->origin[d] + mesh_->spacing[d] * static_cast<double>(i);
      double sum = 0;
      int64_t hit = -1;
      for (int64_t k = 0; k < count; ++k) {
        const double gap = x - chebyshev(d, k, count);
        if (std::fabs(gap) < tiny) hit = k;
        const double w = (k % 2 == 0 ? 1.0 : -1.0) * (k == 0 || k == count - 1 ? 0.5 : 1.0);
        row[k] = w / (std::fabs(gap) < tiny ? 1 : gap), sum += row[k];
      }
      for (int64_t k = 0; k < count; ++k) row[k] = hit < 0 ? row[k] / sum : k == hit ? 1 : 0;
    }
  }
};

}  // namespace echospline::ECHOSPLINE_CORE
