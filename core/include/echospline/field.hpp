// From weights of landmarks to the field: the part of a step that is as large as the mesh, for one kernel and one precision.
//
// In the plane the columns G_:c of the contacts are kept, each computed once, and the tip's column is evaluated at every step. In space nothing
// of the mesh's size is kept: kernels are evaluated where the field is wanted.
//
// Weights of landmarks that stand close together are large and of both signs. So that single precision is enough, a column is kept as its
// difference to that of the nearest landmark at the time it joined, its parent: an anchor, whose column is zero, or another contact, which
// then carries its children's weights beside its own. Where kernels are evaluated directly, sums of groups of landmarks are compensated (Kahan),
// and the thin plate in the plane, whose terms are far larger than their sum, is evaluated in double.
#pragma once
#include <new>

#include "fine_mesh.hpp"
#include "scene.hpp"

namespace echospline::ECHOSPLINE_CORE {

constexpr double CAREFUL =
    35;  // weight times sum of anchors' shares beyond which a tip's column is computed in double, as its last digits
         // would be more than some 1e-6 mm of the field
constexpr int64_t GROUP = 16;  // landmarks summed plainly before sums are compensated; more: less exact, fewer: slower
constexpr int VECTORS = 4;     // registers whose sums one pass over the landmarks fills

/// Points at which the field is wanted, as vectors read them: blocks of VECTORS registers, the last one filled up with the last point.
template <int D, class Real>
struct Points {
  static constexpr int64_t block = VECTORS * Lanes<Real>::count;
  int64_t count = 0, blocks = 0;
  Array<Real> x[D];  ///< conditioned, (blocks * block)

  int64_t room() const { return blocks * block; }
  template <class Place>
  bool build(int64_t n, Place place) {
    count = n, blocks = rounded_up(n, block) / block;
    for (int d = 0; d < D; ++d)
      if (!x[d].reserve(room())) return false;
    for (int64_t i = 0; i < room(); ++i) {
      const Vec<D> p = place(smaller(i, n - 1));
      for (int d = 0; d < D; ++d) x[d][i] = static_cast<Real>(p[d]);
    }
    return true;
  }
};

/// A field at points: one plane of numbers per component, mm.
template <int D, class Real>
struct Planes {
  Array<Real> u[D];

  bool reserve(int64_t room) {
    for (int d = 0; d < D; ++d)
      if (!u[d].reserve(room)) return false;
    return true;
  }
  void clear() {
    for (int d = 0; d < D; ++d) std::memset(u[d].data(), 0, static_cast<size_t>(u[d].size()) * sizeof(Real));
  }
  void swap(Planes& other) {
    for (int d = 0; d < D; ++d) u[d].swap(other.u[d]);
  }
  Vec<D> at(int64_t i) const {
    Vec<D> p;
    for (int d = 0; d < D; ++d) p[d] = u[d][i];
    return p;
  }
};

/// What a scene's field needs and never changes: points, which of them are sources, and in the plane [U_xB P_x] at them.
template <int D, class Kernel, class Real>
class FieldScene final : public SceneField<D> {
 public:
  static constexpr int c = Kernel::components;
  static constexpr bool apart = Kernel::scalar && c > 1;
  static constexpr int64_t block = Points<D, Real>::block;

  const Scene<D>& scene;
  Kernel kernel;
  Points<D, Real> points;
  Array<int64_t> at;     ///< which of the points every source is
  Array<Real> mask;      ///< 1 at sources, else 0
  Array<Real> table;     ///< in the plane: (blocks, entries of `rows_of_table`, block)
  CoarseGrid<D> coarse;  ///< of a fine plane mesh

  explicit FieldScene(const Scene<D>& given)
      : scene(given), kernel(Kernel::from(given.anchored.kernel.coupling, given.anchored.kernel.radius2)) {}

  void destroy() override {
    this->~FieldScene();
    std::free(this);
  }
  bool build() {
    const int64_t K = scene.sources();
    const AnchoredKernel<D>& anchored = scene.anchored;
    if (!at.reserve(K)) return false;
    bool there;
    if constexpr (D == 3) {
      there = points.build(K, [&](int64_t i) { return anchored.conditioned(scene.source[i]); });
      for (int64_t i = 0; i < K; ++i) at[i] = i;
    } else if (scene.fine()) {
      coarse.build(scene.grid);
      const int64_t first = coarse.grid.size();
      there = points.build(first + K, [&](int64_t i) {
        return anchored.conditioned(i < first ? coarse.grid.place(i) : scene.source[i - first]);
      });
      for (int64_t i = 0; i < K; ++i) at[i] = first + i;
    } else {
      there = points.build(scene.grid.size(), [&](int64_t i) { return anchored.conditioned(scene.grid.place(i)); });
      for (int64_t i = 0; i < K; ++i) at[i] = scene.lattice.node[i];
    }
    if (!there || !mask.reserve(points.room())) return false;
    for (int64_t i = 0; i < K; ++i) mask[at[i]] = 1;
    return D == 3 || build_table();
  }
  /// Numbers per point in the table: (order, c), or where the components are apart (order) of each, one after another.
  int64_t rows_of_table() const {
    int64_t rows = 0;
    for (int a = 0; a < c; ++a) rows += scene.anchored.order(a);
    return rows;
  }
  Vec<D> contact_place(int64_t source) const override {
    Vec<D> x = scene.anchored.conditioned(scene.source[source]);
    for (int d = 0; d < D; ++d) x[d] = static_cast<Real>(x[d]);
    return x;
  }
  SessionField<D>* create_session() const override;

 private:
  bool build_table() {
    const AnchoredKernel<D>& anchored = scene.anchored;
    Array<double> rows;
    const int64_t m = rows_of_table();
    if (!table.reserve(points.blocks * m * block) || !rows.reserve(c * anchored.ld)) return false;
    for (int64_t j = 0; j < points.room(); ++j) {
      Vec<D> p;
      for (int d = 0; d < D; ++d) p[d] = points.x[d][j];
      anchored.felt(p, rows.data());
      Real* out = table.data() + j / block * m * block + j % block;
      for (int s = 0; s < anchored.systems; ++s)
        for (int64_t i = 0; i < anchored.order(s); ++i)
          for (int a = s; a < (apart ? s + 1 : c); ++a, out += block)
            *out = static_cast<Real>(rows[a * anchored.ld + i]);
    }
    return true;
  }
};

template <int D, class Kernel, class Real>
class FieldOf final : public SessionField<D> {
 public:
  static constexpr int c = Kernel::components;
  static constexpr bool scalar = Kernel::scalar, apart = scalar && c > 1;
  static constexpr int size = scalar ? 1 : c;  ///< of the kernel's own matrix
  static constexpr bool keeps_columns = D == 2;
  static constexpr int sides = c == 1 ? D : 1;
  static constexpr int64_t planes_of = scalar ? 1 : D;  ///< planes of a column per component of its source
  static constexpr int64_t block = Points<D, Real>::block;
  typedef FieldScene<D, Kernel, Real> Given;
  typedef Vector<Real> V;
  typedef std::conditional_t<D == 2 && scalar, double, Real> Direct;  ///< in which kernels are evaluated directly
  static constexpr int64_t direct_block = VECTORS * Lanes<Direct>::count;

  explicit FieldOf(const Given& given)
      : given_(given), points_(given.points), anchored_(given.scene.anchored), table_rows_(given.rows_of_table()) {}

  bool build() {
    const int64_t room = points_.room();
    if constexpr (D == 2)
      if (given_.scene.fine() && !fine_.build(given_.scene.grid, given_.coarse)) return false;
    return now_.reserve(room) && next_.reserve(room) && rest_.reserve(room) && shares_.reserve(c * anchored_.ld);
  }
  void destroy() override {
    this->~FieldOf();
    std::free(this);
  }

  bool reserve(int64_t contacts, int64_t kept) override {
    Array<Real> columns, weights;
    Array<Direct> gathered;
    Array<double> places, landmark_weights;
    const int64_t most = anchored_.anchors + contacts + 1 + Kernel::motions;
    if (!columns.reserve(keeps_columns ? points_.blocks * (contacts + 1) * c * planes_of * block : 0) ||
        !weights.reserve(((contacts + 1) * c + anchored_.ld) * D) || !gathered.reserve(most * 2 * D) ||
        !places.reserve(most * D) || !landmark_weights.reserve(most * D))
      return false;
    for (int64_t b = 0; keeps_columns && b < points_.blocks && kept; ++b)
      std::memcpy(&columns[b * (contacts + 1) * c * planes_of * block], column(b, 0),
                  static_cast<size_t>(kept * c * planes_of * block) * sizeof(Real));
    columns_.swap(columns), weights_.swap(weights), gathered_.swap(gathered), places_.swap(places),
        landmark_weights_.swap(landmark_weights);
    room_ = contacts;
    return true;
  }
  void keep(int64_t slot, const Vec<D>& p, const Bases<D>& base, const double* held) override {
    if constexpr (keeps_columns) keep_column(slot, p, base, held);
  }
  void add(int64_t to, int64_t from, int component) override {
    for (int64_t b = 0; keeps_columns && b < points_.blocks; ++b) {
      Real* child = column(b, to) + component * planes_of * block;
      const Real* own = column(b, from) + component * planes_of * block;
      for (int64_t i = 0; i < planes_of * block; i += Lanes<Real>::count)
        store(child + i, load(child + i) + load(own + i));
    }
  }
  void move(int64_t from, int64_t to) override {
    for (int64_t b = 0; keeps_columns && b < points_.blocks; ++b)
      std::memcpy(column(b, to), column(b, from), static_cast<size_t>(c * planes_of * block) * sizeof(Real));
  }

  bool needs_landmarks() const override { return !keeps_columns; }
  void reserve_landmarks(LandmarkWeights<D>& landmarks) override {
    landmarks.place = places_.data(), landmarks.weight = landmark_weights_.data();
  }
  Largest compute(const Weights<D>& given) override {
    Planes<D, Real>& out = given.at_rest ? rest_ : next_;
    if constexpr (keeps_columns)
      return by_columns(given, out);
    else
      return by_kernels(given, out);
  }

  Vec<D> now(int64_t source) const override { return now_.at(given_.at[source]); }
  Vec<D> next(int64_t source) const override { return next_.at(given_.at[source]); }
  Vec<D> rest(int64_t source) const override { return rest_.at(given_.at[source]); }
  void blend(double share) override {
    const Real part = static_cast<Real>(share);
    for (int d = 0; d < D; ++d) {
      Real* u = next_.u[d].data();
      const Real* r = rest_.u[d].data();
      for (int64_t i = 0; i < points_.room(); ++i) u[i] = r[i] + part * (u[i] - r[i]);
    }
  }
  void commit() override { now_.swap(next_); }
  void clear() override { now_.clear(); }

  void evaluate(const LandmarkWeights<D>& landmarks, const double* points, int64_t count, double* out) override {
    evaluate_at(
        landmarks, count, [&](int64_t i) { return point_of<D>(points + i * D); },
        [&](int64_t i, int d, Direct u) { out[i * D + d] = static_cast<double>(u); });
  }
  bool mesh_needs_landmarks() const override { return D == 3 || given_.scene.fine(); }
  void mesh(const LandmarkWeights<D>& landmarks, double* out) override { write_mesh(landmarks, out); }
  void mesh(const LandmarkWeights<D>& landmarks, float* out) override { write_mesh(landmarks, out); }
  bool planes(const LandmarkWeights<D>& landmarks, const float*& x, const float*& y) override {
    if constexpr (D == 2 && sizeof(Real) == 4) {
      const Planes<D, Real>& u = mesh_planes(landmarks);
      x = u.u[0].data(), y = u.u[1].data();
      return true;
    } else {
      (void)landmarks, x = y = nullptr;
      return false;
    }
  }

 private:
  const Given& given_;
  const Points<D, Real>& points_;
  const AnchoredKernel<D>& anchored_;
  Planes<D, Real> now_, next_, rest_;
  Array<Real> columns_;  ///< less the parent's, in the plane: (blocks, room + 1, c, planes, block); the last for a tip
  Array<Real> weights_;
  Array<Direct> gathered_;
  Array<double> places_, landmark_weights_, shares_;
  int64_t room_ = 0;
  const int64_t table_rows_;
  struct NoFineField {};
  [[no_unique_address]] std::conditional_t<D == 2, FineField<Kernel, Real>, NoFineField> fine_;

  Real* column(int64_t block_index, int64_t slot) {
    return columns_.data() + (block_index * (room_ + 1) + slot) * c * planes_of * block;
  }
  const Real* table(int64_t block_index) const { return given_.table.data() + block_index * table_rows_ * block; }

  /// Mesh displacement in planes: the field itself, or the fine one from it.
  __attribute__((noinline)) const Planes<D, Real>& mesh_planes(const LandmarkWeights<D>& landmarks) {
    if (!given_.scene.fine()) return now_;
    fine_.compute(now_.u[0].data(), now_.u[1].data());
    const double* place = landmarks.place;
    for (int64_t i = 0; i < landmarks.count; ++i, place += D) {
      Real at[D], weight[D];
      for (int d = 0; d < D; ++d)
        at[d] = static_cast<Real>(place[d]), weight[d] = static_cast<Real>(landmarks.weight[i * D + d]);
      fine_.correct(at, weight, given_.kernel, anchored_.centre, anchored_.scale);
    }
    return fine_.field;
  }
  template <class Number>
  void write_mesh(const LandmarkWeights<D>& landmarks, Number* out) {
    const int64_t n = given_.scene.grid.size();
    if constexpr (D == 2) {
      const Planes<D, Real>& u = mesh_planes(landmarks);
      for (int64_t i = 0; i < n; ++i)
        for (int d = 0; d < D; ++d) out[i * D + d] = static_cast<Number>(u.u[d][i]);
    } else {
      evaluate_at(
          landmarks, n, [&](int64_t i) { return given_.scene.grid.place(i); },
          [&](int64_t i, int d, Direct u) { out[i * D + d] = static_cast<Number>(u); });
    }
  }

  /// Store one block of a field and keep the largest squares at sources.
  ECHOSPLINE_INLINE void finish_block(int64_t b, const V (&u)[D][VECTORS], Planes<D, Real>& out, V& change,
                                      V& reach) const {
    for (int v = 0; v < VECTORS; ++v) {
      const int64_t at = b * block + v * Lanes<Real>::count;
      V r2{}, d2{};
      for (int d = 0; d < D; ++d) {
        const V gap = u[d][v] - load(now_.u[d].data() + at);
        store(out.u[d].data() + at, u[d][v]);
        r2 += u[d][v] * u[d][v];
        d2 += gap * gap;
      }
      const V on = load(given_.mask.data() + at);
      change = greatest(on * d2, change);
      reach = greatest(on * r2, reach);
    }
  }

  // ---- The plane: kept columns --------------------------------------------------------------------------------------------------------

  /// Compute a column into a slot, less that of its bases. For the thin plate, whose far field is the small rest of large terms, in double: what
  /// a kept column lacks stays in every field.
  void keep_column(int64_t slot, const Vec<D>& p, const Bases<D>& base, const double* held) {
    typedef std::conditional_t<scalar, double, Real> Number;
    typedef Vector<Number> N;
    constexpr int lanes = Lanes<Number>::count;
    constexpr int64_t part = VECTORS * lanes;
    const int64_t ld = anchored_.ld;
    for (int64_t first = 0; first < points_.room(); first += part) {
      const int64_t b = first / block, within = first % block;
      N a[c][planes_of][VECTORS];
      for (int v = 0; v < VECTORS; ++v) {
        N x[D], to_p[D], to_base[D], U[size][size], other[size][size];
        for (int d = 0; d < D; ++d) {
          x[d] = load_as<Number>(points_.x[d].data() + first + v * lanes);
          to_p[d] = x[d] - static_cast<Number>(p[d]);
        }
        given_.kernel.at(to_p, U);
        for (int e = 0; e < c; ++e) {
          if (e == 0 || !base.one) {
            for (int d = 0; d < D; ++d) to_base[d] = x[d] - static_cast<Number>(base.place[e][d]);
            given_.kernel.at(to_base, other);
          }
          for (int d = 0; d < planes_of; ++d) a[e][d][v] = U[d][e % size] - other[d][e % size];
        }
      }
      const Real* t = table(b) + within;
      for (int s = 0; s < (apart ? c : 1); ++s)
        for (int64_t i = 0; i < anchored_.order(s); ++i)
          for (int d = 0; d < planes_of; ++d, t += block)
            for (int v = 0; v < VECTORS; ++v) {
              const N value = load_as<Number>(t + v * lanes);
              for (int e = s; e < (apart ? s + 1 : c); ++e) a[e][d][v] -= static_cast<Number>(held[e * ld + i]) * value;
            }
      Real* out = column(b, slot) + within;
      for (int e = 0; e < c; ++e)
        for (int d = 0; d < planes_of; ++d)
          for (int v = 0; v < VECTORS; ++v) store_as(out + (e * planes_of + d) * block + v * lanes, a[e][d][v]);
    }
  }

  Largest by_columns(const Weights<D>& given, Planes<D, Real>& out) {
    const int64_t ld = anchored_.ld;
    int64_t rows = given.count * c;
    constexpr int lanes = Lanes<Real>::count;
    Real* weight = weights_.data();
    Real* h = weight + (room_ + 1) * c * D;
    // one weight per number of a column: (contact, component of the source), then the component of the field where one scalar serves all
    for (int64_t j = 0; j < rows; ++j)
      for (int r = 0; r < sides; ++r) weight[j * sides + r] = static_cast<Real>(given.carried[r * given.ld + j]);
    Real s[D];
    for (int d = 0; d < D; ++d) s[d] = static_cast<Real>(given.s[d]);
    bool tip = given.tip;
    if (tip && scalar && shares(given) > CAREFUL) {
      keep_column(given.count, given.place, given.base, given.held);
      for (int d = 0; d < D; ++d) weight[rows * sides + d] = s[d];
      tip = false, rows += c;
    }
    for (int a = 0; tip && a < (apart ? c : 1); ++a)
      for (int64_t i = 0; i < anchored_.order(a); ++i) {
        double sum = 0;
        if constexpr (scalar)
          sum = given.held[a * ld + i];
        else
          for (int e = 0; e < c; ++e) sum += given.held[e * ld + i] * given.s[e];
        h[a * ld + i] = static_cast<Real>(sum);
      }
    V change{}, reach{};
    for (int64_t b = 0; b < points_.blocks; ++b) {
      V u[D][VECTORS] = {};
      if (tip) tip_block(b, given.place, given.base, h, s, u);
      const Real* e = column(b, 0);
      const Real* f = weight;
      for (int64_t j = 0; j < rows; j += apart ? c : 1) {
        if constexpr (c == 1) {
          for (int v = 0; v < VECTORS; ++v) {
            const V value = load(e + v * lanes);
            for (int d = 0; d < D; ++d) u[d][v] += f[d] * value;
          }
          e += block, f += D;
        } else if constexpr (apart) {
          for (int d = 0; d < D; ++d, e += block, ++f)
            for (int v = 0; v < VECTORS; ++v) u[d][v] += f[0] * load(e + v * lanes);
        } else {
          for (int d = 0; d < D; ++d, e += block)
            for (int v = 0; v < VECTORS; ++v) u[d][v] += f[0] * load(e + v * lanes);
          ++f;
        }
      }
      finish_block(b, u, out, change, reach);
    }
    return {largest<Real>(change), largest<Real>(reach)};
  }
  /// Weight of a tip times the sum of the anchors' shares in its column, regardless of sign; the largest of the components that are apart.
  double shares(const Weights<D>& given) const {
    double most = 0;
    for (int a = 0; a < (apart ? c : 1); ++a) {
      double sum = 0;
      for (int64_t i = 0; i < anchored_.held_by(a); ++i) sum += std::fabs(given.held[a * anchored_.ld + i]);
      most = larger(most, sum * (apart ? std::fabs(given.s[a]) : norm(given.s)));
    }
    return most;
  }

  /// Kernel at one vector of points from a tip less from its base: U_:p - U_:q.
  ECHOSPLINE_INLINE void kernel_difference(int64_t at, const Vec<D>& p, const Vec<D>& q, V (&U)[size][size]) const {
    V to_p[D], to_q[D];
    for (int d = 0; d < D; ++d) {
      const V x = load(points_.x[d].data() + at);
      const Real near_p = static_cast<Real>(p[d]),
                 near_q = static_cast<Real>(q[d]);  // and what rounding has taken from them
      to_p[d] = (x - near_p) - static_cast<Real>(p[d] - near_p),
      to_q[d] = (x - near_q) - static_cast<Real>(q[d] - near_q);
    }
    if constexpr (D == 2 && scalar && sizeof(Real) == 4) {
      V r2{}, other2{}, less{};
      for (int d = 0; d < D; ++d) {
        r2 += to_p[d] * to_p[d], other2 += to_q[d] * to_q[d];
        less += static_cast<Real>(q[d] - p[d]) * (to_p[d] + to_q[d]);
      }
      U[0][0] = Kernel::difference(r2, other2, less);
    } else {
      V other[size][size];
      given_.kernel.at(to_p, U);
      given_.kernel.at(to_q, other);
      for (int a = 0; a < size; ++a)
        for (int e = 0; e < size; ++e) U[a][e] -= other[a][e];
    }
  }
  /// The tip's part of one block, relative to landmarks: (G_:p - G_:q) s.
  ECHOSPLINE_INLINE void tip_block(int64_t b, const Vec<D>& p, const Bases<D>& q, const Real* h, const Real (&s)[D],
                                   V (&u)[D][VECTORS]) const {
    constexpr int lanes = Lanes<Real>::count, planes = apart ? c : planes_of;
    V a[planes][VECTORS];
    for (int v = 0; v < VECTORS; ++v) {
      V U[size][size];
      kernel_difference(b * block + v * lanes, p, q.place[0], U);
      for (int d = 0; d < planes; ++d) {
        if constexpr (scalar) {
          a[d][v] = U[0][0];
        } else {
          a[d][v] = U[d][0] * s[0];
          for (int e = 1; q.one && e < c; ++e) a[d][v] += U[d][e] * s[e];
        }
      }
      for (int e = 1; !q.one && e < c; ++e) {
        kernel_difference(b * block + v * lanes, p, q.place[e], U);
        if constexpr (scalar)
          a[e][v] = U[0][0];
        else
          for (int d = 0; d < planes; ++d) a[d][v] += U[d][e] * s[e];
      }
    }
    const Real* t = table(b);
    for (int system = 0; system < (apart ? c : 1); ++system) {
      const Real* own = h + system * anchored_.ld;
      for (int64_t i = 0; i < anchored_.order(system); ++i)
        for (int d = system; d < (apart ? system + 1 : planes); ++d, t += block)
          for (int v = 0; v < VECTORS; ++v) a[d][v] -= own[i] * load(t + v * lanes);
    }
    for (int d = 0; d < D; ++d)
      for (int v = 0; v < VECTORS; ++v) u[d][v] = scalar ? s[d] * a[apart ? d : 0][v] : a[scalar ? 0 : d][v];
  }

  // ---- Anywhere: kernels evaluated where the field is wanted ------------------------------------------------------------------------------

  Largest by_kernels(const Weights<D>& given, Planes<D, Real>& out) {
    if constexpr (!keeps_columns) {
      gather(given.landmarks);
      V change{}, reach{};
      for (int64_t b = 0; b < points_.blocks; ++b) {
        Real x[D][block];
        V u[D][VECTORS];
        for (int d = 0; d < D; ++d) std::memcpy(x[d], points_.x[d].data() + b * block, sizeof x[d]);
        evaluate_block(given.landmarks.count, x, u);
        finish_block(b, u, out, change, reach);
      }
      return {largest<Real>(change), largest<Real>(reach)};
    }
    return {};
  }
  /// Landmarks as the evaluation reads them: (place, weight) of each, then the motions' coefficients.
  void gather(const LandmarkWeights<D>& landmarks) {
    for (int64_t i = 0; i < landmarks.count; ++i)
      for (int d = 0; d < D; ++d) {
        gathered_[i * 2 * D + d] = static_cast<Direct>(landmarks.place[i * D + d]);
        gathered_[i * 2 * D + D + d] = static_cast<Direct>(landmarks.weight[i * D + d]);
      }
    for (int64_t j = 0; j < Kernel::motions * D; ++j)
      gathered_[landmarks.count * 2 * D + j] = static_cast<Direct>(landmarks.weight[landmarks.count * D + j]);
  }
  template <class Place, class Put>
  void evaluate_at(const LandmarkWeights<D>& landmarks, int64_t count, Place place, Put put) {
    constexpr int lanes = Lanes<Direct>::count;
    if (landmarks.count) gather(landmarks);
    for (int64_t first = 0; first < count; first += direct_block) {
      Direct x[D][direct_block];
      for (int64_t i = 0; i < direct_block; ++i) {
        const Vec<D> p = anchored_.conditioned(place(smaller(first + i, count - 1)));
        for (int d = 0; d < D; ++d) x[d][i] = static_cast<Direct>(p[d]);
      }
      Vector<Direct> u[D][VECTORS] = {};
      if (landmarks.count) evaluate_block(landmarks.count, x, u);
      for (int64_t i = 0; i < smaller(direct_block, count - first); ++i)
        for (int d = 0; d < D; ++d) put(first + i, d, u[d][i / lanes][i % lanes]);
    }
  }
  /// Field of the gathered landmarks at one block of conditioned points.
  __attribute__((noinline)) void evaluate_block(int64_t count, const Direct (&points)[D][direct_block],
                                                Vector<Direct> (&u)[D][VECTORS]) const {
    typedef Vector<Direct> N;
    N x[D][VECTORS];
    for (int d = 0; d < D; ++d)
      for (int v = 0; v < VECTORS; ++v) x[d][v] = load(points[d] + v * Lanes<Direct>::count);
    const Direct* a = gathered_.data() + count * 2 * D;
    for (int d = 0; d < D; ++d)
      for (int v = 0; v < VECTORS; ++v) {
        if constexpr (scalar) {
          u[d][v] = all<Direct>(a[d]);
          for (int e = 0; e < D; ++e) u[d][v] += a[(e + 1) * D + d] * x[e][v];
        } else if constexpr (D == 2) {
          u[d][v] = a[d * D] + (d == 0 ? -a[2 * D] : a[2 * D]) * x[1 - d][v];
        } else {
          const Direct about_z = a[3 * D], about_x = a[4 * D], about_y = a[5 * D];
          u[d][v] = a[d * D] + (d == 0   ? about_y * x[2][v] - about_z * x[1][v]
                                : d == 1 ? about_z * x[0][v] - about_x * x[2][v]
                                         : about_x * x[1][v] - about_y * x[0][v]);
        }
      }
    N lost[D][VECTORS] = {};
    for (int64_t first = 0; first < count; first += GROUP) {
      N sum[D][VECTORS] = {};
      const Direct* p = gathered_.data() + first * 2 * D;
      const Direct* end = gathered_.data() + smaller(first + GROUP, count) * 2 * D;
      for (; p < end; p += 2 * D)
        for (int v = 0; v < VECTORS; ++v) {
          N offset[D], own[D];
          for (int d = 0; d < D; ++d) offset[d] = x[d][v] - p[d], own[d] = sum[d][v];
          given_.kernel.respond(offset, p + D, own);
          for (int d = 0; d < D; ++d) sum[d][v] = own[d];
        }
      for (int d = 0; d < D; ++d)
        for (int v = 0; v < VECTORS; ++v) {
          const N more = sum[d][v] - lost[d][v], next = u[d][v] + more;
          lost[d][v] = (next - u[d][v]) - more;
          u[d][v] = next;
        }
    }
  }
};

template <int D, class Kernel, class Real>
SessionField<D>* FieldScene<D, Kernel, Real>::create_session() const {
  void* memory = std::malloc(sizeof(FieldOf<D, Kernel, Real>));
  if (!memory) return nullptr;
  FieldOf<D, Kernel, Real>* made = new (memory) FieldOf<D, Kernel, Real>(*this);
  if (made->build()) return made;
  made->destroy();
  return nullptr;
}

/// The field of a scene, or nullptr when memory runs out.
template <int D, class Kernel, class Real>
SceneField<D>* create_field(const Scene<D>& scene) {
  void* memory = std::malloc(sizeof(FieldScene<D, Kernel, Real>));
  if (!memory) return nullptr;
  FieldScene<D, Kernel, Real>* made = new (memory) FieldScene<D, Kernel, Real>(scene);
  if (made->build()) return made;
  made->destroy();
  return nullptr;
}

}  // namespace echospline::ECHOSPLINE_CORE
