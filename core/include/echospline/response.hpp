// How landmarks that move share the tissue between them: small, in double, the same for every kernel.
//
// With the anchors held, contacts C with displacements q and a tip at p with displacement t move a point by
//
//   G_:C w + G_:p s,   s = (G_pp - g' P g + soft)^-1 (t - g' P q),   w = P (q - g s),   g = G_Cp,   P = (G_CC + soft)^-1
//
// P is bordered when a contact joins and reduced when one leaves; nothing is refitted. `field.hpp` carries w and s to the mesh.
#pragma once
#include "anchored_kernel.hpp"
#include "session_field.hpp"

namespace echospline::ECHOSPLINE_CORE {

constexpr double RESIDUAL = 1e-6;  // mm; misfit at the landmarks, for displacements of 1 mm, at which P is made anew

/// Displacements of landmarks as right-hand sides: one for each component where one scalar serves all, else one with all components.
template <int D>
struct Sides {
  int c = 1, count = D;
  int64_t ld = 0;
  Array<double> values;  ///< (count, ld)

  bool reserve(int components, int64_t length) {
    c = components, count = c == 1 ? D : 1, ld = length;
    return values.reserve(count * length);
  }
  double* side(int r) { return values.data() + r * ld; }
  const double* side(int r) const { return values.data() + r * ld; }
  double& at(int64_t slot, int d) { return c == 1 ? values[d * ld + slot] : values[slot * D + d]; }
  double at(int64_t slot, int d) const { return c == 1 ? values[d * ld + slot] : values[slot * D + d]; }
  void set(int64_t slot, const Vec<D>& q) {
    for (int d = 0; d < D; ++d) at(slot, d) = q[d];
  }
  /// Zeros from a number of contacts to the end of the last whole row.
  void clear_beyond(int64_t contacts) {
    for (int r = 0; r < count; ++r)
      for (int64_t i = contacts * c; i < rounded_up(contacts * c, ROW); ++i) side(r)[i] = 0;
  }
};

/// A point that moves at every step, seen by the contacts.
template <int D>
struct Column {
  Vec<D> place;  ///< conditioned
  int64_t ld = 0, ldk = 0;
  Array<double> felt, held;  ///< [U_pB P_p] and L_B^-1 of it, (c, ld)
  Array<double> g, Pg;       ///< G_Cp and P of it, (c, ldk)
  double own[D][D];          ///< G_pp - g' P g

  bool reserve(int components, int64_t length, int64_t contacts) {
    ld = length, ldk = contacts;
    return felt.reserve(components * ld) && held.reserve(components * ld) && g.reserve(components * ldk) &&
           Pg.reserve(components * ldk);
  }
};

/// Solve a positive definite system of n numbers, n up to D, in place.
template <int D>
inline void solve_small(int n, const double (&A)[D][D], double* x) {
  double L[D][D] = {}, y[D] = {};
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
/// Its inverse; false where the system is not positive definite.
template <int D>
inline bool invert_small(int n, const double (&S)[D][D], double (&V)[D][D]) {
  for (int e = 0; e < n; ++e) {
    double x[D] = {};
    x[e] = 1;
    solve_small<D>(n, S, x);
    for (int a = 0; a < n; ++a) V[a][e] = x[a];
  }
  for (int a = 0; a < n; ++a)
    if (!(S[a][a] > 0 && V[a][a] > 0)) return false;
  return true;
}

/// What is kept of the contacts in one session.
template <int D>
class Response {
 public:
  int c = 1;                 ///< components of the kernel
  int64_t count = 0;         ///< contacts, k
  int64_t room = 0;          ///< contacts for which there is memory
  int64_t ldk = 0;           ///< scalars in a row of P
  Array<int32_t> source_of;  ///< (room)
  Array<int32_t> slot_of;    ///< of every source, or -1
  Array<Vec<D>> place;       ///< conditioned, (room)
  Array<double> across[D];   ///< the same, a row per coordinate
  Array<double> felt, held;  ///< of the contacts, (room c, ld)
  Array<double> gram, P;     ///< (room c, ldk)
  Array<int32_t> parent;     ///< slots whose columns a contact's is relative to; negative: an anchor's; (room, c)
  Array<int32_t> by_age;     ///< slots, the oldest first: parents stand before their children
  double residual = 0;
  int64_t rebuilt = 0;

  bool build(const AnchoredKernel<D>* anchored, SessionField<D>* field, int64_t sources) {
    anchored_ = anchored, field_ = field, c = anchored->c;
    if (!slot_of.reserve(sources)) return false;
    for (int64_t i = 0; i < sources; ++i) slot_of[i] = -1;
    return true;
  }

  /// Make room for contacts; what is kept stays. False when memory runs out, and nothing that counts has changed.
  bool reserve(int64_t contacts) {
    if (contacts <= room) return true;
    const int64_t wide = rounded_up(contacts * c, ROW), ld = anchored_->ld;
    Array<int32_t> new_source, new_parent, new_by_age;
    Array<Vec<D>> new_place;
    Array<double> new_felt, new_held, new_gram, new_P;
    if (!new_source.reserve(contacts) || !new_parent.reserve(contacts * c) || !new_by_age.reserve(contacts) ||
        !new_place.reserve(contacts) || !new_felt.reserve(contacts * c * ld) || !new_held.reserve(contacts * c * ld) ||
        !new_gram.reserve(contacts * c * wide) || !new_P.reserve(contacts * c * wide) ||
        !border_.reserve(c, ld, wide) || !carried_.reserve(c, wide) || !field_->reserve(contacts, count))
      return false;
    copy_rows(new_source, source_of, count, 1, 1, 1), copy_rows(new_parent, parent, count, c, c, c);
    copy_rows(new_by_age, by_age, count, 1, 1, 1), copy_rows(new_place, place, count, 1, 1, 1);
    copy_rows(new_felt, felt, count * c, ld, ld, ld), copy_rows(new_held, held, count * c, ld, ld, ld);
    copy_rows(new_gram, gram, count * c, wide, ldk, count * c), copy_rows(new_P, P, count * c, wide, ldk, count * c);
    for (int d = 0; d < D; ++d) {
      if (!across[d].reserve(rounded_up(contacts, ROW))) return false;
      for (int64_t i = 0; i < count; ++i) across[d][i] = place[i][d];
    }
    source_of.swap(new_source), parent.swap(new_parent), by_age.swap(new_by_age), place.swap(new_place);
    felt.swap(new_felt), held.swap(new_held), gram.swap(new_gram), P.swap(new_P);
    room = contacts, ldk = wide;
    return true;
  }

  /// G of a point with the contacts, and what of its own response the contacts leave.
  void meet(const Vec<D>& p, Column<D>& tip) const {
    tip.place = p;
    anchored_->felt(p, tip.felt.data());
    anchored_->held(tip.felt.data(), tip.held.data());
    const int64_t n = width(), ld = anchored_->ld;
    const double* places[D];
    for (int d = 0; d < D; ++d) places[d] = across[d].data();
    double* U = tip.Pg.data();  // until P g is known
    for (int e = 0; e < c; ++e) anchored_->kernel.along(anchored_->kernel, e, p, places, count, U + e * count, ldk);
    for (int a = 0; a < c; ++a)
      for (int64_t j = 0; j < count; ++j)
        for (int e = 0; e < c; ++e)
          tip.g[a * ldk + j * c + e] =
              anchored_->acts(e, a)
                  ? U[a * ldk + e * count + j] - dot(felt.data() + (j * c + e) * ld, tip.held.data() + a * ld, ld)
                  : 0.0;
    for (int a = 0; a < c; ++a) {
      for (int64_t i = count * c; i < n; ++i) tip.g[a * ldk + i] = tip.Pg[a * ldk + i] = 0;
      for (int64_t i = 0; i < count * c; ++i) tip.Pg[a * ldk + i] = dot(P.data() + i * ldk, tip.g.data() + a * ldk, n);
    }
    anchored_->green(p, tip.felt.data(), p, tip.held.data(), tip.own);
    for (int a = 0; a < c; ++a)
      for (int e = 0; e < c; ++e) tip.own[a][e] -= dot(tip.g.data() + a * ldk, tip.Pg.data() + e * ldk, n);
  }
  /// G of two points that have been met, less what the contacts explain.
  void between(const Column<D>& p, const Column<D>& q, double (&G)[D][D]) const {
    anchored_->green(p.place, p.felt.data(), q.place, q.held.data(), G);
    for (int a = 0; a < c; ++a)
      for (int e = 0; e < c; ++e) G[a][e] -= dot(p.g.data() + a * ldk, q.Pg.data() + e * ldk, width());
  }

  /// Field of contacts with displacements q alone, at a point that has been met: g' P q.
  Vec<D> at(const Column<D>& tip, const Sides<D>& q) const {
    Vec<D> u;
    for (int d = 0; d < D; ++d)
      u[d] = c == 1 ? dot(tip.Pg.data(), q.side(d), width()) : dot(tip.Pg.data() + d * ldk, q.side(0), width());
    return u;
  }
  /// A small matrix of the components times a vector, one scalar serving all components where there is one.
  Vec<D> times(const double (&G)[D][D], const Vec<D>& s) const {
    Vec<D> u{};
    for (int d = 0; d < D; ++d)
      for (int e = 0; e < (c == 1 ? 1 : D); ++e) u[d] += c == 1 ? G[0][0] * s[d] : G[d][e] * s[e];
    return u;
  }
  /// Weight s of a tip with displacement t among contacts with displacements q.
  Vec<D> tip_weight(const Column<D>& tip, const Sides<D>& q, const Vec<D>& t, double softness) const {
    Vec<D> s = t - at(tip, q);
    double own[D][D];
    add_softness(tip.own, softness, own);
    if (c == 1)
      for (int d = 0; d < D; ++d) s[d] /= own[0][0];
    else
      solve_small<D>(D, own, s.v);
    return s;
  }
  void add_softness(const double (&own)[D][D], double softness, double (&S)[D][D]) const {
    for (int a = 0; a < c; ++a)
      for (int e = 0; e < c; ++e) S[a][e] = 0.5 * (own[a][e] + own[e][a]) + (a == e ? softness : 0);
  }
  /// Weights w = P (q - g s) of the contacts; without a tip w = P q.
  void weights(const Sides<D>& q, const Column<D>* tip, const Vec<D>& s, Sides<D>& w) const {
    const int64_t n = width();
    for (int r = 0; r < q.count; ++r)
      for (int64_t i = 0; i < count * c; ++i) w.side(r)[i] = dot(P.data() + i * ldk, q.side(r), n);
    if (tip)
      for (int d = 0; d < D; ++d) add(w.side(c == 1 ? d : 0), -s[d], tip->Pg.data() + (c == 1 ? 0 : d * ldk), n);
  }

  /// Add a contact at a source; false where it cannot be told apart from the others. There must be room.
  bool join(int32_t source, const Vec<D>& p, double softness) {
    const int64_t k = count, kc = k * c, ld = anchored_->ld;
    meet(p, border_);
    double S[D][D], V[D][D], own[D][D];
    add_softness(border_.own, softness, S);
    if (!invert_small<D>(c, S, V)) return false;
    source_of[k] = source, slot_of[source] = static_cast<int32_t>(k), set_place(k, p);
    std::memcpy(&felt[kc * ld], border_.felt.data(), static_cast<size_t>(c * ld) * sizeof(double));
    std::memcpy(&held[kc * ld], border_.held.data(), static_cast<size_t>(c * ld) * sizeof(double));
    anchored_->green(p, border_.felt.data(), p, border_.held.data(), own);
    add_softness(own, softness, S);
    // the inverse of a bordered matrix: P + (P g) V (P g)', -(P g) V, V
    double f[D];
    for (int64_t i = 0; i < kc; ++i) {
      for (int a = 0; a < c; ++a) {
        f[a] = 0;
        for (int e = 0; e < c; ++e) f[a] += V[a][e] * border_.Pg[e * ldk + i];
      }
      double* row = P.data() + i * ldk;
      for (int a = 0; a < c; ++a) add(row, f[a], border_.Pg.data() + a * ldk, width());
      for (int a = 0; a < c; ++a) {
        row[kc + a] = P[(kc + a) * ldk + i] = -f[a];
        gram[(kc + a) * ldk + i] = gram[i * ldk + kc + a] = border_.g[a * ldk + i];
      }
    }
    for (int a = 0; a < c; ++a)
      for (int e = 0; e < c; ++e) P[(kc + a) * ldk + kc + e] = V[a][e], gram[(kc + a) * ldk + kc + e] = S[a][e];
    Base base[D];
    const Bases<D> bases = nearest(p, base);
    for (int e = 0; e < c; ++e) parent[k * c + e] = static_cast<int32_t>(base[e].slot);
    by_age[k] = static_cast<int32_t>(k);
    count = k + 1;
    subtract_held(base, border_.held.data());
    field_->keep(k, p, bases, border_.held.data());
    return true;
  }

  /// Remove the contact in a slot; the last one takes its place.
  void leave(int64_t slot) {
    const int64_t kc = count * c, last = count - 1, ld = anchored_->ld;
    // reduce: P_rest - P_r,j P_jj^-1 P_j,r
    double S[D][D], V[D][D];
    for (int a = 0; a < c; ++a)
      for (int e = 0; e < c; ++e) S[a][e] = P[(slot * c + a) * ldk + slot * c + e];
    if (invert_small<D>(c, S, V))
      for (int64_t i = 0; i < kc; ++i) {
        if (i / c == slot) continue;
        double f[D] = {};
        for (int a = 0; a < c; ++a)
          for (int e = 0; e < c; ++e) f[a] -= P[i * ldk + slot * c + e] * V[e][a];
        for (int a = 0; a < c; ++a) add(P.data() + i * ldk, f[a], P.data() + (slot * c + a) * ldk, width());
      }
    leave_family(slot, last);
    move_last(P, slot, last), move_last(gram, slot, last);
    slot_of[source_of[slot]] = -1;
    if (slot != last) {
      source_of[slot] = source_of[last], slot_of[source_of[slot]] = static_cast<int32_t>(slot);
      set_place(slot, place[last]);
      std::memcpy(&felt[slot * c * ld], &felt[last * c * ld], static_cast<size_t>(c * ld) * sizeof(double));
      std::memcpy(&held[slot * c * ld], &held[last * c * ld], static_cast<size_t>(c * ld) * sizeof(double));
      field_->move(last, slot);
    }
    count = last;
  }

  /// Whether the contacts' displacements are met to RESIDUAL, after making P anew where rounding has grown.
  bool check(Sides<D>& d, Sides<D>& w) {
    double misfit = misfit_of(d, w);
    if (!(misfit <= RESIDUAL)) {
      ++rebuilt;
      if (!rebuild()) return false;
      misfit = misfit_of(d, w);
    }
    residual = larger(residual, misfit);
    return misfit <= RESIDUAL;
  }

  /// Field of weights w of the contacts and s of a tip, into the session's next field or the one at rest. Returns the largest squares of the
  /// change since the present field, and of the field, at sources.
  Largest field(const Sides<D>& w, const Column<D>* tip, const Vec<D>& s, bool at_rest) {
    Weights<D> given;
    given.count = count, given.at_rest = at_rest;
    given.carried = &carried_.values[0], given.ld = carried_.ld;
    Base base[D];
    if (tip) given.base = nearest(tip->place, base);
    carry(w, base, s);
    if (tip) {
      std::memcpy(border_.held.data(), tip->held.data(), static_cast<size_t>(c * anchored_->ld) * sizeof(double));
      subtract_held(base, border_.held.data());
      given.tip = true, given.place = tip->place, given.s = s, given.held = border_.held.data();
    }
    if (field_->needs_landmarks()) gather(w, tip, s, given.landmarks);
    return field_->compute(given);
  }

  /// All landmarks as kernels at their places with their weights: anchors, contacts, tip; then the motions' coefficients.
  void gather(const Sides<D>& w, const Column<D>* tip, const Vec<D>& s, LandmarkWeights<D>& out) {
    const int64_t b = anchored_->anchors, total = b + count + (tip ? 1 : 0), ld = anchored_->ld;
    field_->reserve_landmarks(out);
    out.count = total;
    for (int64_t i = 0; i < b; ++i)
      for (int d = 0; d < D; ++d) out.place[i * D + d] = anchored_->place[d][i], out.weight[i * D + d] = 0;
    for (int64_t j = 0; j < count; ++j)
      for (int d = 0; d < D; ++d) out.place[(b + j) * D + d] = place[j][d], out.weight[(b + j) * D + d] = w.at(j, d);
    if (tip)
      for (int d = 0; d < D; ++d)
        out.place[(b + count) * D + d] = tip->place[d], out.weight[(b + count) * D + d] = s[d];
    // anchors and motions: -(held w + held_tip s), for each system and each right-hand side of it
    const bool apart = anchored_->systems > 1;
    for (int r = 0; r < (apart ? c : w.count); ++r) {
      const int first = apart ? r : 0, step = apart ? c : 1;  // of the rows of `held` that the system has
      const double* side = w.side(apart ? 0 : r);
      const auto weight = [&](int64_t i) {
        double sum = 0;
        for (int64_t j = first; j < count * c; j += step) sum -= held[j * ld + i] * side[j];
        if (tip)
          for (int a = first; a < (apart ? r + 1 : c); ++a) sum -= tip->held[a * ld + i] * s[c == 1 ? r : a];
        return sum;
      };
      for (int e = first; e < (apart ? r + 1 : c); ++e) {
        // the weight of a difference is that of the anchor, and less that of its parent, which stands before it
        const AnchorRow<D>& own = anchored_->row[e];
        const int d = c == 1 ? r : e;
        for (int64_t i = 0; i < own.count; ++i) {
          const double sum = weight(own.first + i);
          out.weight[own.anchor[i] * D + d] = sum;
          if (own.parent[i] >= 0) out.weight[own.anchor[own.parent[i]] * D + d] -= sum;
        }
      }
      const int64_t n = anchored_->held_by(r);
      for (int64_t j = 0; j < anchored_->kernel.motions; ++j) out.weight[(total + j) * D + r] = weight(n + j);
    }
  }

 private:
  const AnchoredKernel<D>* anchored_ = nullptr;
  SessionField<D>* field_ = nullptr;
  Column<D> border_;
  Sides<D> carried_;  ///< weights of contacts and all their descendants

  int64_t width() const { return rounded_up(count * c, ROW); }
  void set_place(int64_t slot, const Vec<D>& p) {
    place[slot] = p;
    for (int d = 0; d < D; ++d) across[d][slot] = p[d];
  }

  template <class T>
  static void copy_rows(Array<T>& to, const Array<T>& from, int64_t rows, int64_t to_ld, int64_t from_ld,
                        int64_t numbers) {
    for (int64_t i = 0; i < rows; ++i)
      for (int64_t l = 0; l < numbers; ++l) to[i * to_ld + l] = from[i * from_ld + l];
  }

  /// Landmark that another's column is relative to.
  struct Base {
    Vec<D> place;         ///< conditioned
    int64_t slot = -1;    ///< of a contact, or negative
    int64_t anchor = -1;  ///< in the row of the component, or negative
  };
  /// Landmarks nearest to a conditioned point, one for each component.
  Bases<D> nearest(const Vec<D>& p, Base (&base)[D]) const {
    Bases<D> bases;
    Base contact{{}, -1, -1};
    double least = INFINITY;
    for (int64_t j = 0; j < count; ++j) {
      const Vec<D> gap = place[j] - p;
      if (dot(gap, gap) < least) least = dot(gap, gap), contact = {place[j], j, -1};
    }
    for (int e = 0; e < c; ++e) {
      const AnchorRow<D>& row = anchored_->row[e];
      base[e] = e && anchored_->alike ? base[0] : contact;
      double nearest = least;
      for (int64_t i = 0; i < (e && anchored_->alike ? 0 : row.count); ++i) {
        const Vec<D> gap = row.at(i) - p;
        if (dot(gap, gap) < nearest) nearest = dot(gap, gap), base[e] = {row.at(i), -1, i};
      }
      bases.place[e] = base[e].place;
      for (int d = 0; d < D; ++d) bases.one = bases.one && base[e].place[d] == base[0].place[d];
    }
    return bases;
  }
  /// L_B^-1 [U P]' of a point less that of its bases, (c, ld). That of an anchor is 1 for itself and all its ancestors, for their kernels are
  /// differences.
  void subtract_held(const Base (&base)[D], double* rows) const {
    const int64_t ld = anchored_->ld;
    for (int e = 0; e < c; ++e) {
      const AnchorRow<D>& row = anchored_->row[e];
      if (base[e].slot >= 0)
        add(rows + e * ld, -1, held.data() + (base[e].slot * c + e) * ld, ld);
      else
        for (int64_t i = base[e].anchor; i >= 0; i = row.parent[i]) rows[e * ld + row.first + i] -= 1;
    }
  }
  /// Give a contact's children to its parents before the contact goes and the last slot is renamed.
  void leave_family(int64_t slot, int64_t last) {
    const int32_t gone = static_cast<int32_t>(slot);
    for (int64_t j = 0; j < count; ++j)
      for (int e = 0; e < c; ++e)
        if (parent[j * c + e] == gone) parent[j * c + e] = parent[slot * c + e], field_->add(j, slot, e);
    int64_t at = 0;
    for (int64_t i = 0; i < count; ++i)
      if (by_age[i] != gone) by_age[at++] = by_age[i] == static_cast<int32_t>(last) ? gone : by_age[i];
    for (int64_t j = 0; j < count * c; ++j)
      if (parent[j] == static_cast<int32_t>(last)) parent[j] = gone;
    for (int e = 0; e < c; ++e) parent[slot * c + e] = parent[last * c + e];
  }
  /// Weights of the kept columns: those of contacts, with what each carries for its descendants and for a tip that is relative to it.
  void carry(const Sides<D>& w, const Base (&base)[D], const Vec<D>& s) {
    for (int r = 0; r < w.count; ++r)
      std::memcpy(carried_.side(r), w.side(r), static_cast<size_t>(count * c) * sizeof(double));
    for (int d = 0; d < D; ++d)
      if (base[d % c].slot >= 0) carried_.at(base[d % c].slot, d) += s[d];
    for (int64_t i = count; i-- > 0;) {
      const int64_t child = by_age[i];
      for (int d = 0; d < D; ++d)
        if (const int64_t to = parent[child * c + d % c]; to >= 0) carried_.at(to, d) += carried_.at(child, d);
    }
  }

  /// Row and column of the last contact in place of those of a slot, and zeros where they were.
  void move_last(Array<double>& A, int64_t slot, int64_t last) {
    for (int64_t i = 0; i < (last + 1) * c; ++i)
      for (int a = 0; a < c; ++a) {
        A[i * ldk + slot * c + a] = A[i * ldk + last * c + a];
        A[i * ldk + last * c + a] = 0;
      }
    for (int a = 0; slot != last && a < c; ++a)
      std::memcpy(&A[(slot * c + a) * ldk], &A[(last * c + a) * ldk], static_cast<size_t>(ldk) * sizeof(double));
    for (int a = 0; a < c; ++a) std::memset(&A[(last * c + a) * ldk], 0, static_cast<size_t>(ldk) * sizeof(double));
  }

  /// Largest |(G_CC + soft) P d - d| for displacements d of 1 and -1 in no particular order.
  double misfit_of(Sides<D>& d, Sides<D>& w) const {
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
  /// P from the matrix itself, by Gauss and Jordan without pivots: the matrix is positive definite.
  bool rebuild() {
    const int64_t kc = count * c, n = width();
    for (int64_t i = 0; i < kc; ++i)
      std::memcpy(&P[i * ldk], &gram[i * ldk], static_cast<size_t>(ldk) * sizeof(double));
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
          add(P.data() + i * ldk, -f, row, n);
        }
    }
    return true;
  }
};

}  // namespace echospline::ECHOSPLINE_CORE
