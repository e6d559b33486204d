// How the tissue answers the landmarks that move: kept between steps, updated when contacts come and go.
//
// With the anchors held, contacts C with displacements q and a tip at p with displacement t move a point by
//
//   G_:C w + G_:p s,   s = (G_pp - g' P g + soft)^-1 (t - g' P q),   w = P (q - g s),   g = G_Cp,   P = (G_CC + soft)^-1
//
// P is small, double, bordered when a contact joins and reduced when one leaves. In the plane the columns G_:c of the contacts are kept, each
// computed once, and the tip's column is evaluated at every step. In space nothing of the mesh's size is kept: kernels are evaluated
// where the field is wanted.
//
// Weights of landmarks that stand close together are large and of both signs. So that single precision is enough, a column is kept as its
// difference to that of the nearest landmark at the time it joined, its parent: an anchor, whose column is zero, or another contact, which
// then carries its children's weights beside its own. Where kernels are evaluated directly, sums of groups of landmarks are compensated
// (Kahan), and the thin plate in the plane, whose terms are far larger than their sum, is evaluated in double.
#pragma once
#include "anchored_kernel.hpp"

namespace echospline::ECHOSPLINE_CORE {

constexpr double RESIDUAL = 1e-6;  // mm; misfit at the landmarks, for displacements of 1 mm, at which P is made anew
constexpr double CAREFUL = 35;    // weight times sum of anchors' shares beyond which a tip's column is computed in double: its last digits
                                   // would be more than 1e-5 mm of the field
constexpr int VECTORS = 4;         // registers whose sums one pass over the landmarks fills
constexpr int64_t GROUP = 16;      // landmarks summed plainly before sums are compensated; more: less exact, fewer: slower

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

/// A field at `Points`: one plane of numbers per component, mm.
template <int D, class Real>
struct Field {
  Array<Real> u[D];

  bool reserve(int64_t room) {
    for (int d = 0; d < D; ++d)
      if (!u[d].reserve(room)) return false;
    return true;
  }
  void clear() {
    for (int d = 0; d < D; ++d) std::memset(u[d].data(), 0, static_cast<size_t>(u[d].size()) * sizeof(Real));
  }
  void swap(Field& other) {
    for (int d = 0; d < D; ++d) u[d].swap(other.u[d]);
  }
  Vec<D> at(int64_t i) const {
    Vec<D> p;
    for (int d = 0; d < D; ++d) p[d] = u[d][i];
    return p;
  }
};

/// [U_xB P_x] at points: what every column of G needs of them. Kept in the plane alone.
template <int D, class Kernel, class Real>
struct Table {
  static constexpr int c = Kernel::components;
  static constexpr int64_t block = Points<D, Real>::block;
  Array<Real> values;  ///< (blocks, order, c, block)

  bool build(const AnchoredKernel<D, Kernel>& anchored, const Points<D, Real>& points) {
    Array<double> rows;
    const int64_t m = anchored.order;
    if (!values.reserve(points.blocks * m * c * block) || !rows.reserve(c * anchored.ld)) return false;
    for (int64_t j = 0; j < points.room(); ++j) {
      Vec<D> p;
      for (int d = 0; d < D; ++d) p[d] = points.x[d][j];
      anchored.felt(p, rows.data());
      Real* out = values.data() + j / block * m * c * block + j % block;
      for (int64_t i = 0; i < m; ++i)
        for (int a = 0; a < c; ++a, out += block) *out = static_cast<Real>(rows[a * anchored.ld + i]);
    }
    return true;
  }
};

/// Displacements of landmarks as right-hand sides: one for each component where one scalar serves all, else one with all components.
template <int D, int c>
struct Sides {
  static constexpr int count = c == 1 ? D : 1;
  int64_t ld = 0;
  Array<double> values;  ///< (count, ld), zero beyond the contacts

  bool reserve(int64_t length) {
    ld = length;
    return values.reserve(count * length);
  }
  double* side(int r) { return values.data() + r * ld; }
  const double* side(int r) const { return values.data() + r * ld; }
  void set(int64_t slot, const Vec<D>& q) {
    for (int d = 0; d < D; ++d) (c == 1 ? values[d * ld + slot] : values[slot * D + d]) = q[d];
  }
  Vec<D> get(int64_t slot) const {
    Vec<D> q;
    for (int d = 0; d < D; ++d) q[d] = c == 1 ? values[d * ld + slot] : values[slot * D + d];
    return q;
  }
};

/// A point that moves at every step, seen by the contacts.
template <int D, int c>
struct Column {
  Vec<D> place;  ///< conditioned
  int64_t ld = 0, ldk = 0;
  Array<double> felt, held;  ///< [U_pB P_p] and L_B^-1 of it, (c, ld)
  Array<double> g, Pg;       ///< G_Cp and P of it, (c, ldk)
  double own[c][c];          ///< G_pp - g' P g

  bool reserve(int64_t length, int64_t contacts) {
    ld = length, ldk = contacts;
    return felt.reserve(c * ld) && held.reserve(c * ld) && g.reserve(c * ldk) && Pg.reserve(c * ldk);
  }
};

/// Solve a small system that couples the components.
inline void solve_small(const double (&A)[1][1], double* x) { x[0] /= A[0][0]; }
template <int n>
inline void solve_small(const double (&A)[n][n], double* x) {
  double L[n][n], y[n];
  for (int i = 0; i < n; ++i)
    for (int j = 0; j <= i; ++j) {
      double s = 0.5 * (A[i][j] + A[j][i]);
      for (int l = 0; l < j; ++l) s -= L[i][l] * L[j][l];
      L[i][j] = i == j ? std::sqrt(s) : s / L[j][j];
    }
  for (int i = 0; i < n; ++i) {
    y[i] = x[i];
    for (int l = 0; l < i; ++l) y[i] -= L[i][l] * y[l];
    y[i] /= L[i][i];
  }
  for (int i = n; i-- > 0;) {
    x[i] = y[i];
    for (int l = i + 1; l < n; ++l) x[i] -= L[l][i] * x[l];
    x[i] /= L[i][i];
  }
}

/// What is kept of the contacts in one session.
template <int D, class Kernel, class Real>
class Response {
 public:
  static constexpr int c = Kernel::components;
  static constexpr bool keeps_columns = D == 2;
  static constexpr bool by_difference = D == 2 && c == 1 && sizeof(Real) == 4;
  static constexpr int64_t planes = c == 1 ? 1 : D;  ///< of a column per component of its source
  static constexpr int64_t block = Points<D, Real>::block;
  typedef std::conditional_t<D == 2 && c == 1, double, Real> Direct;  ///< in which kernels are evaluated directly
  typedef AnchoredKernel<D, Kernel> Anchored;
  typedef Column<D, c> Tip;
  typedef Sides<D, c> Displacements;

  int64_t count = 0;           ///< contacts, k
  int64_t room = 0;            ///< contacts for which there is memory
  int64_t ldk = 0;             ///< scalars in a row of P
  Array<int32_t> source_of;    ///< (room)
  Array<int32_t> slot_of;      ///< of every source, or -1
  Array<Vec<D>> place;         ///< conditioned, (room)
  Array<double> felt, held;    ///< of the contacts, (room c, ld)
  Array<double> gram, P;       ///< (room c, ldk)
  Array<int32_t> parent;       ///< slot whose column a contact's is relative to; negative: an anchor's; (room)
  Array<int32_t> by_age;       ///< slots, the oldest first: parents stand before their children
  Array<Real> columns;         ///< less the parent's, in the plane: (blocks, room + 1, c, planes, block); the last for a tip
  Array<Real> row_weights;     ///< as `field` reads them
  double residual = 0;
  int64_t rebuilt = 0;

  bool build(const Anchored* anchored, const Points<D, Real>* points, const Table<D, Kernel, Real>* table, int64_t sources,
             int64_t contacts) {
    anchored_ = anchored, points_ = points, table_ = table;
    if (!slot_of.reserve(sources)) return false;
    for (int64_t i = 0; i < sources; ++i) slot_of[i] = -1;
    return border_.reserve(anchored->ld, 0) && reserve(contacts);
  }

  /// Make room for contacts; what is kept stays. False when memory runs out, and nothing has changed.
  bool reserve(int64_t contacts) {
    if (contacts <= room) return true;
    const int64_t wide = rounded_up(contacts * c, ROW), ld = anchored_->ld;
    Array<int32_t> new_source, new_parent, new_by_age;
    Array<Vec<D>> new_place;
    Array<double> new_felt, new_held, new_gram, new_P;
    Array<Real> new_columns, new_weights;
    Tip border;
    const int64_t kept_columns = keeps_columns ? points_->blocks * (contacts + 1) * c * planes * block : 0;
    if (!new_source.reserve(contacts) || !new_parent.reserve(contacts) || !new_by_age.reserve(contacts) || !new_place.reserve(contacts) || !new_felt.reserve(contacts * c * ld) ||
        !new_held.reserve(contacts * c * ld) || !new_gram.reserve(contacts * c * wide) || !new_P.reserve(contacts * c * wide) ||
        !new_columns.reserve(kept_columns) || !new_weights.reserve(((contacts + 1) * c + anchored_->order) * D) ||
        !border.reserve(ld, wide) || !carried_.reserve(wide))
      return false;
    for (int64_t i = 0; i < count; ++i)
      new_source[i] = source_of[i], new_place[i] = place[i], new_parent[i] = parent[i], new_by_age[i] = by_age[i];
    for (int64_t i = 0; i < count * c; ++i) {
      std::memcpy(&new_felt[i * ld], &felt[i * ld], static_cast<size_t>(ld) * sizeof(double));
      std::memcpy(&new_held[i * ld], &held[i * ld], static_cast<size_t>(ld) * sizeof(double));
      std::memcpy(&new_gram[i * wide], &gram[i * ldk], static_cast<size_t>(count * c) * sizeof(double));
      std::memcpy(&new_P[i * wide], &P[i * ldk], static_cast<size_t>(count * c) * sizeof(double));
    }
    if (keeps_columns && count)
      for (int64_t b = 0; b < points_->blocks; ++b)
        std::memcpy(&new_columns[b * (contacts + 1) * c * planes * block], &columns[b * (room + 1) * c * planes * block],
                    static_cast<size_t>(count * c * planes * block) * sizeof(Real));
    source_of.swap(new_source), place.swap(new_place), felt.swap(new_felt), held.swap(new_held), gram.swap(new_gram), P.swap(new_P);
    columns.swap(new_columns), row_weights.swap(new_weights), parent.swap(new_parent), by_age.swap(new_by_age);
    border_.felt.swap(border.felt), border_.held.swap(border.held), border_.g.swap(border.g), border_.Pg.swap(border.Pg);
    border_.ld = ld, border_.ldk = wide;
    room = contacts, ldk = wide;
    return true;
  }

  /// G of a point with the contacts, and what of its own response the contacts leave.
  void meet(const Vec<D>& p, Tip& tip) const {
    tip.place = p;
    anchored_->felt(p, tip.felt.data());
    anchored_->held(tip.felt.data(), tip.held.data());
    meet_contacts(tip);
  }

  /// Field of contacts with displacements q alone, at a point that has been met: g' P q.
  Vec<D> at(const Tip& tip, const Displacements& q) const {
    Vec<D> u;
    for (int d = 0; d < D; ++d)
      u[d] = c == 1 ? dot(tip.Pg.data(), q.side(d), width()) : dot(tip.Pg.data() + d * ldk, q.side(0), width());
    return u;
  }
  /// Weight s of a tip with displacement t among contacts with displacements q.
  Vec<D> tip_weight(const Tip& tip, const Displacements& q, const Vec<D>& t, double softness) const {
    Vec<D> s = t - at(tip, q);
    double own[c][c];
    for (int a = 0; a < c; ++a)
      for (int e = 0; e < c; ++e) own[a][e] = tip.own[a][e] + (a == e ? softness : 0);
    if constexpr (c == 1)
      for (int d = 0; d < D; ++d) solve_small(own, &s[d]);
    else
      solve_small(own, s.v);
    return s;
  }
  /// Weights w = P (q - g s) of the contacts; without a tip w = P q.
  void weights(const Displacements& q, const Tip* tip, const Vec<D>& s, Displacements& w) const {
    const int64_t n = width();
    for (int r = 0; r < Displacements::count; ++r)
      for (int64_t i = 0; i < count * c; ++i) w.side(r)[i] = dot(P.data() + i * ldk, q.side(r), n);
    if (tip)
      for (int d = 0; d < D; ++d) add(w.side(c == 1 ? d : 0), -s[d], tip->Pg.data() + (c == 1 ? 0 : d * ldk), n);
  }

  /// Add a contact at a source; false where it cannot be told apart from the others. There must be room.
  bool join(int32_t source, const Vec<D>& p, double softness) {
    const int64_t k = count, kc = k * c, ld = anchored_->ld;
    meet(p, border_);
    double S[c][c];
    for (int a = 0; a < c; ++a)
      for (int e = 0; e < c; ++e) S[a][e] = 0.5 * (border_.own[a][e] + border_.own[e][a]) + (a == e ? softness : 0);
    double V[c][c];
    if (!small_inverse(S, V)) return false;
    source_of[k] = source, slot_of[source] = static_cast<int32_t>(k), place[k] = p;
    for (int a = 0; a < c; ++a) {
      std::memcpy(&felt[(kc + a) * ld], &border_.felt[a * ld], static_cast<size_t>(ld) * sizeof(double));
      std::memcpy(&held[(kc + a) * ld], &border_.held[a * ld], static_cast<size_t>(ld) * sizeof(double));
    }
    double own[c][c];
    anchored_->green(p, border_.felt.data(), p, border_.held.data(), own);
    for (int a = 0; a < c; ++a) {
      for (int64_t i = 0; i < kc; ++i) gram[(kc + a) * ldk + i] = gram[i * ldk + kc + a] = border_.g[a * ldk + i];
      for (int e = 0; e < c; ++e) gram[(kc + a) * ldk + kc + e] = 0.5 * (own[a][e] + own[e][a]) + (a == e ? softness : 0);
    }
    // the inverse of a bordered matrix: P + (P g) V (P g)', -(P g) V, V
    double f[c];
    for (int64_t i = 0; i < kc; ++i) {
      for (int a = 0; a < c; ++a) {
        f[a] = 0;
        for (int e = 0; e < c; ++e) f[a] += V[a][e] * border_.Pg[e * ldk + i];
      }
      double* row = P.data() + i * ldk;
      for (int a = 0; a < c; ++a) add(row, f[a], border_.Pg.data() + a * ldk, rounded_up(kc, ROW));
      for (int a = 0; a < c; ++a) row[kc + a] = P[(kc + a) * ldk + i] = -f[a];
    }
    for (int a = 0; a < c; ++a)
      for (int e = 0; e < c; ++e) P[(kc + a) * ldk + kc + e] = V[a][e];
    const Base base = nearest(p);
    parent[k] = static_cast<int32_t>(base.slot), by_age[k] = static_cast<int32_t>(k);
    count = k + 1;
    if constexpr (keeps_columns) keep_column(k, p, base);
    return true;
  }

  /// Remove the contact in a slot; the last one takes its place.
  void leave(int64_t slot) {
    const int64_t k = count, kc = k * c, last = k - 1, ld = anchored_->ld;
    // reduce: P_rest - P_r,j P_jj^-1 P_j,r
    double S[c][c], V[c][c];
    for (int a = 0; a < c; ++a)
      for (int e = 0; e < c; ++e) S[a][e] = P[(slot * c + a) * ldk + slot * c + e];
    if (small_inverse(S, V)) {
      for (int64_t i = 0; i < kc; ++i) {
        if (i / c == slot) continue;
        double f[c];
        for (int a = 0; a < c; ++a) {
          f[a] = 0;
          for (int e = 0; e < c; ++e) f[a] -= P[i * ldk + slot * c + e] * V[e][a];
        }
        for (int a = 0; a < c; ++a) add(P.data() + i * ldk, f[a], P.data() + (slot * c + a) * ldk, rounded_up(kc, ROW));
      }
    }
    leave_family(slot, last);
    move_last(P, slot, last);
    move_last(gram, slot, last);
    slot_of[source_of[slot]] = -1;
    if (slot != last) {
      source_of[slot] = source_of[last], slot_of[source_of[slot]] = static_cast<int32_t>(slot), place[slot] = place[last];
      std::memcpy(&felt[slot * c * ld], &felt[last * c * ld], static_cast<size_t>(c * ld) * sizeof(double));
      std::memcpy(&held[slot * c * ld], &held[last * c * ld], static_cast<size_t>(c * ld) * sizeof(double));
      if constexpr (keeps_columns)
        for (int64_t b = 0; b < points_->blocks; ++b)
          std::memcpy(column(b, slot), column(b, last), static_cast<size_t>(c * planes * block) * sizeof(Real));
    }
    count = last;
  }

  /// Whether the contacts' displacements are met to RESIDUAL, after making P anew where rounding has grown.
  bool check(Displacements& d, Displacements& w) {
    double misfit = misfit_of(d, w);
    if (!(misfit <= RESIDUAL)) {
      ++rebuilt;
      if (!rebuild()) return false;
      misfit = misfit_of(d, w);
    }
    residual = larger(residual, misfit);
    return misfit <= RESIDUAL;
  }

  /// Largest squares of the change since `was` and of the field, where `mask` is 1.
  struct Largest {
    double change2, reach2;
  };
  /// Field at the points, mm: weights w of the contacts, s of a tip. What is computed at padding is not to be read.
  Largest field(const Displacements& w, const Tip* tip, const Vec<D>& s, const Field<D, Real>& was, const Array<Real>& mask,
                Field<D, Real>& out) {
    if constexpr (keeps_columns)
      return field_by_columns(w, tip, s, was, mask, out);
    else
      return field_by_kernels(w, tip, s, was, mask, out);
  }

  /// Weights of all landmarks as kernels at their places: anchors, contacts, tip; then the motions. (landmarks + motions, D) numbers.
  int64_t landmarks(const Displacements& w, const Tip* tip, const Vec<D>& s, Array<double>& places, Array<double>& weights) const {
    const int64_t b = anchored_->anchors, m = anchored_->order, total = b + count + (tip ? 1 : 0);
    for (int64_t i = 0; i < b; ++i)
      for (int d = 0; d < D; ++d) places[i * D + d] = anchored_->place[d][i];
    for (int64_t j = 0; j < count; ++j)
      for (int d = 0; d < D; ++d) {
        places[(b + j) * D + d] = place[j][d];
        weights[(b + j) * D + d] = c == 1 ? w.side(d)[j] : w.side(0)[j * D + d];
      }
    if (tip)
      for (int d = 0; d < D; ++d) places[(b + count) * D + d] = tip->place[d], weights[(b + count) * D + d] = s[d];
    // anchors and motions: -(held w + held_tip s)
    for (int r = 0; r < Displacements::count; ++r)
      for (int64_t i = 0; i < m; ++i) {
        double sum = 0;
        for (int64_t j = 0; j < count * c; ++j) sum -= held[j * anchored_->ld + i] * w.side(r)[j];
        if (tip)
          for (int a = 0; a < c; ++a) sum -= tip->held[a * anchored_->ld + i] * s[c == 1 ? r : a];
        if (i >= b * c) {
          weights[(total + i - b * c) * D + r] = sum;
          continue;
        }
        // the weight of a difference is that of the anchor, and less that of its parent, which stands before it
        const int d = c == 1 ? r : static_cast<int>(i / b);
        const int64_t anchor = i % b, from = anchored_->parent[anchor];
        weights[anchor * D + d] = sum;
        if (from >= 0) weights[from * D + d] -= sum;
      }
    return total;
  }
  int64_t landmark_room() const { return anchored_->anchors + room + 1 + Kernel::motions; }

 private:
  const Anchored* anchored_ = nullptr;
  const Points<D, Real>* points_ = nullptr;
  const Table<D, Kernel, Real>* table_ = nullptr;
  Tip border_;
  Displacements carried_;  ///< weights of contacts and all their descendants

  int64_t width() const { return rounded_up(count * c, ROW); }
  Real* column(int64_t block_index, int64_t slot) {
    return columns.data() + (block_index * (room + 1) + slot) * c * planes * block;
  }

  void meet_contacts(Tip& tip) const {
    const int64_t n = width(), ld = anchored_->ld;
    for (int64_t j = 0; j < count; ++j) {
      double G[c][c];
      anchored_->green(place[j], felt.data() + j * c * ld, tip.place, tip.held.data(), G);
      for (int a = 0; a < c; ++a)
        for (int e = 0; e < c; ++e) tip.g[a * ldk + j * c + e] = G[e][a];
    }
    for (int a = 0; a < c; ++a) {
      for (int64_t i = count * c; i < n; ++i) tip.g[a * ldk + i] = tip.Pg[a * ldk + i] = 0;
      for (int64_t i = 0; i < count * c; ++i) tip.Pg[a * ldk + i] = dot(P.data() + i * ldk, tip.g.data() + a * ldk, n);
    }
    anchored_->green(tip.place, tip.felt.data(), tip.place, tip.held.data(), tip.own);
    for (int a = 0; a < c; ++a)
      for (int e = 0; e < c; ++e) tip.own[a][e] -= dot(tip.g.data() + a * ldk, tip.Pg.data() + e * ldk, n);
  }

  static bool small_inverse(const double (&S)[c][c], double (&V)[c][c]) {
    double trace = 0;
    for (int a = 0; a < c; ++a) trace += S[a][a];
    if (!(trace > 0)) return false;
    for (int e = 0; e < c; ++e) {
      double x[c] = {};
      x[e] = 1;
      solve_small(S, x);
      for (int a = 0; a < c; ++a) V[a][e] = x[a];
    }
    for (int a = 0; a < c; ++a)
      if (!(V[a][a] > 0)) return false;
    return true;
  }

  /// Give a contact's children to its parent before the contact goes and the last slot is renamed.
  void leave_family(int64_t slot, int64_t last) {
    const int32_t gone = static_cast<int32_t>(slot);
    for (int64_t j = 0; j < count; ++j)
      if (parent[j] == gone) {
        parent[j] = parent[slot];
        if constexpr (keeps_columns)
          for (int64_t b = 0; b < points_->blocks; ++b) {
            Real* child = column(b, j);
            const Real* own = column(b, slot);
            for (int64_t i = 0; i < c * planes * block; i += Lanes<Real>::count) store(child + i, load(child + i) + load(own + i));
          }
      }
    int64_t at = 0;
    for (int64_t i = 0; i < count; ++i)
      if (by_age[i] != gone) by_age[at++] = by_age[i] == static_cast<int32_t>(last) ? gone : by_age[i];
    for (int64_t j = 0; j < count; ++j)
      if (parent[j] == static_cast<int32_t>(last)) parent[j] = gone;
    parent[slot] = parent[last];
  }
  /// Landmark that another's column is relative to.
  struct Base {
    Vec<D> place;    ///< conditioned
    int64_t slot;    ///< of a contact, or negative
    int64_t anchor;  ///< or negative

  };
  /// Landmark nearest to a conditioned point.
  Base nearest(const Vec<D>& p) const {
    Base base{{}, -1, -1};
    double least = INFINITY;
    for (int64_t j = 0; j < count; ++j) {
      const Vec<D> gap = place[j] - p;
      if (dot(gap, gap) < least) least = dot(gap, gap), base = {place[j], j, -1};
    }
    for (int64_t i = 0; i < anchored_->anchors; ++i) {
      Vec<D> at;
      for (int d = 0; d < D; ++d) at[d] = anchored_->place[d][i];
      const Vec<D> gap = at - p;
      if (dot(gap, gap) < least) least = dot(gap, gap), base = {at, -1, i};
    }
    return base;
  }
  /// L_B^-1 [U P]' of a point less that of a base, (c, ld). That of an anchor is 1 for itself and all its ancestors, for their kernels are
  /// differences.
  void subtract_held(const Base& base, double* rows) const {
    const int64_t ld = anchored_->ld;
    for (int e = 0; e < c; ++e) {
      if (base.slot >= 0)
        add(rows + e * ld, -1, held.data() + (base.slot * c + e) * ld, ld);
      else
        for (int64_t i = base.anchor; i >= 0; i = anchored_->parent[i]) rows[e * ld + e * anchored_->anchors + i] -= 1;
    }
  }

  /// Sum of the anchors' shares in a column relative to a base, regardless of sign; `rows` is L_B^-1 [U P]' of the landmark.
  double shares(const Base& base, const double* rows) const {
    double sum = 0;
    const double* other = base.slot >= 0 ? held.data() + base.slot * c * anchored_->ld : nullptr;
    for (int64_t i = 0; i < anchored_->anchors; ++i) sum += std::fabs(rows[i] - (other ? other[i] : 0.0));
    for (int64_t i = base.slot >= 0 ? -1 : base.anchor; i >= 0; i = anchored_->parent[i]) sum += std::fabs(rows[i] - 1) - std::fabs(rows[i]);
    return sum;
  }

  /// Row and column of the last contact in place of those of a slot, and zeros where they were.
  void move_last(Array<double>& A, int64_t slot, int64_t last) {
    for (int64_t i = 0; i < (last + 1) * c; ++i)
      for (int a = 0; a < c; ++a) {
        A[i * ldk + slot * c + a] = A[i * ldk + last * c + a];
        if (slot != last || true) A[i * ldk + last * c + a] = 0;
      }
    for (int a = 0; a < c; ++a) {
      if (slot != last)
        std::memcpy(&A[(slot * c + a) * ldk], &A[(last * c + a) * ldk], static_cast<size_t>(ldk) * sizeof(double));
    }
    for (int a = 0; a < c; ++a) std::memset(&A[(last * c + a) * ldk], 0, static_cast<size_t>(ldk) * sizeof(double));
  }

  /// Largest |(G_CC + soft) P d - d| for displacements d of 1 and -1 in no particular order.
  double misfit_of(Displacements& d, Displacements& w) const {
    const int64_t kc = count * c, n = width();
    double* x = d.side(0);
    double* y = w.side(0);
    for (int64_t i = 0; i < kc; ++i) x[i] = (static_cast<uint64_t>(i) * 2654435761u >> 9) & 1 ? 1 : -1;
    for (int64_t i = kc; i < n; ++i) x[i] = y[i] = 0;
    for (int64_t i = 0; i < kc; ++i) y[i] = dot(P.data() + i * ldk, x, n);
    double worst = 0;
    for (int64_t i = 0; i < kc; ++i) {
      const double miss = std::fabs(dot(gram.data() + i * ldk, y, n) - x[i]);
      if (!(miss <= worst)) worst = miss;
    }
    return worst;
  }
  /// P from the matrix itself.
  bool rebuild() {
    const int64_t kc = count * c;
    for (int64_t i = 0; i < kc; ++i) std::memcpy(&P[i * ldk], &gram[i * ldk], static_cast<size_t>(ldk) * sizeof(double));
    // Gauss and Jordan without pivots: the matrix is positive definite
    for (int64_t j = 0; j < kc; ++j) {
      double* row = P.data() + j * ldk;
      const double pivot = row[j];
      if (!(pivot > 0)) return false;
      row[j] = 1;
      for (int64_t l = 0; l < kc; ++l) row[l] /= pivot;
      for (int64_t i = 0; i < kc; ++i)
        if (i != j) {
          const double f = P[i * ldk + j];
          P[i * ldk + j] = 0;
          for (int64_t l = 0; l < kc; ++l) P[i * ldk + l] -= f * row[l];
        }
    }
    return true;
  }

  // ---- The field in the plane: kept columns ------------------------------------------------------------------------------------------

  typedef Vector<Real> V;

  /// Kernel at one vector of points from a tip less from its base: U_:p - U_:q.
  ECHOSPLINE_INLINE void kernel_difference(int64_t at, const Vec<D>& p, const Vec<D>& q, V (&U)[c][c]) const {
    V to_p[D], to_q[D];
    for (int d = 0; d < D; ++d) {
      const V x = load(points_->x[d].data() + at);
      const Real near_p = static_cast<Real>(p[d]), near_q = static_cast<Real>(q[d]);  // and what rounding has taken from them
      to_p[d] = (x - near_p) - static_cast<Real>(p[d] - near_p), to_q[d] = (x - near_q) - static_cast<Real>(q[d] - near_q);
    }
    if constexpr (by_difference) {
      V r2{}, other2{}, less{};
      for (int d = 0; d < D; ++d) {
        r2 += to_p[d] * to_p[d], other2 += to_q[d] * to_q[d];
        less += static_cast<Real>(q[d] - p[d]) * (to_p[d] + to_q[d]);
      }
      U[0][0] = Kernel::difference(r2, other2, less);
    } else {
      V other[c][c];
      anchored_->kernel.at(to_p, U);
      anchored_->kernel.at(to_q, other);
      for (int a = 0; a < c; ++a)
        for (int e = 0; e < c; ++e) U[a][e] -= other[a][e];
    }
  }

  /// Compute the column of a landmark at p, less its base's, into a slot; `border_.held` is the landmark's. For the thin plate, whose far field
  /// is the small rest of large terms, in double: what a kept column lacks stays in every field.
  void keep_column(int64_t slot, const Vec<D>& p, const Base& base) {
    typedef std::conditional_t<c == 1, double, Real> Number;
    typedef Vector<Number> N;
    constexpr int lanes = Lanes<Number>::count;
    constexpr int64_t part = VECTORS * lanes;
    const int64_t ld = anchored_->ld, m = anchored_->order;
    double* h = border_.held.data();
    subtract_held(base, h);
    for (int64_t first = 0; first < points_->room(); first += part) {
      const int64_t b = first / block, within = first % block;
      N a[c][planes][VECTORS];
      for (int v = 0; v < VECTORS; ++v) {
        N to_p[D], to_base[D], U[c][c], other[c][c];
        for (int d = 0; d < D; ++d) {
          const N x = load_as<Number>(points_->x[d].data() + first + v * lanes);
          to_p[d] = x - static_cast<Number>(p[d]), to_base[d] = x - static_cast<Number>(base.place[d]);
        }
        anchored_->kernel.at(to_p, U);
        anchored_->kernel.at(to_base, other);
        for (int e = 0; e < c; ++e)
          for (int d = 0; d < planes; ++d) a[e][d][v] = U[d][e] - other[d][e];
      }
      const Real* t = table_->values.data() + b * m * c * block + within;
      for (int64_t i = 0; i < m; ++i)
        for (int d = 0; d < planes; ++d, t += block)
          for (int v = 0; v < VECTORS; ++v) {
            const N value = load_as<Number>(t + v * lanes);
            for (int e = 0; e < c; ++e) a[e][d][v] -= static_cast<Number>(h[e * ld + i]) * value;
          }
      Real* out = column(b, slot) + within;
      for (int e = 0; e < c; ++e)
        for (int d = 0; d < planes; ++d)
          for (int v = 0; v < VECTORS; ++v) store_as(out + (e * planes + d) * block + v * lanes, a[e][d][v]);
    }
  }

  Largest field_by_columns(const Displacements& w, const Tip* tip, const Vec<D>& s, const Field<D, Real>& was,
                           const Array<Real>& mask, Field<D, Real>& out) {
    const int64_t m = anchored_->order;
    int64_t rows = count * c;
    constexpr int lanes = Lanes<Real>::count;
    Real* weight = row_weights.data();
    Real* h = weight + (room + 1) * c * D;
    const Base base = tip ? nearest(tip->place) : Base{{}, -1, -1};
    carry(w, base.slot, s);
    // one weight per number of a column: (contact, component of the source), then the component of the field where one scalar serves all
    for (int64_t j = 0; j < rows; ++j)
      for (int r = 0; r < Displacements::count; ++r) weight[j * Displacements::count + r] = static_cast<Real>(carried_.side(r)[j]);
    Real s_of[D];
    for (int d = 0; d < D; ++d) s_of[d] = static_cast<Real>(s[d]);
    if (tip) {
      double* own = border_.held.data();
      std::memcpy(own, tip->held.data(), static_cast<size_t>(c * anchored_->ld) * sizeof(double));
      if (c == 1 && shares(base, own) * norm(s) > CAREFUL) {
        keep_column(count, tip->place, base);
        for (int d = 0; d < D; ++d) weight[rows * D + d] = s_of[d];
        tip = nullptr, rows += c;
      } else {
        subtract_held(base, own);
        for (int64_t i = 0; i < m; ++i) {
          double sum = 0;
          for (int e = 0; e < c; ++e) sum += own[e * anchored_->ld + i] * (c == 1 ? 1.0 : s[e]);
          h[i] = static_cast<Real>(sum);
        }
      }
    }
    V change{}, reach{};
    for (int64_t b = 0; b < points_->blocks; ++b) {
      V u[D][VECTORS];
      if (tip) {
        tip_block(b, tip->place, base.place, h, s_of, u);
      } else {
        for (int d = 0; d < D; ++d)
          for (int v = 0; v < VECTORS; ++v) u[d][v] = V{};
      }
      const Real* e = column(b, 0);
      const Real* f = weight;
      for (int64_t j = 0; j < rows; ++j) {
        if constexpr (c == 1) {
          for (int v = 0; v < VECTORS; ++v) {
            const V value = load(e + v * lanes);
            for (int d = 0; d < D; ++d) u[d][v] += f[d] * value;
          }
          e += block, f += D;
        } else {
          for (int d = 0; d < D; ++d, e += block)
            for (int v = 0; v < VECTORS; ++v) u[d][v] += f[0] * load(e + v * lanes);
          ++f;
        }
      }
      finish_block(b, u, was, mask, out, change, reach);
    }
    return {largest<Real>(change), largest<Real>(reach)};
  }
  /// Weights of the kept columns: those of contacts, with what each carries for its descendants and for a tip that is relative to it.
  void carry(const Displacements& w, int64_t base, const Vec<D>& s) {
    for (int r = 0; r < Displacements::count; ++r) std::memcpy(carried_.side(r), w.side(r), static_cast<size_t>(count * c) * sizeof(double));
    if (base >= 0)
      for (int d = 0; d < D; ++d) (c == 1 ? carried_.side(d)[base] : carried_.side(0)[base * D + d]) += s[d];
    for (int64_t i = count; i-- > 0;) {
      const int64_t child = by_age[i], to = parent[child];
      for (int r = 0; to >= 0 && r < Displacements::count; ++r)
        for (int a = 0; a < c; ++a) carried_.side(r)[to * c + a] += carried_.side(r)[child * c + a];
    }
  }
  /// The tip's part of one block, relative to a landmark: (G_:p - G_:q) s.
  ECHOSPLINE_INLINE void tip_block(int64_t b, const Vec<D>& p, const Vec<D>& q, const Real* h, const Real (&s)[D], V (&u)[D][VECTORS]) const {
    constexpr int lanes = Lanes<Real>::count;
    V a[planes][VECTORS];
    for (int v = 0; v < VECTORS; ++v) {
      V U[c][c];
      kernel_difference(b * block + v * lanes, p, q, U);
      for (int d = 0; d < planes; ++d) {
        if constexpr (c == 1) {
          a[d][v] = U[0][0];
        } else {
          a[d][v] = U[d][0] * s[0];
          for (int e = 1; e < c; ++e) a[d][v] += U[d][e] * s[e];
        }
      }
    }
    const Real* t = table_->values.data() + b * anchored_->order * c * block;
    for (int64_t i = 0; i < anchored_->order; ++i)
      for (int d = 0; d < planes; ++d, t += block)
        for (int v = 0; v < VECTORS; ++v) a[d][v] -= h[i] * load(t + v * lanes);
    for (int d = 0; d < D; ++d)
      for (int v = 0; v < VECTORS; ++v) u[d][v] = c == 1 ? s[d] * a[0][v] : a[c == 1 ? 0 : d][v];
  }
  ECHOSPLINE_INLINE void finish_block(int64_t b, const V (&u)[D][VECTORS], const Field<D, Real>& was, const Array<Real>& mask,
                                      Field<D, Real>& out, V& change, V& reach) const {
    constexpr int lanes = Lanes<Real>::count;
    for (int v = 0; v < VECTORS; ++v) {
      const int64_t at = b * block + v * lanes;
      V r2{}, d2{};
      for (int d = 0; d < D; ++d) {
        const V before = load(was.u[d].data() + at), gap = u[d][v] - before;
        store(out.u[d].data() + at, u[d][v]);
        r2 += u[d][v] * u[d][v];
        d2 += gap * gap;
      }
      const V on = load(mask.data() + at);
      change = greatest(on * d2, change);
      reach = greatest(on * r2, reach);
    }
  }

  // ---- The field in space: kernels evaluated where it is wanted ----------------------------------------------------------------------

  Largest field_by_kernels(const Displacements& w, const Tip* tip, const Vec<D>& s, const Field<D, Real>& was,
                           const Array<Real>& mask, Field<D, Real>& out) {
    Landmarks all_landmarks = gather(w, tip, s);
    V change{}, reach{};
    for (int64_t b = 0; b < points_->blocks; ++b) {
      Real x[D][block];
      V u[D][VECTORS];
      for (int d = 0; d < D; ++d) std::memcpy(x[d], points_->x[d].data() + b * block, sizeof x[d]);
      evaluate(all_landmarks, x[0], block, u);
      finish_block(b, u, was, mask, out, change, reach);
    }
    return {largest<Real>(change), largest<Real>(reach)};
  }

 public:
  /// Landmarks as the evaluation reads them: (place, weight) of each, then the motions' coefficients.
  struct Landmarks {
    int64_t count;
    const Direct* values;   ///< (count, 2 D)
    const Direct* motions;  ///< (motions, D) of the affine motions, (motions) of the rigid ones
  };
  /// Room for `gather`.
  bool reserve_landmarks() {
    return gathered_places_.reserve(landmark_room() * D) && gathered_weights_.reserve(landmark_room() * D) &&
           gathered_.reserve(landmark_room() * 2 * D);
  }
  int64_t landmarks_reserved() const { return gathered_places_.size() / D; }
  Landmarks gather(const Displacements& w, const Tip* tip, const Vec<D>& s) {
    const int64_t total = landmarks(w, tip, s, gathered_places_, gathered_weights_);
    for (int64_t i = 0; i < total; ++i)
      for (int d = 0; d < D; ++d) {
        gathered_[i * 2 * D + d] = static_cast<Direct>(gathered_places_[i * D + d]);
        gathered_[i * 2 * D + D + d] = static_cast<Direct>(gathered_weights_[i * D + d]);
      }
    Direct* motions = gathered_.data() + total * 2 * D;
    for (int64_t j = 0; j < Kernel::motions * D; ++j)
      motions[j] = static_cast<Direct>(gathered_weights_[total * D + j]);
    return {total, gathered_.data(), motions};
  }
  static constexpr int64_t direct_block = VECTORS * Lanes<Direct>::count;
  /// Field of the landmarks at one block of conditioned points, `stride` numbers from one component to the next.
  __attribute__((noinline)) void evaluate(const Landmarks& all_landmarks, const Direct* points, int64_t stride,
                                          Vector<Direct> (&u)[D][VECTORS]) const {
    typedef Vector<Direct> N;
    N x[D][VECTORS];
    for (int d = 0; d < D; ++d)
      for (int v = 0; v < VECTORS; ++v) x[d][v] = load(points + d * stride + v * Lanes<Direct>::count);
    const Direct* a = all_landmarks.motions;
    for (int d = 0; d < D; ++d)
      for (int v = 0; v < VECTORS; ++v) {
        if constexpr (c == 1) {
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
    for (int64_t first = 0; first < all_landmarks.count; first += GROUP) {
      N sum[D][VECTORS] = {};
      const Direct* p = all_landmarks.values + first * 2 * D;
      const Direct* end = all_landmarks.values + smaller(first + GROUP, all_landmarks.count) * 2 * D;
      for (; p < end; p += 2 * D)
        for (int v = 0; v < VECTORS; ++v) {
          N offset[D], own[D];
          for (int d = 0; d < D; ++d) offset[d] = x[d][v] - p[d], own[d] = sum[d][v];
          anchored_->kernel.respond(offset, p + D, own);
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

 private:
  Array<double> gathered_places_, gathered_weights_;
  Array<Direct> gathered_;
};

}  // namespace echospline::ECHOSPLINE_CORE
