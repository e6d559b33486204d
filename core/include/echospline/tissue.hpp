// One session: the state of the tissue, and the step from a needle pose to the field, Algorithm 2.
#pragma once
#include "response.hpp"
#include "scene.hpp"

namespace echospline::ECHOSPLINE_CORE {

constexpr double SAME_PLACE = 1e-6;  // mm; a tip closer than this to a contact replaces it as landmark
constexpr double PARALLEL = 1e-12;   // sine of the angle below which a shaft runs along a line of nodes

/// A node that is a landmark: it touches the needle, or has left it and relaxes.
template <int D>
struct Contact {
  int32_t source;
  bool touching;
  Vec<D> q;      ///< displacement, mm
  double along;  ///< where on the shaft it was touched, mm from the entry
  Vec<D> grip;   ///< displacement across the axis less the shaft's position when it was touched, mm
};

/// The landmark of the tip.
template <int D>
struct TipLandmark {
  bool present = false;
  bool pushed = false;  ///< the tip is there and pushes; otherwise it has left and the landmark relaxes
  Vec<D> place{};       ///< in the undeformed tissue, mm
  Vec<D> q{};           ///< displacement, mm
};

/// What the tissue remembers.
template <int D>
struct State {
  int64_t count = 0;
  Array<Contact<D>> contacts;  ///< ascending sources
  TipLandmark<D> tip;
  bool posed = false;
  Pose<D> before{};
  double reach = 0;  ///< largest displacement of a source, mm
  int64_t held_back = 0;
};

template <int D>
class Tissue {
 public:
  enum Outcome { done, no_memory, not_solved };

  const Scene<D>& scene;
  State<D> state;
  int64_t steps = 0, joined = 0, left = 0, allocations = 0;

  explicit Tissue(const Scene<D>& given) : scene(given), c(given.anchored.c) {}
  ~Tissue() {
    if (field_) field_->destroy();
  }

  bool build() {
    const int64_t K = scene.sources();
    field_ = scene.field->create_session();
    return field_ && response_.build(&scene.anchored, field_, K) && touched_.reserve(K) && alongs_.reserve(K) &&
           wanted_.reserve(K) && reserve(smaller(larger<int64_t>(scene.contact_room, 1), larger<int64_t>(K, 1)));
  }
  double residual() const { return response_.residual; }
  int64_t rebuilt() const { return response_.rebuilt; }

  /// Tissue that no needle has touched.
  void rest() {
    state.count = 0, state.tip = {}, state.posed = false, state.reach = 0, state.held_back = 0;
    field_->clear();
  }

  /// State after the needle has moved to a pose. On failure the state has not changed.
  Outcome advance(const echospline_pose& pose) {
    const Interaction& p = scene.interaction;
    const Needle<D> n = needle_at<D>(pose, state.posed ? &state.before : nullptr, p.immediate);
    Outcome outcome = touch(n);
    if (outcome == done) outcome = set_contacts(next_, next_count_);
    if (outcome != done) return outcome;

    Step step;
    const Sides<D>& given = move(n, step);
    const Largest most = spread(given, step, false);
    double reach2 = most.reach2;
    int64_t held_back = state.held_back;
    const double limit = allowed(n);
    if (most.change2 > limit * limit) {
      hold_back(step, limit);
      reach2 = reach2_of_next();
      ++held_back;
    }
    for (int64_t j = 0; j < next_count_; ++j) next_[j].q = new_q_[j];
    const int64_t kept_count = release();
    if (kept_count < next_count_) {
      next_count_ = kept_count;
      outcome = set_contacts(next_, next_count_);
      if (outcome != done) return outcome;
      reach2 = solve_and_spread(next_, next_count_, step.tip).reach2;
    }
    // nothing can fail from here on
    state.contacts.swap(next_);
    state.count = next_count_, state.tip = step.tip, state.posed = true, state.before = {n.entry, n.tip};
    state.reach = std::sqrt(reach2), state.held_back = held_back;
    field_->commit();
    ++steps;
    return done;
  }

  /// Make `state` what `load` says and compute its field. On failure the state has not changed.
  template <class Load>
  Outcome restore(int64_t count, Load load) {
    if (count > response_.room && !grow(count)) return no_memory;
    TipLandmark<D> tip;
    State<D> fresh;
    load(next_, fresh);
    next_count_ = count, tip = fresh.tip;
    const Outcome outcome = set_contacts(next_, count);
    if (outcome != done) return outcome;
    const double reach2 = solve_and_spread(next_, count, tip).reach2;
    state.contacts.swap(next_);
    state.count = count, state.tip = tip, state.posed = fresh.posed, state.before = fresh.before;
    state.held_back = fresh.held_back, state.reach = std::sqrt(reach2);
    field_->commit();
    return done;
  }

  /// Displacement at points (count, D) mm.
  Outcome evaluate(const double* points, int64_t count, double* out) {
    LandmarkWeights<D> landmarks;
    const Outcome outcome = present(landmarks);
    if (outcome == done) field_->evaluate(landmarks, points, count, out);
    return outcome;
  }
  /// Displacement of every mesh node, (n, D) mm.
  template <class Number>
  Outcome mesh(Number* out) {
    LandmarkWeights<D> landmarks;
    const Outcome outcome = field_->mesh_needs_landmarks() ? present(landmarks) : done;
    if (outcome == done) field_->mesh(landmarks, out);
    return outcome;
  }
  /// The same in planes of single precision, valid until the next step; nullptr where the field has none.
  Outcome planes(const float*& x, const float*& y) {
    LandmarkWeights<D> landmarks;
    const Outcome outcome = field_->mesh_needs_landmarks() ? present(landmarks) : done;
    if (outcome == done) field_->planes(landmarks, x, y);
    return outcome;
  }

 private:
  const int c;
  Response<D> response_;
  SessionField<D>* field_ = nullptr;
  Array<Contact<D>> next_;
  int64_t next_count_ = 0;
  Array<int32_t> touched_;
  Array<double> alongs_;
  Array<char> wanted_;
  Array<Vec<D>> new_q_, free_;
  Column<D> tip_column_, other_column_;
  Sides<D> q_, w_;
  Array<int64_t> leaving_;
  Array<double> small_, small_sides_;

  /// What one step decides.
  struct Step {
    TipLandmark<D> tip;
    double softness = 0;  ///< of the tip's landmark
    int64_t on_tip = -1;  ///< the contact that the tip replaces, or -1
    Vec<D> s{};           ///< the tip's weight
    bool has_column() const { return tip.present && on_tip < 0; }
  };

  /// Weights of all landmarks of the present state; none where it is at rest.
  Outcome present(LandmarkWeights<D>& landmarks) {
    if (!state.tip.present && state.count == 0) return done;
    const Outcome outcome = set_contacts(state.contacts, state.count);
    if (outcome != done) return outcome;
    const Weighted weighted = solve(state.contacts, state.count, state.tip);
    response_.gather(w_, weighted.column, weighted.s, landmarks);
    return done;
  }

  // ---- Contacts that come and go -----------------------------------------------------------------------------------------------------

  bool reserve(int64_t contacts) {
    const int64_t wide = rounded_up(contacts * c, ROW), ld = scene.anchored.ld;
    Array<Contact<D>> kept, kept_next;
    if (!kept.reserve(contacts) || !kept_next.reserve(contacts)) return false;
    for (int64_t i = 0; i < state.count; ++i) kept[i] = state.contacts[i];
    for (int64_t i = 0; i < next_count_; ++i) kept_next[i] = next_[i];
    if (!new_q_.reserve(contacts) || !free_.reserve(contacts) || !tip_column_.reserve(c, ld, wide) ||
        !other_column_.reserve(c, ld, wide) || !q_.reserve(c, wide) || !w_.reserve(c, wide) ||
        !leaving_.reserve(contacts) || !small_.reserve(contacts * c * wide) || !small_sides_.reserve(D * wide) ||
        !response_.reserve(contacts))
      return false;
    state.contacts.swap(kept), next_.swap(kept_next);
    return true;
  }
  bool grow(int64_t contacts) {
    ++allocations;
    return reserve(smaller(larger(2 * response_.room, contacts), larger(scene.sources(), contacts)));
  }

  Outcome set_contacts(const Array<Contact<D>>& contacts, int64_t count) {
    for (int64_t j = 0; j < count; ++j) wanted_[contacts[j].source] = 1;
    int64_t changes = 0;
    for (int64_t slot = response_.count; slot-- > 0;)
      if (!wanted_[response_.source_of[slot]]) response_.leave(slot), ++left, ++changes;
    bool there = true;
    for (int64_t j = 0; j < count; ++j) {
      const int32_t source = contacts[j].source;
      wanted_[source] = 0;
      if (response_.slot_of[source] >= 0 || !there) continue;
      there = response_.join(source, scene.field->contact_place(source), softness_of(source));
      ++joined, ++changes;
    }
    if (!there) return not_solved;
    return changes == 0 || response_.check(q_, w_) ? done : not_solved;
  }
  double softness_of(int32_t source) const { return scene.softness_at(scene.lattice.node[source]); }

  /// Contacts after nodes have joined and left: `next_`. One that joins has the displacement that the field already has there.
  Outcome touch(const Needle<D>& n) {
    const Interaction& p = scene.interaction;
    const int64_t touched = find_touched(n);
    const int64_t most = together(touched);
    if (most > response_.room) {
      next_count_ = 0;
      if (!grow(most)) return no_memory;
    }
    int64_t rows = 0, i = 0, j = 0;
    while (i < touched || j < state.count) {
      int64_t source = j < state.count ? state.contacts[j].source : scene.sources();
      const bool touching = i < touched && touched_[i] <= source;
      const Contact<D>* old = nullptr;
      if (!touching || touched_[i] == source) old = &state.contacts[j++];
      double along = 0;
      if (touching) {
        source = touched_[i], along = alongs_[i++];
      } else if (p.immediate) {
        continue;
      } else if (n.depth >= ZERO_LENGTH) {
        along = distance(n, scene.source[source], field_->now(source), p.drag).along;
      }
      Contact<D>& row = next_[rows++];
      const bool held = old && old->touching;
      row.source = static_cast<int32_t>(source), row.touching = touching;
      row.q = old ? old->q : field_->now(source);
      row.along = held ? old->along : smaller(larger(along, 0.0), n.depth);
      row.grip =
          old && (held || !touching) ? old->grip : p.drag * (across(row.q, n.axis) - (n.entry + row.along * n.axis));
    }
    next_count_ = rows;
    return done;
  }

  /// Number of sources that are touched, are contacts already, or both.
  int64_t together(int64_t touched) const {
    int64_t count = touched, i = 0;
    for (int64_t j = 0; j < state.count; ++j) {
      while (i < touched && touched_[i] < state.contacts[j].source) ++i;
      if (i == touched || touched_[i] != state.contacts[j].source) ++count;
    }
    return count;
  }

  /// Sources within delta of the shaft, equation (13), ascending; their number.
  int64_t find_touched(const Needle<D>& n) {
    const Interaction& p = scene.interaction;
    if (n.depth < ZERO_LENGTH) return 0;
    // rest positions further than this cannot be within delta after their displacement
    const double far = (p.delta + p.drag * state.reach) * (1 + 1e-6) + 1e-9;
    const double near2 = p.delta * p.delta * (1 + 1e-9);
    const ContactLattice<D>& lattice = scene.lattice;
    int32_t low[D], high[D];
    for (int d = 0; d < D; ++d)
      if (!lattice_range(d, smaller(n.entry[d], n.tip[d]) - far, larger(n.entry[d], n.tip[d]) + far, low[d], high[d]))
        return 0;
    int64_t count = 0;
    int32_t line[D];
    for (int d = 0; d < D; ++d) line[d] = low[d];
    for (;;) {
      int32_t first, last;
      if (line_range(n, line, far, first, last))
        for (int32_t i = larger(first, low[0]); i <= smaller(last, high[0]); ++i) {
          int64_t place = 0;
          for (int d = D; d-- > 1;) place = place * lattice.lines[d] + line[d];
          const int32_t source = lattice.source[place * lattice.lines[0] + i];
          if (source < 0) continue;
          const Distance<D> to = distance(n, scene.source[source], field_->now(source), p.drag);
          // the root, for nodes at delta itself, as a lattice has them: its square would tell some of them apart by rounding
          if (to.d2 <= near2 && std::sqrt(to.d2) <= p.delta && to.along <= n.depth - lattice.gap)
            touched_[count] = source, alongs_[count++] = to.along;
        }
      int d = 1;
      while (d < D && ++line[d] > high[d]) line[d] = low[d], ++d;
      if (d == D) return count;
    }
  }
  bool lattice_range(int d, double from, double to, int32_t& first, int32_t& last) const {
    const ContactLattice<D>& lattice = scene.lattice;
    const double h = scene.grid.spacing[d] * lattice.stride[d],
                 x0 = scene.grid.origin[d] + scene.grid.spacing[d] * lattice.first[d];
    const double a = std::ceil((from - x0) / h - 1e-9), b = std::floor((to - x0) / h + 1e-9);
    if (!(a <= lattice.lines[d] - 1 && b >= 0)) return false;
    first = static_cast<int32_t>(larger(a, 0.0)), last = static_cast<int32_t>(smaller(b, lattice.lines[d] - 1.0));
    return first <= last;
  }
  /// Part of a lattice line along x that can be near the shaft.
  bool line_range(const Needle<D>& n, const int32_t (&line)[D], double far, int32_t& first, int32_t& last) const {
    double lo = 0, hi = n.depth;
    for (int d = 1; d < D; ++d) {
      const double y =
          scene.grid.origin[d] + scene.grid.spacing[d] * (scene.lattice.first[d] + scene.lattice.stride[d] * line[d]);
      if (std::fabs(n.axis[d]) > PARALLEL) {
        const double a = (y - far - n.entry[d]) / n.axis[d], b = (y + far - n.entry[d]) / n.axis[d];
        lo = larger(lo, smaller(a, b)), hi = smaller(hi, larger(a, b));
      } else if (std::fabs(y - n.entry[d]) > far) {
        return false;
      }
    }
    if (lo > hi) return false;
    const double a = n.axis[0] * lo, b = n.axis[0] * hi;
    return lattice_range(0, n.entry[0] + smaller(a, b) - far, n.entry[0] + larger(a, b) + far, first, last);
  }

  // ---- How the landmarks move ---------------------------------------------------------------------------------------------------------

  /// New displacement of a contact that touches the needle, equations (14) to (16): loaded while friction asks for more than it has, by at
  /// most the needle's travel; otherwise it relaxes. Across the axis it follows the shaft.
  Vec<D> loaded(const Contact<D>& contact, const Needle<D>& n, double left_over) const {
    const Interaction& p = scene.interaction;
    const double d = std::sqrt(distance(n, scene.source[contact.source], contact.q, p.drag).d2);
    const double f = friction(p, d, n.speed), along = dot(contact.q, n.axis);
    const double sign = f > 0 ? 1.0 : f < 0 ? -1.0 : 0.0;
    const bool loading = sign * (f - along) > 0 || (p.immediate && f != 0);
    const double relaxed = loading ? along : f + (along - f) * left_over;
    const Vec<D> side = across(contact.grip + p.drag * (n.entry + contact.along * n.axis), n.axis);
    const Vec<D> rested = contact.q + (relaxed - along) * n.axis;
    return towards(rested, (loading ? f : relaxed) * n.axis + side, n.travel);
  }

  enum TipKind { none, given, follows, leaves };
  TipKind tip_kind(const Needle<D>& n, double clearance, bool can_move) const {
    const Interaction& p = scene.interaction;
    const TipLandmark<D>& before = state.tip;
    const bool advancing = n.speed >= 0 && n.depth >= ZERO_LENGTH;
    if (clearance <= 0 || p.sigma <= 0) return none;
    if (p.on_node || p.immediate) return advancing && can_move ? given : none;
    // a tip that pushes into tissue where nodes still relax waits until they are gone: two landmarks in one place would tear the field
    double free = INFINITY;
    for (int64_t j = 0; j < next_count_; ++j)
      if (!next_[j].touching) free = smaller(free, norm(scene.source[next_[j].source] - n.tip));
    const bool back = !before.present || before.pushed || norm(n.tip - before.place) <= larger(n.travel, LET_GO);
    if (!(advancing && free > scene.lattice.gap && back)) return before.present ? leaves : none;
    return before.present || n.speed > 0 ? follows : none;
  }

  /// Right-hand sides `q_` for the contacts of `next_`; the tip's displacement for one that it replaces.
  template <class Displacement>
  void fill(int64_t count, const Step& step, Displacement q) {
    for (int64_t j = 0; j < count; ++j)
      q_.set(response_.slot_of[next_[j].source], j == step.on_tip ? step.tip.q : q(j));
    q_.clear_beyond(count);
  }
  int64_t contact_at(const Array<Contact<D>>& contacts, int64_t count, const TipLandmark<D>& tip) const {
    for (int64_t j = 0; tip.present && j < count; ++j)
      if (norm(scene.source[contacts[j].source] - tip.place) <= SAME_PLACE) return j;
    return -1;
  }

  /// New displacements of contacts (`new_q_`) and tip, and the field without the contacts that have left, at those (`free_`). Returns the
  /// displacements to be spread.
  const Sides<D>& move(const Needle<D>& n, Step& step) {
    const Interaction& p = scene.interaction;
    const int64_t k = next_count_;
    const double left_over = kept(p, n.dt);
    for (int64_t j = 0; j < k; ++j) new_q_[j] = next_[j].touching ? loaded(next_[j], n, left_over) : next_[j].q;
    move_tip(n, left_over, step);
    step.on_tip = contact_at(next_, k, step.tip);
    int64_t leaving = 0;
    for (int64_t j = 0; j < k; ++j)
      if (!next_[j].touching && j != step.on_tip) leaving_[leaving++] = j;
    if (leaving) find_free(leaving, step);
    if (step.on_tip >= 0) free_[step.on_tip] = step.tip.q;
    for (int64_t j = 0; j < k; ++j)
      if (!next_[j].touching) new_q_[j] = towards(free_[j] + left_over * (next_[j].q - free_[j]), free_[j], n.travel);
    fill(k, step, [&](int64_t j) { return new_q_[j]; });
    return q_;
  }

  /// The tip's landmark, equation (12), and its column.
  void move_tip(const Needle<D>& n, double left_over, Step& step) {
    const Interaction& p = scene.interaction;
    const TipLandmark<D>& before = state.tip;
    const double clearance = scene.clamps.clearance(scene.grid, n.tip, n.axis);
    Vec<D> place = n.tip;
    bool can_move = true;
    if (p.on_node) {
      const int64_t node = scene.grid.nearest(n.tip);
      place = scene.grid.place(node), can_move = !scene.clamps.hold(scene.grid, node);
    }
    const TipKind kind = tip_kind(n, clearance, can_move);
    if (kind == none) return;
    const double push = tip_push(p, n.depth, clearance);
    if (kind == leaves) place = before.place;
    step.softness = scene.softness_near(place);
    response_.meet(scene.anchored.conditioned(place), tip_column_);
    TipLandmark<D>& tip = step.tip;
    tip.place = place;
    if (kind == given) {
      tip.present = tip.pushed = true;
      tip.q = n.tip + push * n.axis - place;
      return;
    }
    Vec<D> was =
        before.q;  // a tip that begins to push starts from the displacement that the tissue had there before the step
    if (!before.present) {
      fill(next_count_, step, [&](int64_t j) { return next_[j].q; });
      was = response_.at(tip_column_, q_);
    }
    fill(next_count_, step, [&](int64_t j) { return new_q_[j]; });
    const Vec<D> free = response_.at(tip_column_, q_);
    if (kind == follows) {
      double ahead = push;
      if (n.speed <= 0) {  // (17): at rest the whole field relaxes, the tip's push with the contacts
        was = was - dot(was, n.axis) * (1 - left_over) * n.axis;
        ahead = smaller(dot(was, n.axis), push);
      }
      tip.present = tip.pushed = true;
      tip.q = towards(was, ahead * n.axis + across(free, n.axis), n.travel);
    } else if (norm(before.q - free) > LET_GO) {
      tip.present = true, tip.pushed = false;
      tip.q = towards(free + left_over * (before.q - free), free, n.travel);
    }
  }

  /// Field at the contacts that have left, if they were no landmarks. With F those, and P' the inverse for contacts and tip, it is
  /// -P'_FF^-1 w'_F, w' being the weights for displacements that are zero at F.
  void find_free(int64_t leaving, const Step& step) {
    fill(next_count_, step, [&](int64_t j) { return new_q_[j]; });
    for (int64_t i = 0; i < leaving; ++i) q_.set(response_.slot_of[next_[leaving_[i]].source], Vec<D>{});
    q_.clear_beyond(next_count_);
    const Column<D>* column = step.has_column() ? &tip_column_ : nullptr;
    Vec<D> s{};
    double S[D][D] = {}, inverse[D][D] = {};
    if (column) {
      s = response_.tip_weight(*column, q_, step.tip.q, step.softness);
      response_.add_softness(column->own, step.softness, S);
      invert_small<D>(c, S, inverse);
    }
    response_.weights(q_, column, s, w_);
    const int64_t n = leaving * c, ld = rounded_up(n, ROW), ldk = response_.ldk;
    double* A = small_.data();
    double* b = small_sides_.data();
    for (int64_t i = 0; i < n; ++i) {
      const int64_t x = scalar_of(i);
      double f[D] = {};
      for (int a = 0; column && a < c; ++a)
        for (int e = 0; e < c; ++e) f[a] += inverse[a][e] * column->Pg[e * ldk + x];
      for (int64_t l = 0; l < n; ++l) {
        const int64_t y = scalar_of(l);
        double value = response_.P[x * ldk + y];
        for (int a = 0; column && a < c; ++a) value += f[a] * column->Pg[a * ldk + y];
        A[i * ld + l] = value;
      }
      for (int r = 0; r < w_.count; ++r) b[r * ld + i] = -w_.side(r)[x];
    }
    solve_positive(A, n, ld, b, w_.count);
    for (int64_t i = 0; i < leaving; ++i)
      for (int d = 0; d < D; ++d) free_[leaving_[i]][d] = c == 1 ? b[d * ld + i] : b[i * D + d];
  }
  int64_t scalar_of(int64_t i) const { return response_.slot_of[next_[leaving_[i / c]].source] * c + i % c; }

  /// A^-1 b of a positive definite A (n, ld) by Cholesky; both are overwritten.
  static void solve_positive(double* A, int64_t n, int64_t ld, double* b, int sides) {
    for (int64_t j = 0; j < n; ++j)
      for (int64_t i = j; i < n; ++i) {
        double sum = A[i * ld + j];
        for (int64_t l = 0; l < j; ++l) sum -= A[i * ld + l] * A[j * ld + l];
        A[i * ld + j] = i == j ? std::sqrt(larger(sum, 1e-300)) : sum / A[j * ld + j];
      }
    for (int r = 0; r < sides; ++r) {
      double* x = b + r * ld;
      for (int64_t i = 0; i < n; ++i) {
        for (int64_t l = 0; l < i; ++l) x[i] -= A[i * ld + l] * x[l];
        x[i] /= A[i * ld + i];
      }
      for (int64_t i = n; i-- > 0;) {
        for (int64_t l = i + 1; l < n; ++l) x[i] -= A[l * ld + i] * x[l];
        x[i] /= A[i * ld + i];
      }
    }
  }

  // ---- The field ----------------------------------------------------------------------------------------------------------------------

  /// Field of contacts with displacements `q` and the step's tip, whose column has been met.
  Largest spread(const Sides<D>& q, Step& step, bool at_rest) {
    const Column<D>* column = step.has_column() ? &tip_column_ : nullptr;
    step.s = column ? response_.tip_weight(*column, q, step.tip.q, step.softness) : Vec<D>{};
    response_.weights(q, column, step.s, w_);
    return response_.field(w_, column, step.s, at_rest);
  }

  struct Weighted {
    const Column<D>* column;
    Vec<D> s;
  };
  /// Weights (`w_`) of contacts that are set, and of a tip.
  Weighted solve(const Array<Contact<D>>& contacts, int64_t count, const TipLandmark<D>& tip) {
    const int64_t on_tip = contact_at(contacts, count, tip);
    for (int64_t j = 0; j < count; ++j)
      q_.set(response_.slot_of[contacts[j].source], j == on_tip ? tip.q : contacts[j].q);
    q_.clear_beyond(count);
    Weighted weighted{tip.present && on_tip < 0 ? &tip_column_ : nullptr, {}};
    if (weighted.column) {
      response_.meet(scene.anchored.conditioned(tip.place), tip_column_);
      weighted.s = response_.tip_weight(tip_column_, q_, tip.q, scene.softness_near(tip.place));
    }
    response_.weights(q_, weighted.column, weighted.s, w_);
    return weighted;
  }
  Largest solve_and_spread(const Array<Contact<D>>& contacts, int64_t count, const TipLandmark<D>& tip) {
    const Weighted weighted = solve(contacts, count, tip);
    return response_.field(w_, weighted.column, weighted.s, false);
  }
  double reach2_of_next() const {
    double reach2 = 0;
    for (int64_t i = 0; i < scene.sources(); ++i) reach2 = larger(reach2, dot(field_->next(i), field_->next(i)));
    return reach2;
  }

  /// How far a node may move in this step, mm.
  double allowed(const Needle<D>& n) const {
    double longest2 = state.tip.present ? dot(state.tip.q, state.tip.q) : 0.0;
    for (int64_t j = 0; j < next_count_; ++j) longest2 = larger(longest2, dot(next_[j].q, next_[j].q));
    return CALM * (n.travel - std::sqrt(longest2) * std::expm1(-scene.interaction.alpha3 * n.dt)) + LET_GO;
  }

  /// Move the landmarks only so far that no node moves beyond the limit. A few landmarks close together can swing the field far from them
  /// much further than they move themselves. Landmarks that stay at the displacement which the field already has change nothing, and the field
  /// is linear in their displacements, so the largest share that keeps the limit is found at once.
  void hold_back(Step& step, double limit) {
    Step stay = step;
    if (step.tip.present) stay.tip.q = value_before(step.tip.place);
    fill(next_count_, stay, [&](int64_t j) { return next_[j].q; });
    if (step.has_column()) response_.meet(scene.anchored.conditioned(step.tip.place), tip_column_);
    spread(q_, stay, true);
    const double share = largest_share(limit);
    for (int64_t j = 0; j < next_count_; ++j) new_q_[j] = next_[j].q + share * (new_q_[j] - next_[j].q);
    step.tip.q = stay.tip.q + share * (step.tip.q - stay.tip.q);
    field_->blend(share);
  }
  /// Largest t in [0, 1] with |rest + t (next - rest) - field| <= limit at every source; 0 where even `rest` is beyond.
  double largest_share(double limit) const {
    double share = 1;
    for (int64_t i = 0; i < scene.sources(); ++i) {
      const Vec<D> start = field_->rest(i) - field_->now(i), step = field_->next(i) - field_->rest(i);
      const double a = dot(step, step), b = dot(start, step), e = dot(start, start) - limit * limit;
      if (e > 0) return 0;
      if (a > 0) share = smaller(share, (std::sqrt(larger(b * b - a * e, 0.0)) - b) / a);
    }
    return share;
  }
  /// Field of the state before the step at a point, mm; contacts that have joined since have the displacement it had there.
  Vec<D> value_before(const Vec<D>& p) {
    const TipLandmark<D>& before = state.tip;
    Step last;
    last.tip = before, last.on_tip = contact_at(next_, next_count_, before);
    fill(next_count_, last, [&](int64_t j) { return next_[j].q; });
    response_.meet(scene.anchored.conditioned(p), tip_column_);
    Vec<D> u = response_.at(tip_column_, q_);
    if (!last.has_column()) return u;
    response_.meet(scene.anchored.conditioned(before.place), other_column_);
    const Vec<D> s = response_.tip_weight(other_column_, q_, before.q, scene.softness_near(before.place));
    double G[D][D];
    response_.between(tip_column_, other_column_, G);
    return u + response_.times(G, s);
  }

  /// Keep the contacts that touch the needle or are not yet at rest in the field without them; how many.
  int64_t release() {
    int64_t kept_count = 0;
    for (int64_t j = 0; j < next_count_; ++j)
      if (next_[j].touching || norm(next_[j].q - free_[j]) > LET_GO) next_[kept_count++] = next_[j];
    return kept_count;
  }
};

}  // namespace echospline::ECHOSPLINE_CORE
