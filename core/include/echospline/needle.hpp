// The needle: where it is, what it does to the tissue, and how it follows a hand; equations (10) to (17).
//
// Forces never appear: each effect is a displacement of a landmark, in mm.
#pragma once
#include <cmath>

#include "echospline.h"
#include "lanes.hpp"
#include "vec.hpp"

namespace echospline::ECHOSPLINE_CORE {

constexpr double ZERO_LENGTH =
    1e-9;  // mm; a needle shorter than this has no direction, touches nothing and pushes nothing
constexpr double LET_GO =
    2e-5;  // mm; a landmark that has left the needle is dropped once this close to the field without it
constexpr double CALM =
    2.5;  // no node moves further in a step than this times the needle's travel and the relaxation due
constexpr double SUBSTEP = 0.25;  // mm of travel in a substep where friction has no reach
constexpr int MOST_SUBSTEPS =
    100;                          // in one step; a needle that moves further at once has been put elsewhere, not moved
constexpr double ARRIVED = 1e-4;  // mm; a needle this near to where it is commanded is put exactly there

/// Parameters of the interaction, in the paper's names.
struct Interaction {
  double sigma;           ///< push of the tip, (12), mm
  double delta;           ///< reach of friction, (13), mm
  double alpha1, alpha2;  ///< friction, (15), s
  double alpha3;          ///< relaxation, (16), 1/s
  double length;          ///< in the exponential of (15), mm
  double drag;            ///< share of sideways motion that contacts follow
  double friction_speed;  ///< at which (15) says how far friction holds tissue that sticks, mm/s
  bool immediate;         ///< friction is there at once, as printed
  bool sticks;            ///< tissue sticks to the shaft and slips; otherwise it follows friction and relaxes
  bool on_node;           ///< the tip's landmark is the nearest mesh node, as printed
};

template <int D>
struct Pose {
  Vec<D> entry, tip;
};
template <int D>
inline Pose<D> between(const Pose<D>& a, const Pose<D>& b, double share) {
  return {a.entry + share * (b.entry - a.entry), a.tip + share * (b.tip - a.tip)};
}
/// Longest way that a point of the shaft has moved between two poses, mm: a straight needle, at one of its ends.
template <int D>
inline double travel_of(const Pose<D>& a, const Pose<D>& b) {
  return larger(norm(b.entry - a.entry), norm(b.tip - a.tip));
}
/// Unit vector from entry to tip; zero for a needle of zero length.
template <int D>
inline Vec<D> axis_of(const Pose<D>& pose) {
  const double depth = norm(pose.tip - pose.entry);
  return (depth >= ZERO_LENGTH ? 1 / depth : 0.0) * (pose.tip - pose.entry);
}

/// A pose and how the needle came there.
template <int D>
struct Needle {
  Vec<D> entry, tip, axis;
  Vec<D> tip_before, axis_before;
  double depth, speed;
  double moved;   ///< way of the shaft along its axis, mm; negative on withdrawal
  double travel;  ///< longest way that a point of the shaft has moved, mm; infinite with immediate loading
  double dt;
};

template <int D>
inline Needle<D> needle_at(const Pose<D>& before, const Pose<D>& now, double speed, double dt, bool immediate) {
  Needle<D> n;
  n.entry = now.entry, n.tip = now.tip, n.axis = axis_of(now), n.depth = norm(now.tip - now.entry);
  n.tip_before = before.tip, n.axis_before = axis_of(before);
  n.moved = dot(n.tip - before.tip, n.axis);
  n.travel = immediate ? INFINITY : travel_of(before, now);
  n.speed = speed, n.dt = dt;
  return n;
}

/// Distance along the axis from the entry, and the square of d of equation (13), of a point displaced by u. Tissue that a tilting needle has
/// pushed aside is still beside it: the part `drag` of u across the axis counts.
template <int D>
struct Distance {
  double along, d2;
};
template <int D>
inline Distance<D> distance(const Needle<D>& n, const Vec<D>& p, const Vec<D>& u, double drag) {
  const Vec<D> offset = p + drag * across(u, n.axis) - n.entry;
  const double along = dot(offset, n.axis), beyond = along - smaller(larger(along, 0.0), n.depth);
  const Vec<D> aside = offset - along * n.axis;
  return {along, dot(aside, aside) + beyond * beyond};
}

/// Displacement along the axis of tissue at distance d from the shaft, equations (14) and (15), mm.
inline double friction(const Interaction& p, double d, double speed) {
  return (p.alpha1 + p.alpha2 / (1 + std::exp(smaller(d / p.length, 700.0)))) * speed;
}
/// What friction asks for beside what is clamped, which cannot follow: it fades over five times itself, mm. A landmark there that did follow
/// would give the spline a slope at the clamp, which a thin plate carries far away.
inline double yielding(double f, double clearance) {
  const double reach = 5 * std::fabs(f);
  if (!(clearance < reach)) return f;
  const double near = clearance / reach, step = near * near * (3 - 2 * near);
  return f * step * step;
}
/// Travel after which a step looks again at who touches the needle, mm: a sixth of friction's reach. Longer ones would depend on the time step.
inline double longest_substep(const Interaction& p) { return p.delta > 0 ? p.delta / 6 : SUBSTEP; }
/// How far the tip pushes, mm, where friction is not at once: beside what is clamped it fades as friction does.
inline double tip_push_yielding(const Interaction& p, double depth, double clearance) {
  return yielding(smaller(p.sigma, depth), clearance);
}
/// Share of a displacement that is left after dt, equation (16).
inline double kept(const Interaction& p, double dt) { return std::exp(-p.alpha3 * dt); }
/// Move a displacement towards its target, by at most the travel.
template <int D>
inline Vec<D> towards(const Vec<D>& q, const Vec<D>& target, double travel) {
  const Vec<D> gap = target - q;
  return q + smaller(1.0, travel / larger(norm(gap), 1e-300)) * gap;
}
/// How far the tip pushes the tissue ahead of it, sigma of equation (12), mm: the depth itself while that is less, fading over four sigma
/// towards what is clamped, which cannot be pushed.
inline double tip_push(const Interaction& p, double depth, double clearance) {
  if (!(p.sigma > 0)) return 0;
  const double near = smaller(1.0, clearance / (4 * p.sigma));
  return smaller(p.sigma, depth) * near * near * (3 - 2 * near);
}

/// Move one end of a needle towards its goal.
template <int D>
inline Vec<D> approach(const Vec<D>& start, const Vec<D>& goal, double share, double longest) {
  const Vec<D> way = goal - start;
  const double whole = norm(way), step = smaller(share * whole, longest);
  return whole - step < ARRIVED ? goal : start + (step / whole) * way;
}
/// Pose after dt of a needle that follows its command with a lag, no faster than `fastest`.
template <int D>
inline void follow(const echospline_pose& now, const echospline_command& command, echospline_pose& next) {
  const double dt = next.dt, share = command.lag > 0 ? 1 - std::exp(-dt / command.lag) : 1.0;
  const Vec<D> entry = point_of<D>(now.entry), tip = point_of<D>(now.tip);
  const Vec<D> new_entry = approach(entry, point_of<D>(command.entry), share, command.fastest * dt);
  const Vec<D> new_tip = approach(tip, point_of<D>(command.tip), share, command.fastest * dt);
  const Vec<D> shaft = new_tip - new_entry, before = tip - entry;
  const double depth = norm(shaft), depth_before = norm(before);
  const Vec<D> axis = depth > ZERO_LENGTH           ? (1 / depth) * shaft
                      : depth_before >= ZERO_LENGTH ? (1 / depth_before) * before
                                                    : 0.0 * shaft;
  next.speed = dot(shaft - before, axis) / dt;
  for (int d = 0; d < D; ++d) next.entry[d] = new_entry[d], next.tip[d] = new_tip[d];
}

}  // namespace echospline::ECHOSPLINE_CORE
