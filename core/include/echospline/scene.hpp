// A scene: mesh, clamped edges, parameters, and what can be computed of them once. Never changes after `build`; threads share it.
#pragma once
#include "anchored_kernel.hpp"
#include "fine_mesh.hpp"
#include "grid.hpp"
#include "needle.hpp"
#include "response.hpp"

namespace echospline::ECHOSPLINE_CORE {

constexpr int64_t FINE = 20000;     // nodes above which a plane mesh is evaluated from a coarse one
constexpr int64_t FIRST_ROOM = 192;  // contacts for which memory is reserved unless options say otherwise

template <int D, class Kernel, class Real>
struct Scene {
  static constexpr int c = Kernel::components;
  typedef AnchoredKernel<D, Kernel> Anchored;

  Grid<D> grid;
  Clamps<D> clamps;
  ContactLattice<D> lattice;
  Interaction interaction;
  Anchored anchored;
  Array<double> stiffness;  ///< per node; empty: infinite
  Array<Vec<D>> source;     ///< rest position of every source, mm
  Array<int64_t> at;        ///< which of the points every source is
  Points<D, Real> points;   ///< where the field is kept at every step
  Array<Real> mask;         ///< 1 at sources, else 0
  Table<D, Kernel, Real> table;
  CoarseGrid<D> coarse;     ///< of a fine plane mesh
  int64_t contact_room = 0;
  uint64_t fingerprint = 0;  ///< of everything that a state depends on

  enum Outcome { ready, no_memory, not_held };

  bool fine() const { return D == 2 && grid.size() > FINE; }
  int64_t sources() const { return source.size(); }
  /// A source's place, conditioned and rounded to the field's precision, so that a contact stands on its node to the last digit.
  Vec<D> contact_place(int32_t i) const {
    Vec<D> x = anchored.conditioned(source[i]);
    for (int d = 0; d < D; ++d) x[d] = static_cast<Real>(x[d]);
    return x;
  }

  double softness_at(int64_t node) const { return stiffness.size() ? anchored.softness(stiffness[node]) : 0.0; }
  double softness_near(const Vec<D>& p) const { return stiffness.size() ? softness_at(grid.nearest(p)) : 0.0; }

  /// Compute what grid, clamps, interaction and stiffness imply.
  template <class KernelFor>
  Outcome build(double contact_spacing, double anchor_spacing, KernelFor kernel_for) {
    Array<Vec<D>> anchors;
    if (!anchors.reserve(clamps.anchors(grid, anchor_spacing, nullptr))) return no_memory;
    const int64_t count = clamps.anchors(grid, anchor_spacing, anchors.data());
    switch (anchored.build(anchors.data(), count, kernel_for)) {
      case Anchored::no_memory: return no_memory;
      case Anchored::not_held: return not_held;
      case Anchored::ready: break;
    }
    if (!lattice.build(grid, clamps, contact_spacing)) return no_memory;
    const int64_t K = lattice.node.size();
    if (!source.reserve(K) || !at.reserve(K)) return no_memory;
    for (int64_t i = 0; i < K; ++i) source[i] = grid.place(lattice.node[i]);
    return build_points() ? ready : no_memory;
  }

 private:
  bool build_points() {
    const int64_t K = sources();
    bool there;
    if constexpr (D == 3) {
      there = points.build(K, [&](int64_t i) { return anchored.conditioned(source[i]); });
      for (int64_t i = 0; i < K; ++i) at[i] = i;
    } else if (fine()) {
      coarse.build(grid);
      const int64_t first = coarse.grid.size();
      there = points.build(first + K, [&](int64_t i) { return anchored.conditioned(i < first ? coarse.grid.place(i) : source[i - first]); });
      for (int64_t i = 0; i < K; ++i) at[i] = first + i;
    } else {
      there = points.build(grid.size(), [&](int64_t i) { return anchored.conditioned(grid.place(i)); });
      for (int64_t i = 0; i < K; ++i) at[i] = lattice.node[i];
    }
    if (!there || !mask.reserve(points.room())) return false;
    for (int64_t i = 0; i < K; ++i) mask[at[i]] = 1;
    if constexpr (D == 2) return table.build(anchored, points);
    return true;
  }
};

}  // namespace echospline::ECHOSPLINE_CORE
