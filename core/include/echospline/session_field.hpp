// The field of one session as the algebra of landmarks sees it: behind this face stand kernels and precisions (`field.hpp`), so that what
// moves the landmarks is compiled once for the plane and once for space.
#pragma once
#include "array.hpp"
#include "vec.hpp"

namespace echospline::ECHOSPLINE_CORE {

/// Largest squares, at sources, of a field's change and of the field, mm^2.
struct Largest {
  double change2, reach2;
};

/// All landmarks as kernels at their places: anchors, contacts, tip; then the motions' coefficients.
template <int D>
struct LandmarkWeights {
  int64_t count = 0;
  double* place = nullptr;  ///< conditioned, (count, D)
  double* weight =
      nullptr;  ///< (count, D), then (motions, D) of the affine motions or (motions) rows of which the first number counts
};

/// Landmarks that the column of another is relative to, one for each component of its weight: a landmark near a sliding edge has an anchor
/// near it for one component alone.
template <int D>
struct Bases {
  Vec<D> place[D] = {};  ///< conditioned
  bool one = true;       ///< all are the same
};

/// What a field is computed from.
template <int D>
struct Weights {
  int64_t count = 0;                ///< contacts
  const double* carried = nullptr;  ///< weights of their kept columns, as `Sides`
  int64_t ld = 0;                   ///< of `carried`
  bool tip = false;                 ///< whether there is a tip with a column of its own
  Vec<D> place{}, s{};              ///< of the tip, conditioned; its weight
  Bases<D> base;                    ///< that its column is relative to
  const double* held = nullptr;     ///< L_B^-1 [U P]' of the tip less that of its bases
  bool at_rest = false;             ///< into the field at rest instead of the next one
  LandmarkWeights<D> landmarks;     ///< where the field needs them
};

/// The field of one session. Functions that a class behind this one does not replace are never called.
template <int D>
class SessionField {
 public:
  virtual void destroy() { __builtin_trap(); }
  /// Room for columns of contacts; `kept` of them stay.
  virtual bool reserve(int64_t, int64_t) { __builtin_trap(); }
  /// Compute and keep the column of a landmark at p, less that of its bases; `held` is L_B^-1 [U P]' of it less that of its bases.
  virtual void keep(int64_t, const Vec<D>&, const Bases<D>&, const double*) { __builtin_trap(); }
  /// Add one component of a column to another; move one to another slot.
  virtual void add(int64_t, int64_t, int) { __builtin_trap(); }
  virtual void move(int64_t, int64_t) { __builtin_trap(); }

  virtual bool needs_landmarks() const { __builtin_trap(); }
  virtual void reserve_landmarks(LandmarkWeights<D>&) { __builtin_trap(); }
  virtual Largest compute(const Weights<D>&) { __builtin_trap(); }

  /// Displacement of a source in the present field, the next one and the one at rest, mm.
  virtual Vec<D> now(int64_t) const { __builtin_trap(); }
  virtual Vec<D> next(int64_t) const { __builtin_trap(); }
  virtual Vec<D> rest(int64_t) const { __builtin_trap(); }
  /// Make the next field that share of the way from the one at rest.
  virtual void blend(double) { __builtin_trap(); }
  /// Make the next field the present one.
  virtual void commit() { __builtin_trap(); }
  virtual void clear() { __builtin_trap(); }

  /// Field of landmarks at points (count, D) mm.
  virtual void evaluate(const LandmarkWeights<D>&, const double*, int64_t, double*) { __builtin_trap(); }
  /// Present displacement of every mesh node, (n, D) mm; of landmarks where the field needs them for that.
  virtual bool mesh_needs_landmarks() const { __builtin_trap(); }
  virtual void mesh(const LandmarkWeights<D>&, double*) { __builtin_trap(); }
  virtual void mesh(const LandmarkWeights<D>&, float*) { __builtin_trap(); }
  /// The same in planes of single precision, or nullptr where there are none; plane meshes.
  virtual bool planes(const LandmarkWeights<D>&, const float*& /*x*/, const float*& /*y*/) { __builtin_trap(); }

 protected:
  ~SessionField() = default;
};

}  // namespace echospline::ECHOSPLINE_CORE
