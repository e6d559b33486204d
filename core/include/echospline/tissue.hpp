// One session: the state of the tissue, and the step from a needle pose to the field, Algorithm 2.
#pragma once
#include "response.hpp"
#include "scene.hpp"

namespace echospline::ECHOSPLINE_CORE {

constexpr double SAME_PLACE =
    1e-6;  // mm; a tip closer than this to a contact replaces it as landmark, and to what is clamped pushes nothing
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

  /// State after the needle has moved to a pose. On failure the state has not changed. A needle that moves far does so in substeps, so that
  /// what it touches and leaves does not depend on the time step.
  Outcome advance(const echospline_pose& given) {
    const bool immediate = scene.interaction.immediate;
    const Pose<D> now{point_of<D>(given.entry), point_of<D>(given.tip)};
    const Pose<D> before = state.posed ? state.before : Pose<D>{now.entry, now.entry};
    const double pieces = std::ceil(travel_of(before, now) / longest_substep(scene.interaction) - 1e-9);
    const int parts = immediate ? 1 : static_cast<int>(smaller(larger(pieces, 1.0), 1.0 * MOST_SUBSTEPS));
    const int64_t held_back = state.held_back;
    if (parts > 1) keep_state();
    Pose<D> from = before;
    for (int part = 1; part <= parts; ++part) {
      const Pose<D> to = part == parts ? now : between(before, now, static_cast<double>(part) / parts);
      const Outcome outcome = substep(needle_at(from, to, given.speed, given.dt / parts, immediate));
      if (outcome != done) {
        if (part > 1) go_back();
        return outcome;
      }
      from = to;
    }
    state.held_back = held_back + (state.held_back > held_back);
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

  Array<Contact<D>> kept_;  ///< contacts of the state before a step, in which more than one substep may fail
  State<D> kept_state_;     ///< the rest of it
  Array<double> while_touched_, since_left_;  ///< of the contacts of `next_`: way of the needle, mm

  void keep_state() {
    for (int64_t j = 0; j < state.count; ++j) kept_[j] = state.contacts[j];
    kept_state_.count = state.count, kept_state_.tip = state.tip, kept_state_.posed = state.posed;
    kept_state_.before = state.before, kept_state_.held_back = state.held_back;
  }
  /// Back to the state that was kept: its contacts have been solved before.
  void go_back() {
    restore(kept_state_.count, [&](Array<Contact<D>>& contacts, State<D>& fresh) {
      for (int64_t j = 0; j < kept_state_.count; ++j) contacts[j] = kept_[j];
      fresh.tip = kept_state_.tip, fresh.posed = kept_state_.posed, fresh.before = kept_state_.before;
      fresh.held_back = kept_state_.held_back;
    });
  }

  /// State after the needle has moved by a short way. On failure the state has not changed.
  Outcome substep(const Needle<D>& n) {
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
      hold_back(n, step, limit);
      reach2 = reach2_of_next();
      ++held_back;
    }
    for (int64_t j = 0; j < next_count_; ++j) next_[j].q = new_q_[j];
    if (release(step)) {
      if (!response_.check(q_, w_)) return not_solved;
      reach2 = solve_and_spread(next_, next_count_, step.tip).reach2;
    }
    // nothing can fail from here on
    state.contacts.swap(next_);
    state.count = next_count_, state.tip = step.tip, state.posed = true, state.before = {n.entry, n.tip};
    state.reach = std::sqrt(reach2), state.held_back = held_back;
    field_->commit();
    return done;
  }

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
    Array<Contact<D>> kept, kept_next, kept_before;
    if (!kept.reserve(contacts) || !kept_next.reserve(contacts) || !kept_before.reserve(contacts)) return false;
    for (int64_t i = 0; i < kept_state_.count; ++i) kept_before[i] = kept_[i];
    for (int64_t i = 0; i < state.count; ++i) kept[i] = state.contacts[i];
    for (int64_t i = 0; i < next_count_; ++i) kept_next[i] = next_[i];
    if (!new_q_.reserve(contacts) || !free_.reserve(contacts) || !tip_column_.reserve(c, ld, wide) ||
        !other_column_.reserve(c, ld, wide) || !q_.reserve(c, wide) || !w_.reserve(c, wide) ||
        !leaving_.reserve(contacts) || !small_.reserve(contacts * c * wide) || !small_sides_.reserve(D * wide) ||
        !while_touched_.reserve(contacts) || !since_left_.reserve(contacts) || !response_.reserve(contacts))
      return false;
    state.contacts.swap(kept), next_.swap(kept_next), kept_.swap(kept_before);
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
      const bool held = old && old->touching;
      ways(n, scene.source[source], touching, held, while_touched_[rows], since_left_[rows]);
      Contact<D>& row = next_[rows++];
      row.source = static_cast<int32_t>(source), row.touching = touching;
      row.q = old ? old->q : field_->now(source);
      row.along = held ? old->along : smaller(larger(along, 0.0), n.depth);
      row.grip =
          old && (held || !touching) ? old->grip : p.drag * (across(row.q, n.axis) - (n.entry + row.along * n.axis));
    }
    next_count_ = rows;
    return done;
  }

  /// How far the needle moved while it touched a contact, and since it left it, mm. The tip has passed a contact that joins, and drawn back
  /// from one that leaves, somewhere within the step.
  void ways(const Needle<D>& n, const Vec<D>& p, bool touching, bool held, double& touched, double& left) const {
    touched = touching ? n.travel : 0.0, left = touching ? 0.0 : n.travel;
    if (touching == held || scene.interaction.immediate) return;
    const bool out = n.depth < ZERO_LENGTH;
    const double passed = n.depth - scene.lattice.gap - dot(p - n.entry, out ? n.axis_before : n.axis);
    if (touching) {
      touched = smaller(larger(passed, 0.0), n.travel);
    } else {
      if (passed < 0 || out) left = smaller(larger(-passed, 0.0), n.travel);
      touched = n.travel - left;
    }
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

  /// New displacement of a contact that touches the needle, or touched it in this step; equations (14) to (16). Across the axis it follows
  /// the shaft. Along it, tissue that sticks moves with the shaft within what friction holds, the stop operator of Coulomb friction; otherwise
  /// it is loaded while friction asks for more than it has, by at most the needle's way, or relaxes.
  Vec<D> loaded(const Contact<D>& contact, const Needle<D>& n, double way, double left_over) const {
    const Interaction& p = scene.interaction;
    const double d = std::sqrt(distance(n, scene.source[contact.source], contact.q, p.drag).d2);
    const double along = dot(contact.q, n.axis);
    double f = friction(p, d, p.sticks ? p.friction_speed : n.speed);
    if (!p.immediate) f = yielding(f, scene.clearance[contact.source]);
    // a shaft that hardly is in the tissue drags it no further than its own depth
    const double most = p.immediate ? INFINITY : n.depth;
    const Vec<D> side = across(contact.grip + p.drag * (n.entry + contact.along * n.axis), n.axis);
    if (p.sticks) {
      const double held = smaller(std::fabs(f), most), moved = smaller(larger(n.moved, -way), way);
      return towards(contact.q, smaller(larger(along + moved, -held), held) * n.axis + side, way);
    }
    const double sign = f > 0 ? 1.0 : f < 0 ? -1.0 : 0.0;
    const bool loading = sign * (f - along) > 0 || (p.immediate && f != 0);
    const double relaxed = loading ? along : f + (along - f) * left_over;
    const double wanted = smaller(larger(loading ? f : relaxed, -most), most);
    return towards(contact.q + (relaxed - along) * n.axis, wanted * n.axis + side, way);
  }

  enum TipKind { none, given, follows, leaves };
  TipKind tip_kind(const Needle<D>& n, double clearance, bool can_move) const {
    const Interaction& p = scene.interaction;
    const TipLandmark<D>& before = state.tip;
    const bool advancing = n.speed >= 0 && n.depth >= ZERO_LENGTH;
    if (p.sigma <= 0) return none;
    if (p.on_node || p.immediate) return clearance > 0 && advancing && can_move ? given : none;
    const bool back = !before.present || before.pushed || norm(n.tip - before.place) <= larger(n.travel, LET_GO);
    if (!(advancing && clearance > SAME_PLACE && clear_of_leaving(n.tip) && back)) return before.present ? leaves : none;
    return before.present || n.speed > 0 ? follows : none;
  }
  /// A tip that begins to push into tissue where nodes still relax waits until they are gone: two landmarks in one place would tear the field.
  bool clear_of_leaving(const Vec<D>& p) const {
    double nearest = INFINITY;
    for (int64_t j = 0; j < next_count_; ++j)
      if (!next_[j].touching) nearest = smaller(nearest, norm(scene.source[next_[j].source] - p));
    return nearest > scene.lattice.gap;
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
    for (int64_t j = 0; j < k; ++j) {
      const bool handled = next_[j].touching || while_touched_[j] > 0;  // one that has just left was dragged until then
      new_q_[j] = handled ? loaded(next_[j], n, while_touched_[j], left_over) : next_[j].q;
    }
    if (p.sticks && !p.on_node)
      move_sticking_tip(n, left_over, step);
    else
      move_tip(n, left_over, step);
    step.on_tip = contact_at(next_, k, step.tip);
    int64_t leaving = 0;
    for (int64_t j = 0; j < k; ++j)
      if (!next_[j].touching && j != step.on_tip) leaving_[leaving++] = j;
    if (leaving) find_free(leaving, step);
    if (step.on_tip >= 0) free_[step.on_tip] = step.tip.q;
    for (int64_t j = 0; j < k; ++j)
      if (!next_[j].touching) {
        const bool whole = !(n.travel > 0 && n.travel < INFINITY) || since_left_[j] == n.travel;
        const double left = whole ? left_over : kept(p, n.dt * (since_left_[j] / n.travel));
        new_q_[j] = towards(free_[j] + left * (new_q_[j] - free_[j]), free_[j], since_left_[j]);
      }
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
    const double push = p.immediate ? tip_push(p, n.depth, clearance) : tip_push_yielding(p, n.depth, clearance);
    if (kind == leaves) return leave_tip(left_over, n.travel, true, step);
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
    double ahead = push;
    if (n.speed <= 0) {  // (17): at rest the whole field relaxes, the tip's push with the contacts
      was = was - dot(was, n.axis) * (1 - left_over) * n.axis;
      ahead = smaller(dot(was, n.axis), push);
    }
    tip.present = tip.pushed = true;
    tip.q = towards(was, ahead * n.axis + across(free, n.axis), n.travel);
  }

  /// The tip's landmark where it pushes and never pulls: a stop with one side, whatever the speed. It moves on with a tip that advances, pushed
  /// ahead by up to sigma. A tip that draws back lets the tissue there come back by as much, until the landmark does nothing and is gone; one
  /// that returns before that takes it up.
  void move_sticking_tip(const Needle<D>& n, double left_over, Step& step) {
    const Interaction& p = scene.interaction;
    const TipLandmark<D>& before = state.tip;
    if (!(p.sigma > 0)) return;
    double lead = 0;
    bool leaving = n.depth < ZERO_LENGTH;
    if (before.present && before.pushed)
      lead = larger(0.0, dot(before.place - n.tip_before, n.axis_before) - n.moved);
    else if (before.present)
      leaving = leaving || n.moved <= 0 || norm(n.tip - before.place) > larger(n.travel, LET_GO);
    const Vec<D> place = n.tip + lead * n.axis;
    const double clearance = scene.clamps.clearance(scene.grid, place, n.axis);
    if (leaving || clearance <= SAME_PLACE) {
      if (before.present) leave_tip(left_over, n.travel, true, step);
      return;
    }
    if (!before.present && (n.moved <= 0 || !clear_of_leaving(place))) return;
    step.softness = scene.softness_near(place);
    response_.meet(scene.anchored.conditioned(place), tip_column_);
    Vec<D> was = before.q;  // or the displacement that the tissue had there before the step
    if (!before.present) {
      fill(next_count_, step, [&](int64_t j) { return next_[j].q; });
      was = response_.at(tip_column_, q_);
    }
    fill(next_count_, step, [&](int64_t j) { return new_q_[j]; });
    const Vec<D> free = response_.at(tip_column_, q_);
    const double push = tip_push_yielding(p, n.depth, clearance);
    const double ahead = larger(smaller(dot(was, n.axis) + n.moved, push), dot(free, n.axis));
    const Vec<D> pushed = towards(was, ahead * n.axis + across(free, n.axis), n.travel);
    if (n.moved <= 0 && norm(pushed - free) <= LET_GO) return;
    step.tip.present = step.tip.pushed = true, step.tip.place = place, step.tip.q = pushed;
  }

  /// Let the landmark that the tip has left relax to the field without it, then go where `drop` says so.
  void leave_tip(double left_over, double travel, bool drop, Step& step) {
    const TipLandmark<D>& before = state.tip;
    step.tip = {}, step.on_tip = -1;
    step.softness = scene.softness_near(before.place);
    response_.meet(scene.anchored.conditioned(before.place), tip_column_);
    fill(next_count_, step, [&](int64_t j) { return new_q_[j]; });
    const Vec<D> free = response_.at(tip_column_, q_);
    step.tip.place = before.place;
    if (drop && norm(before.q - free) <= LET_GO) return;
    step.tip.present = true, step.tip.pushed = false;
    step.tip.q = towards(free + left_over * (before.q - free), free, travel);
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
  /// is linear in their displacements, so the largest share that keeps the limit is found at once. Only a tip that moves on takes a landmark
  /// away where it was; where that alone is too much, it leaves its landmark there.
  void hold_back(const Needle<D>& n, Step& step, double limit) {
    Step stay = step;
    if (step.tip.present) stay.tip.q = value_before(step.tip.place);
    spread_at_rest(stay);
    if (state.tip.present && change2_at_rest() > limit * limit) {
      leave_tip(kept(scene.interaction, n.dt), limit / CALM, false, step);
      step.on_tip = contact_at(next_, next_count_, step.tip);
      fill(next_count_, step, [&](int64_t j) { return new_q_[j]; });
      spread(q_, step, false);
      stay = step, stay.tip.q = state.tip.q;
      spread_at_rest(stay);
    }
    const double share = largest_share(limit);
    for (int64_t j = 0; j < next_count_; ++j) new_q_[j] = next_[j].q + share * (new_q_[j] - next_[j].q);
    step.tip.q = stay.tip.q + share * (step.tip.q - stay.tip.q);
    field_->blend(share);
  }
  /// Field of landmarks that stay where the field has them.
  void spread_at_rest(Step& stay) {
    fill(next_count_, stay, [&](int64_t j) { return next_[j].q; });
    if (stay.has_column()) response_.meet(scene.anchored.conditioned(stay.tip.place), tip_column_);
    spread(q_, stay, true);
  }
  double change2_at_rest() const {
    double change2 = 0;
    for (int64_t i = 0; i < scene.sources(); ++i) {
      const Vec<D> change = field_->rest(i) - field_->now(i);
      change2 = larger(change2, dot(change, change));
    }
    return change2;
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

  /// Drop contacts that the needle has left and that no longer matter; whether there were any. One that has come to where it goes may still
  /// hold back others that have not; so each is judged by the field without it alone, and all that go in one step change the field by no
  /// more than one may.
  bool release(const Step& given) {
    Step step = given;
    double changed = 0;
    bool weighed = false, any = false;
    for (int64_t j = 0; j < next_count_;) {
      if (next_[j].touching || norm(next_[j].q - free_[j]) > LET_GO) {
        ++j;
        continue;
      }
      if (!weighed) weigh(step);
      weighed = true;
      const double change = j == step.on_tip ? norm(next_[j].q - step.tip.q) : misfit_without(j, step);
      if (!(changed + change <= LET_GO)) {
        ++j;
        continue;
      }
      changed += change, any = true, weighed = false;
      response_.leave(response_.slot_of[next_[j].source]), ++left;
      --next_count_;
      for (int64_t i = j; i < next_count_; ++i) next_[i] = next_[i + 1], free_[i] = free_[i + 1];
      step.on_tip = contact_at(next_, next_count_, step.tip);
    }
    return any;
  }
  /// Weights (`w_`) of the contacts as they are, and of the step's tip.
  void weigh(Step& step) {
    fill(next_count_, step, [&](int64_t j) { return next_[j].q; });
    const Column<D>* column = step.has_column() ? &tip_column_ : nullptr;
    if (column) {
      response_.meet(scene.anchored.conditioned(step.tip.place), tip_column_);
      step.softness = scene.softness_near(step.tip.place);
      step.s = response_.tip_weight(tip_column_, q_, step.tip.q, step.softness);
    }
    response_.weights(q_, column, step.s, w_);
  }
  /// Distance of a contact's displacement from the field that there is without it, mm: its weight over its diagonal of the inverse.
  double misfit_without(int64_t j, const Step& step) const {
    const int64_t slot = response_.slot_of[next_[j].source], ldk = response_.ldk;
    const Column<D>& column = tip_column_;
    double own[D][D], S[D][D] = {}, inverse[D][D] = {};
    if (step.has_column()) {
      response_.add_softness(column.own, step.softness, S);
      invert_small<D>(c, S, inverse);
    }
    for (int a = 0; a < c; ++a)
      for (int e = 0; e < c; ++e) {
        const int64_t x = slot * c + a, y = slot * c + e;
        own[a][e] = response_.P[x * ldk + y];
        for (int f = 0; step.has_column() && f < c; ++f)
          for (int g = 0; g < c; ++g) own[a][e] += column.Pg[f * ldk + x] * inverse[f][g] * column.Pg[g * ldk + y];
      }
    Vec<D> misfit;
    for (int d = 0; d < D; ++d) misfit[d] = w_.at(slot, d);
    if (c == 1)
      for (int d = 0; d < D; ++d) misfit[d] /= own[0][0];
    else
      solve_small<D>(D, own, misfit.v);
    return norm(misfit);
  }
};

}  // namespace echospline::ECHOSPLINE_CORE
