// A scene: mesh, what is held, parameters, and what can be computed of them once. Never changes after `build`; threads share it.
#pragma once
#include "anchored_kernel.hpp"
#include "grid.hpp"
#include "needle.hpp"
#include "session_field.hpp"

namespace echospline::ECHOSPLINE_CORE {

constexpr int64_t FINE = 20000;      // nodes above which a plane mesh is evaluated from a coarse one
constexpr int64_t FIRST_ROOM = 192;  // contacts for which memory is reserved unless options say otherwise

/// What a scene keeps of its field; `field.hpp` has it for every kernel and precision.
template <int D>
class SceneField {
 public:
  virtual void destroy() { __builtin_trap(); }
  /// A source's place, conditioned and rounded to the field's precision, so that a contact stands on its node to the last digit.
  virtual Vec<D> contact_place(int64_t) const { __builtin_trap(); }
  /// The field of a session, or nullptr when memory runs out.
  virtual SessionField<D>* create_session() const { __builtin_trap(); }

 protected:
  ~SceneField() = default;
};

template <int D>
struct Scene {
  typedef SceneField<D>* (*FieldFor)(const Scene&);

  Grid<D> grid;
  Clamps<D> clamps;
  ContactLattice<D> lattice;
  Interaction interaction;
  AnchoredKernel<D> anchored;
  Array<double> stiffness;  ///< per node; empty: infinite
  Array<Vec<D>> source;     ///< rest position of every source, mm
  Array<double>
      clearance;  ///< distance of every source to what is clamped, mm; beside a sliding edge tissue can follow
  SceneField<D>* field = nullptr;
  int64_t contact_room = 0;
  uint64_t fingerprint = 0;  ///< of everything that a state depends on

  enum Outcome { ready, no_memory, not_held };

  ~Scene() {
    if (field) field->destroy();
  }
  bool fine() const { return D == 2 && grid.size() > FINE; }
  int64_t sources() const { return source.size(); }
  double softness_at(int64_t node) const { return stiffness.size() ? anchored.softness(stiffness[node]) : 0.0; }
  double softness_near(const Vec<D>& p) const { return stiffness.size() ? softness_at(grid.nearest(p)) : 0.0; }

  /// Compute what grid, clamps, interaction and stiffness imply.
  template <class KernelFor>
  Outcome build(double contact_spacing, double anchor_spacing, KernelFor kernel_for, FieldFor field_for) {
    Array<Anchor<D>> anchors;
    const bool affine = kernel_for(1.0).affine;
    if (!anchors.reserve(clamps.anchors(grid, anchor_spacing, affine, nullptr))) return no_memory;
    const int64_t count = clamps.anchors(grid, anchor_spacing, affine, anchors.data());
    switch (anchored.build(anchors.data(), count, kernel_for)) {
      case AnchoredKernel<D>::no_memory: return no_memory;
      case AnchoredKernel<D>::not_held: return not_held;
      case AnchoredKernel<D>::ready: break;
    }
    if (!lattice.build(grid, clamps, contact_spacing) || !source.reserve(lattice.node.size()) ||
        !clearance.reserve(lattice.node.size()))
      return no_memory;
    for (int64_t i = 0; i < sources(); ++i)
      source[i] = grid.place(lattice.node[i]), clearance[i] = clamps.clearance(grid, source[i], Vec<D>{});
    field = field_for(*this);
    return field ? ready : no_memory;
  }
};

}  // namespace echospline::ECHOSPLINE_CORE
