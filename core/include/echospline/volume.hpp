// A volume of 8-bit voxels and pictures of bent slices through it.
//
// Voxels are packed once: each with its neighbours along x and y in one word, so that a sample between eight voxels is two loads; and
// words that are close in space are close in memory, in bricks of 8 x 8 x 8, so that a slice costs the same whatever its direction. A
// picture comes from a lattice of places in the reference, one every few pixels, between which places are interpolated. The slice has a
// thickness: across it three samples, weighted as Gauss and Hermite do, stand for the beam's profile.
#pragma once
#include "array.hpp"
#include "gathering.hpp"
#include "sampling.hpp"
#include "space.h"

namespace echospline::ECHOSPLINE_CORE {

class Volume {
 public:
  /// Copy and pack voxels; false when memory runs out.
  bool prepare(const echospline_volume_options& options, const uint8_t* voxels) {
    for (int k = 0; k < 3; ++k) {
      shape_[k] = options.shape[k];
      scale_[k] = 1.0 / options.spacing[k];
      origin_[k] = options.origin[k];
    }
    for (int k = 0; k < 2; ++k) bricks_[k] = (shape_[k] + SIDE - 1) / SIDE;
    const int64_t layer = int64_t(shape_[0]) * shape_[1], deep = (shape_[2] + SIDE - 1) / SIDE;
    Array<uint32_t> packed;
    if (!packed.reserve(layer) || !words_.reserve(int64_t(bricks_[0]) * bricks_[1] * deep * (SIDE * SIDE * SIDE)))
      return false;
    for (int z = 0; z < shape_[2]; ++z) {
      pack(voxels + z * layer, 1, 0, shape_[0], shape_[1], packed.data());
      for (int y = 0; y < shape_[1]; ++y)
        for (int x = 0; x < shape_[0]; ++x) words_[index_of(x, y, z)] = packed[int64_t(y) * shape_[0] + x];
    }
    return true;
  }

  /// Whether a point lies between the outermost voxels' centres.
  bool contains(const double* point) const {
    for (int k = 0; k < 3; ++k) {
      const double index = (point[k] - origin_[k]) * scale_[k];
      if (!(index >= -1e-9 && index <= shape_[k] - 1 + 1e-9)) return false;
    }
    return true;
  }

  /// Draw a bent slice. Returns the number of shown pixels whose place lies outside the volume; -1 when memory runs out.
  int64_t slice(const echospline_slice& s, const double* lattice, uint8_t* out) const {
    const int across = (s.columns - 1 + s.step - 1) / s.step + 1, lines = (s.rows - 1 + s.step - 1) / s.step + 1;
    const int cells = larger(across - 1, 1), padded = cells * s.step + 2 * LANES;
    Array<float> shares, line, places;
    if (!shares.reserve(s.step + 1 + LANES) || !line.reserve(3 * int64_t(across + 1)) ||
        !places.reserve(3 * int64_t(padded)))
      return -1;
    for (int k = 0; k < s.step + 1 + LANES; ++k) shares[k] = static_cast<float>(k) / static_cast<float>(s.step);
    const int stride = across + 1;
    int64_t outside = 0;
    for (int row = 0; row < s.rows; ++row) {
      const int above = smaller(row / s.step, larger(lines - 2, 0));
      const double down = static_cast<double>(row - above * s.step) / s.step;
      const double* upper = lattice + int64_t(above) * across * 3;
      const double* lower = lines > 1 ? upper + int64_t(across) * 3 : upper;
      for (int i = 0; i < stride; ++i)
        for (int k = 0; k < 3; ++k) {
          const int at = 3 * smaller(i, across - 1) + k;
          line[int64_t(k) * stride + i] =
              static_cast<float>((upper[at] + down * (lower[at] - upper[at]) - origin_[k]) * scale_[k]);
        }
      for (int k = 0; k < 3; ++k) {  // a cell writes beyond its end, the next one over it
        const float* from = line.data() + int64_t(k) * stride;
        float* to = places.data() + int64_t(k) * padded;
        for (int cell = 0; cell < cells; ++cell)
          for (int j = 0; j < s.step + (cell == cells - 1); j += LANES)
            store(to + cell * s.step + j, from[cell] + load(shares.data() + j) * (from[cell + 1] - from[cell]));
      }
      const float spread = s.spread ? s.spread[row] : 0.0f;
      Floats aside[3];
      for (int k = 0; k < 3; ++k) aside[k] = all(static_cast<float>(s.normal[k] * scale_[k]) * spread);
      Ints beyond = all_ints(0);  // minus the number of shown pixels outside
      for (int first = 0; first < s.columns; first += LANES) {
        const int here = smaller(LANES, s.columns - first);
        const int64_t to = int64_t(row) * s.columns + first;
        Ints shown = counting() < here;
        if (s.mask) shown &= to_mask(s.mask + to, here);
        if (!any(shown)) {
          std::memset(out + to, s.background, static_cast<size_t>(here));
          continue;
        }
        Floats place[3];
        for (int k = 0; k < 3; ++k) place[k] = load(places.data() + int64_t(k) * padded + first);
        Ints inside;
        Floats value = sample_at(place, inside);
        if (spread > 0) value = across_slice(place, aside, value);
        const Ints grey = pick(inside & shown, to_ints(value + 0.5f), all_ints(s.background));
        beyond += shown & ~inside;
        const LaneBytes bytes = __builtin_convertvector(grey, LaneBytes);
        std::memcpy(out + to, &bytes, static_cast<size_t>(here));
      }
      for (int i = 0; i < LANES; ++i) outside -= beyond[i];
    }
    return outside;
  }

 private:
  /// Lanes whose byte is not 0.
  static Ints to_mask(const uint8_t* bytes, int count) {
    LaneBytes read = {};
    std::memcpy(&read, bytes, static_cast<size_t>(count));
    return __builtin_convertvector(read, Ints) != 0;
  }
  static bool any(Ints mask) {
    int32_t found = 0;
    for (int i = 0; i < LANES; ++i) found |= mask[i];
    return found != 0;
  }
  /// Place of a word in memory: of its brick, then within it.
  template <class Whole>
  Whole index_of(Whole x, Whole y, Whole z) const {
    const Whole brick = ((z >> 3) * bricks_[1] + (y >> 3)) * bricks_[0] + (x >> 3);
    return (brick << 9) | ((z & 7) << 6) | ((y & 7) << 3) | (x & 7);
  }

  /// Brightness between eight voxels, and whether the place lies between the outermost ones.
  Floats sample_at(const Floats* place, Ints& inside) const {
    inside = all_ints(-1);
    Ints cell[3];
    Floats share[3];
    for (int k = 0; k < 3; ++k) {
      const float last = static_cast<float>(shape_[k] - 1);
      inside &= (place[k] >= -1e-3f) & (place[k] <= last + 1e-3f);  // no where a place is not a number
      const Floats p = within(place[k], 0.0f, last);
      const Ints c = to_ints(p);
      cell[k] = c > all_ints(larger(shape_[k] - 2, 0)) ? all_ints(larger(shape_[k] - 2, 0)) : c;
      share[k] = p - to_floats(cell[k]);
    }
    const Floats near = between(gather(words_.data(), index_of(cell[0], cell[1], cell[2])), share);
    const Floats far = between(gather(words_.data(), index_of(cell[0], cell[1], cell[2] + (shape_[2] > 1))), share);
    return near + share[2] * (far - near);
  }
  static Floats between(Words word, const Floats* share) {
    const Floats a = to_floats((Ints)(word & 255)), b = to_floats((Ints)((word >> 8) & 255));
    const Floats c = to_floats((Ints)((word >> 16) & 255)), d = to_floats((Ints)(word >> 24));
    const Floats top = a + share[0] * (b - a), bottom = c + share[0] * (d - c);
    return top + share[1] * (bottom - top);
  }
  /// Mean over the slice's thickness: two more samples at sqrt(3) sigma, of a sixth of the weight each; outside counts as the middle.
  Floats across_slice(const Floats* place, const Floats* aside, Floats middle) const {
    Floats sum = middle * (2.0f / 3.0f);
    for (int sign = 0; sign < 2; ++sign) {
      const float side = sign ? 1.7320508f : -1.7320508f;
      Floats moved[3];
      for (int k = 0; k < 3; ++k) moved[k] = place[k] + side * aside[k];
      Ints inside;
      const Floats value = sample_at(moved, inside);
      sum += pick(inside, value, middle) * (1.0f / 6.0f);
    }
    return sum;
  }

  static constexpr int SIDE = 8;  // voxels along a brick: the shifts of `index_of` say the same

  Array<uint32_t> words_;
  int32_t bricks_[2] = {0, 0};
  int32_t shape_[3] = {0, 0, 0};
  double scale_[3] = {0, 0, 0};  // voxels per mm
  double origin_[3] = {0, 0, 0};
};

}  // namespace echospline::ECHOSPLINE_CORE
