// Echo of a needle in the imaging plane: one line from its near wall, the bevel, a ring-down tail, and a shadow. In the
// plane and across it.
//
// A pixel sees the needle through the resolution Q = diag(1/lateral^2, 1/axial^2, 1/elevation(depth)^2) in axes across
// the beam, along it and out of the plane. With r from the entry to the pixel and u along the needle, the power of a
// line is
//     exp(-(rQr - (rQu)^2 / uQu)) P(s),   s = rQu / uQu,   seen with resolution (uQu)^-1/2 along the needle.
// P depends on the place on the needle alone, with all that depends on angles in it: it is tabulated once per needle
// position, and a pixel costs one exponential and one look-up. Powers are relative to white; they add to the tissue's
// power before log compression. Grain is a table fixed to the needle's tip, so nothing shimmers as the needle moves.
#pragma once
#include "array.hpp"
#include "echospline.h"
#include "gathering.hpp"

namespace echospline::ECHOSPLINE_CORE {

constexpr float GRAIN = 0.05f;        // mm between entries of the tables: a third of the finest resolution
constexpr int NOISE_COUNT = 4096;     // entries of the noise tables, a power of two: 205 mm until they repeat
constexpr int NOISE_EXTRA = 1024;     // first entries repeated behind the last, so that smoothing reads on
constexpr int LOOKS = 2;              // independent speckle patterns that are averaged
constexpr int MOST_TAPS = 480;        // half width of the smoothing, entries
constexpr int PROFILE_COUNT = 8192;   // most entries of P
constexpr int KNOTS = 33;             // places on the needle at which angles are evaluated
constexpr int TAIL_COUNT = 256;       // entries along the ring-down
constexpr float ECHO_REACH = 4.2f;    // sigmas at which exp(-q) is 77 dB down: weaker echoes are not drawn
constexpr float TAIL_END = -55.0f;    // dB at which the ring-down ends, below the tissue: each millimetre costs time
constexpr float COMB = 0.34f;         // mm between rungs of the tail: 0.27 diameters, 18 gauge with its stylet
constexpr float BEVEL_LENGTH = 1.8f;  // diameters
constexpr float ROUND = 10.0f;        // dB more grain across the plane: one resolution cell holds all of the near side
constexpr float BEVEL_LOSS = 12.0f;   // dB of the mirror echo lost on the bevel, which faces elsewhere
constexpr float HEEL = 12.0f;         // dB by which the heel is weaker than the tip
constexpr float ONSET = 0.8f;         // mm from the shaft at which half of the shadow has set in: no black edge
constexpr float GROUND = 0.05f;       // mm: rays are followed up from this far above a pixel

/// The grain of a needle.
struct Noise {
  Array<float> real[LOOKS], imaginary[LOOKS];  // white, unit power
  Array<float> slow, patch;                    // Gaussian of unit sd, changing over 2 and 0.3 mm
  uint32_t seed = 0;
  bool made = false;

  bool reserve() {
    bool there = slow.reserve(NOISE_COUNT + NOISE_EXTRA) && patch.reserve(NOISE_COUNT + NOISE_EXTRA);
    for (int k = 0; k < LOOKS; ++k)
      there = there && real[k].reserve(NOISE_COUNT + NOISE_EXTRA) && imaginary[k].reserve(NOISE_COUNT + NOISE_EXTRA);
    return there;
  }
  void make(uint32_t new_seed) {
    if (made && seed == new_seed) return;
    made = true, seed = new_seed;
    uint64_t state = seed, high = next(state);
    state = high << 32 | next(state);  // far from the states of other seeds
    for (int k = 0; k < LOOKS; ++k) {
      fill(real[k].data(), state, 0.70710678f);
      fill(imaginary[k].data(), state, 0.70710678f);
    }
    smoothed(slow.data(), state, 2.0f / GRAIN);
    smoothed(patch.data(), state, 0.3f / GRAIN);
  }

 private:
  static uint32_t next(uint64_t& state) {  // splitmix64
    state += 0x9e3779b97f4a7c15u;
    uint64_t z = state;
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
    return uint32_t((z ^ (z >> 31)) >> 32);
  }
  static float normal(uint64_t& state) {  // sum of twelve uniform numbers: light tails are welcome in a picture
    float sum = -6;
    for (int k = 0; k < 12; ++k) sum += float(next(state) >> 8) * (1.0f / 16777216.0f);
    return sum;
  }
  /// Running average from `start` on; it begins with what it is after one round.
  static void average(float* table, float share, int start, int step) {
    float value = 0;
    for (int k = 0; k < NOISE_COUNT; ++k) value += share * (table[start + k * step] - value);
    for (int k = 0; k < NOISE_COUNT; ++k) table[start + k * step] = value += share * (table[start + k * step] - value);
  }
  static void repeat(float* table) { std::memcpy(table + NOISE_COUNT, table, NOISE_EXTRA * sizeof(float)); }
  static void fill(float* table, uint64_t& state, float sd) {
    for (int k = 0; k < NOISE_COUNT; ++k) table[k] = sd * normal(state);
    repeat(table);
  }
  /// White noise through exponential averages forth and back, twice and around the end; then unit sd.
  static void smoothed(float* table, uint64_t& state, float length) {
    for (int k = 0; k < NOISE_COUNT; ++k) table[k] = normal(state);
    const float share = 1.4f / (length + 1.4f);
    for (int pass = 0; pass < 2; ++pass) {
      average(table, share, 0, 1);
      average(table, share, NOISE_COUNT - 1, -1);
    }
    double sum = 0, square = 0;
    for (int k = 0; k < NOISE_COUNT; ++k) sum += table[k];
    for (int k = 0; k < NOISE_COUNT; ++k) table[k] -= float(sum / NOISE_COUNT), square += double(table[k]) * table[k];
    const float scale = square > 0 ? float(1 / __builtin_sqrt(square / NOISE_COUNT)) : 0.0f;
    for (int k = 0; k < NOISE_COUNT; ++k) table[k] *= scale;
    repeat(table);
  }
};

/// Tables of one needle position.
struct EchoTables {
  Array<float> profile, tail_profile, ring_down;
  bool reserve() {
    return profile.reserve(PROFILE_COUNT + 2 * LANES) && tail_profile.reserve(PROFILE_COUNT + 2 * LANES) &&
           ring_down.reserve(TAIL_COUNT + 2 * LANES);
  }
};

/// Where the picture is, mm.
struct Extent {
  double left, right, top, bottom;
};

/// Convex hull of discs of one radius: where an echo can be.
struct Footprint {
  double x[4], y[4], radius = 0;
  int count = 0;

  void add(double at_x, double at_y) { x[count] = at_x, y[count] = at_y, ++count; }
  /// Interval of x at height `at`; false where there is none.
  bool interval(double at, double& first, double& last) const {
    first = 1e30, last = -1e30;
    for (int i = 0; i < count; ++i)
      for (int k = i; k < count; ++k) {
        const double drop = y[k] - y[i];
        double t0 = 0, t1 = 1;  // part of the line between discs i and k within a radius of that height
        if (drop != 0) {
          const double a = (at - radius - y[i]) / drop, b = (at + radius - y[i]) / drop;
          t0 = larger(0.0, smaller(a, b)), t1 = smaller(1.0, larger(a, b));
        } else if (at < y[i] - radius || at > y[i] + radius) {
          continue;
        }
        if (t0 > t1) continue;
        const double a = x[i] + t0 * (x[k] - x[i]), b = x[i] + t1 * (x[k] - x[i]);
        first = smaller(first, smaller(a, b) - radius), last = larger(last, larger(a, b) + radius);
      }
    return first <= last;
  }
};

/// A needle's echo, ready to be evaluated at pixels.
class NeedleEcho {
 public:
  /// Tabulate what depends on the needle's position. `extent`: where it will be evaluated.
  NeedleEcho(const echospline_needle& needle, const Extent& extent, const Noise& noise, EchoTables& tables)
      : tables_(tables), curved_(needle.curved != 0) {
    for (int k = 0; k < 3; ++k) entry_[k] = needle.entry[k], u_[k] = needle.tip[k] - needle.entry[k];
    length_ = __builtin_sqrt(u_[0] * u_[0] + u_[1] * u_[1] + u_[2] * u_[2]);
    parts_ = length_ > 1e-6 ? needle.parts : 0;
    if (!parts_) return;
    for (double& u : u_) u /= length_;
    apex_[0] = needle.apex[0], apex_[1] = needle.apex[1], face_ = curved_ ? larger(0.0, -apex_[1]) : 0.0;
    radius_ = 0.5 * needle.diameter;
    const double growth = smaller(1.0, length_ / needle.diameter);  // the first diameter enters gradually
    arrival_ = float(growth * growth * growth * growth);
    ql_ = float(1 / (needle.lateral * needle.lateral)), qa_ = float(1 / (needle.axial * needle.axial));
    elevation_ = float(needle.elevation), elevation_depth_ = float(needle.elevation_depth);
    spread_ = float(0.42 * needle.element_height), steepest_ = float(0.5 / needle.f_number),
    opacity_ = float(needle.opacity);
    ux_ = float(u_[0]), uy_ = float(u_[1]), uz_ = float(u_[2]);
    ex_ = float(entry_[0]), ey_ = float(entry_[1]), ez_ = float(entry_[2]);
    spot_power_[0] = arrival_ * decibels(needle.bevel);
    const double heel = BEVEL_LENGTH * needle.diameter;
    spot_power_[1] = spot_power_[0] * decibels(-HEEL) * float(larger(0.0, smaller(1.0, length_ / heel - 1)));
    for (int k = 0; k < 3; ++k) {
      spot_[0][k] = float(entry_[k] + (length_ - smaller(0.15, length_)) * u_[k]);
      spot_[1][k] = float(entry_[k] + (length_ - smaller(heel, length_)) * u_[k]);
    }
    // the heel lies on the near wall
    double wall[2];
    near_wall(spot_[1][0], spot_[1][1], wall);
    spot_[1][0] += float(wall[0]), spot_[1][1] += float(wall[1]);
    spot_reach_ = ECHO_REACH * larger(needle.lateral, needle.axial);
    tabulate(needle, extent, noise);
  }

  const Footprint& footprint() const { return footprint_; }
  bool shades() const { return (parts_ & ECHOSPLINE_SHADOW) && opacity_ > 0; }

  /// Power of shaft and tail relative to white, at points in mm; 0 outside the footprint.
  ECHOSPLINE_INLINE Floats line(Floats x, Floats y) const {
    return curved_ ? line_in<true>(x, y) : line_in<false>(x, y);
  }
  /// Power of the tip (0) or the heel (1); 0 further than `spot_reach` away.
  ECHOSPLINE_INLINE Floats spot(int k, Floats x, Floats y) const {
    return curved_ ? spot_in<true>(k, x, y) : spot_in<false>(k, x, y);
  }
  int spots() const { return (parts_ & ECHOSPLINE_BEVEL) ? 2 : 0; }
  double spot_x(int k) const { return spot_[k][0]; }
  double spot_y(int k) const { return spot_[k][1]; }
  double spot_reach() const { return spot_reach_; }
  /// Logarithm of the tissue's power that passes, dB (0 or less).
  ECHOSPLINE_INLINE Floats shade(Floats x, Floats y) const {
    return curved_ ? shade_in<true>(x, y) : shade_in<false>(x, y);
  }

 private:
  static float decibels(double level) { return float(__builtin_pow(10.0, 0.1 * level)); }

  /// Direction of the beam at a place, and how deep that is.
  struct Beam {
    double x, y, depth;
  };
  Beam beam_at(double x, double y) const {
    if (!curved_) return {0, 1, y};
    const double dx = x - apex_[0], dy = y - apex_[1], distance = larger(1e-6, __builtin_sqrt(dx * dx + dy * dy));
    return {dx / distance, dy / distance, distance - face_};
  }
  /// From the axis to the near wall within the plane: a radius against the beam, at right angles to the needle.
  void near_wall(double x, double y, double* shift) const {
    const Beam beam = beam_at(x, y);
    const double along = beam.x * u_[0] + beam.y * u_[1];
    shift[0] = -radius_ * (beam.x - along * u_[0]), shift[1] = -radius_ * (beam.y - along * u_[1]);
  }
  /// The needle from a pixel, in axes across the beam (l) and along it (a).
  struct View {
    Floats ul, ua, rl, ra, depth, bx, by;
  };
  template <bool CURVED>
  ECHOSPLINE_INLINE View view(Floats x, Floats y) const {
    View v;
    const Floats rx = x - ex_, ry = y - ey_;
    if constexpr (!CURVED) {
      v.ul = all(ux_), v.ua = all(uy_), v.rl = rx, v.ra = ry, v.depth = y, v.bx = all(0.0f), v.by = all(1.0f);
    } else {
      const Floats dx = x - float(apex_[0]), dy = y - float(apex_[1]);
      const Floats distance = root(dx * dx + dy * dy), per = 1.0f / greatest(distance, all(1e-6f));
      v.bx = dx * per, v.by = dy * per, v.depth = distance - float(face_);
      v.ul = v.by * ux_ - v.bx * uy_, v.ua = v.bx * ux_ + v.by * uy_;
      v.rl = v.by * rx - v.bx * ry, v.ra = v.bx * rx + v.by * ry;
    }
    return v;
  }
  /// Square of the slice's thickness at a depth, mm^2.
  ECHOSPLINE_INLINE Floats slice_square(Floats depth) const {
    const Floats off = (depth - elevation_depth_) * (spread_ / (2.5f * elevation_depth_));
    return off * off + elevation_ * elevation_;
  }
  double slice_at(double depth) const {
    const double off = (depth - elevation_depth_) * spread_ / (2.5 * elevation_depth_);
    return __builtin_sqrt(off * off + double(elevation_) * elevation_);
  }

  /// Entry of a table over the distance from the tip.
  ECHOSPLINE_INLINE Floats along(const float* table, Floats s) const {
    const Floats k = within((float(length_) - s) * per_step_ - first_, 0.0f, float(count_ - 1));
    const Ints i = to_ints(k);
    const Floats a = gather(table, i), b = gather(table + 1, i);
    return a + (k - to_floats(i)) * (b - a);
  }

  template <bool CURVED>
  ECHOSPLINE_INLINE Floats line_in(Floats x, Floats y) const {
    const View v = view<CURVED>(x, y);
    const Floats qe = 1.0f / slice_square(v.depth);
    Floats power = Floats{};
    // the near wall: the axis shifted by a radius against the beam, at right angles to the needle
    const float radius = float(radius_);
    const Floats shift = radius * v.ua, rl = v.rl - shift * v.ul, ra = v.ra + radius - shift * v.ua,
                 rz = -ez_ - shift * uz_;
    const Floats along_l = ql_ * v.ul * v.ul, along_z = qe * (uz_ * uz_), uqu = along_l + qa_ * v.ua * v.ua + along_z;
    const Floats per = 1.0f / uqu, s = (ql_ * rl * v.ul + qa_ * ra * v.ua + qe * rz * uz_) * per;
    const Floats la = rl * v.ua - ra * v.ul, lz = rl * uz_ - rz * v.ul, az = ra * uz_ - rz * v.ua;
    const Floats q = (ql_ * qa_ * la * la + qe * (ql_ * lz * lz + qa_ * az * az)) * per;  // rQr - (rQu)^2 / uQu
    if ((parts_ & ECHOSPLINE_SHAFT) && any(q < ECHO_REACH * ECHO_REACH))
      power += exp_minus(q) * along(tables_.profile.data(), s);
    if (rings_) {
      // the line shifted down the beam by the t that brings it nearest to the pixel
      const Floats a = qa_ * (along_l + along_z) * per, b = qa_ * (ra - s * v.ua);
      const Floats t = greatest(b / greatest(a, all(1e-3f * qa_)), all(0.0f));
      if (any(t < tail_length_)) {
        const Floats k = least(t * per_ring_, all(float(TAIL_COUNT - 1)));
        const Ints i = to_ints(k);
        const Floats low = gather(tables_.ring_down.data(), i), high = gather(tables_.ring_down.data() + 1, i);
        const Floats off = greatest(q - t * (2.0f * b - a * t), all(0.0f));
        power += (low + (k - to_floats(i)) * (high - low)) * exp_minus(off) *
                 along(tables_.tail_profile.data(), s - t * qa_ * v.ua * per);
      }
    }
    return power;
  }
  template <bool CURVED>
  ECHOSPLINE_INLINE Floats spot_in(int k, Floats x, Floats y) const {
    const View v = view<CURVED>(x, y);
    const float* at = spot_[k];
    const Floats dx = x - at[0], dy = y - at[1];
    Floats l = dx, a = dy;
    if constexpr (CURVED) l = v.by * dx - v.bx * dy, a = v.bx * dx + v.by * dy;
    return spot_power_[k] * exp_minus(ql_ * l * l + qa_ * a * a + at[2] * at[2] / slice_square(v.depth));
  }

  /// The share of the rays between a pixel and its aperture that the shaft blocks, times the share of the slice that it
  /// covers.
  template <bool CURVED>
  ECHOSPLINE_INLINE Floats shade_in(Floats x, Floats y) const {
    const View v = view<CURVED>(x, y);
    const float length = float(length_), diameter = float(2 * radius_);
    // the part of the shaft within the slice and above the pixel
    Floats from = all(0.0f), to = all(length);
    if (uz_ > 1e-5f || uz_ < -1e-5f) {
      const Floats half = root(slice_square(v.depth)) * magnitude(all(1.0f / uz_)), middle = all(-ez_ / uz_);
      from = within(middle - half, 0.0f, length), to = within(middle + half, 0.0f, length);
    }
    const Floats steep = pick(magnitude(v.ua) > 1e-5f, v.ua, all(1e-5f)), limit = (v.ra - GROUND) / steep;
    to = pick(steep > 0.0f, least(limit, to), to), from = pick(steep > 0.0f, from, greatest(limit, from));
    const Ints above = to > from;
    if (!any(above)) return Floats{};
    // slopes of the rays to its ends, widened by its thickness
    const Floats up0 = greatest(v.ra - from * v.ua, all(GROUND)), up1 = greatest(v.ra - to * v.ua, all(GROUND));
    const Floats slope0 = (v.rl - from * v.ul) / up0, slope1 = (v.rl - to * v.ul) / up1;
    const Floats wide0 = 0.5f * diameter / greatest(up0, all(diameter)),
                 wide1 = 0.5f * diameter / greatest(up1, all(diameter));
    const Floats low = least(slope0 - wide0, slope1 - wide1), high = greatest(slope0 + wide0, slope1 + wide1);
    const float per = 0.5f / steepest_;
    const Floats blocked = smooth_step(high * per + 0.5f) - smooth_step(low * per + 0.5f);
    if (!any(above & (blocked > 1e-4f))) return Floats{};
    // how far off the plane the shaft is where most of them pass it, and how thick the slice is there
    const Floats middle = 0.5f * (from + to);
    const Floats s = least(greatest((v.rl * v.ul + 0.003f * middle) / (v.ul * v.ul + 0.003f), from), to);
    const Floats height = greatest(v.ra - s * v.ua, all(0.0f)), z = ez_ + s * uz_;
    const Floats fan = spread_ * height / greatest(v.depth, all(1.0f));
    const Floats per_slice = 0.70710678f / root(fan * fan + elevation_ * elevation_);
    const Floats flat = root(v.ul * v.ul + uz_ * uz_),
                 half = 0.5f * diameter * flat / greatest(magnitude(v.ul), all(1e-3f)) + 1e-6f;
    const Floats covered =
        0.5f * (rough_error_function((z + half) * per_slice) - rough_error_function((z - half) * per_slice));
    // distance from the shaft in the plane: the shadow sets in gradually
    const float in_plane = ux_ * ux_ + uy_ * uy_;
    const Floats on = within((v.rl * v.ul + v.ra * v.ua) * (1.0f / (in_plane + 1e-6f)), 0.0f, length);
    const Floats near_s = least(greatest(on, from), to);
    const Floats off_l = v.rl - near_s * v.ul, off_a = v.ra - near_s * v.ua, off = off_l * off_l + off_a * off_a;
    const Floats onset = off / (off + ONSET * ONSET), facing = root(greatest(1.0f - v.ua * v.ua, all(0.0f)));
    const Floats block = within(blocked, 0.0f, 1.0f) * covered * onset * (0.4f + 0.6f * facing) * (opacity_ * arrival_);
    return pick(above, 4.0f * decibels_of(within(1.0f - block, 1e-3f, 1.0f)), Floats{});
  }

  /// What depends on the angle between needle and beam at a place on the needle.
  struct Knot {
    float specular, rough, tail, sigma, steady;  // dB, dB, dB, mm, share of the grain's power that does not vary
  };
  Knot knot_at(const echospline_needle& n, double s) const {
    constexpr double degree = 57.29577951308232;
    const Beam beam = beam_at(entry_[0] + s * u_[0], entry_[1] + s * u_[1]);
    const double ul = beam.y * u_[0] - beam.x * u_[1], ua = beam.x * u_[0] + beam.y * u_[1], uz = u_[2];
    const double slice = slice_at(beam.depth), uqu = ql_ * ul * ul + qa_ * ua * ua + uz * uz / (slice * slice);
    const double sigma = 1 / __builtin_sqrt(uqu), lateral = n.lateral;
    const double tilt = degree * __builtin_asin(larger(-1.0, smaller(1.0, ua))), flat = larger(1e-9, ul * ul + uz * uz);
    const double width =
        __builtin_sqrt((ul * ul * n.lobe * n.lobe + uz * uz * n.lobe_elevation * n.lobe_elevation) / flat);
    const double in_plane = ul / __builtin_sqrt(flat);
    double mirror = 0;
    for (int look = -1; look <= 1; ++look) {
      const double off = (tilt - look * n.steering * in_plane) / width;
      mirror += __builtin_exp(-off * off) / 3;
    }
    const double step = larger(0.0, smaller(1.0, ((tilt < 0 ? -tilt : tilt) - 50) / 40)), off = tilt / (0.4 * width);
    Knot k;
    k.specular =
        float(n.specular + 10 * __builtin_log10(mirror + 1e-12) + 20 * __builtin_log10(smaller(1.0, sigma / lateral)));
    k.rough =
        float(n.roughness - n.rolloff * step + 10 * __builtin_log10(smaller(1.5, sigma / lateral)) + ROUND * uz * uz);
    k.tail = float(n.specular + n.ring_down - 4.343 * off * off);  // to and fro needs a square hit
    k.sigma = float(sigma);
    k.steady = float(0.03 + 0.9 * uz * uz);  // across the plane many scatterers share a resolution cell
    return k;
  }

  /// Part of the needle that can be seen; false where none.
  bool visible(const Extent& extent, double margin, double pad, double& first, double& last) const {
    first = -pad, last = length_ + pad;
    const double deepest = larger(slice_at(extent.top), slice_at(extent.bottom));
    const double reach =
        (ECHO_REACH + 0.3) * (curved_ ? larger(deepest, slice_at(extent.bottom - extent.top)) : deepest) + radius_;
    const double low[3] = {extent.left - margin, extent.top - margin, -reach},
                 high[3] = {extent.right + margin, extent.bottom + margin, reach};
    for (int k = 0; k < 3; ++k) {
      if (u_[k] < 1e-9 && u_[k] > -1e-9) {
        if (entry_[k] < low[k] || entry_[k] > high[k]) return false;
        continue;
      }
      const double a = (low[k] - entry_[k]) / u_[k], b = (high[k] - entry_[k]) / u_[k];
      first = larger(first, smaller(a, b)), last = smaller(last, larger(a, b));
    }
    return first < last;
  }

  void tabulate(const echospline_needle& n, const Extent& extent, const Noise& noise) {
    if (!(parts_ & (ECHOSPLINE_SHAFT | ECHOSPLINE_TAIL))) return;
    const double widest = larger(n.lateral, n.axial), deepest = larger(slice_at(extent.top), slice_at(extent.bottom));
    const double pad = 5 * larger(widest, u_[2] * u_[2] > 1e-4 ? deepest : 0.0);
    const double longest_tail =
        (parts_ & ECHOSPLINE_TAIL) ? larger(0.0, (n.specular + n.ring_down - TAIL_END) / n.ring_down_loss) : 0.0;
    double first, last;
    if (!visible(extent, ECHO_REACH * widest + n.diameter + longest_tail, pad, first, last)) return;

    Knot knots[KNOTS + 1];
    const double gap = (last - first) / (KNOTS - 1);
    float strongest_tail = -1e9f;
    for (int k = 0; k < KNOTS; ++k) {
      knots[k] = knot_at(n, first + k * gap);
      strongest_tail = larger(strongest_tail, knots[k].tail);
    }
    knots[KNOTS] = knots[KNOTS - 1];
    tail_length_ = float((strongest_tail - TAIL_END) / n.ring_down_loss);
    rings_ = (parts_ & ECHOSPLINE_TAIL) && tail_length_ > 0.3f;

    // half width of the line across the needle, as it lies in the plane
    const double flat = __builtin_sqrt(u_[0] * u_[0] + u_[1] * u_[1]);
    double finest = 1e9;
    for (int k = 0; k < KNOTS; ++k) finest = smaller(finest, double(knots[k].sigma));
    footprint_.radius = ECHO_REACH * smaller(widest, n.lateral * n.axial / (finest * larger(flat, 1e-6))) +
                        (curved_ ? 0.2 * radius_ : 0.0);
    for (int side = 0; side < 2; ++side) {
      const double s = side ? last : first;
      double x = entry_[0] + s * u_[0], y = entry_[1] + s * u_[1], wall[2];
      near_wall(x, y, wall);
      x += wall[0], y += wall[1];
      footprint_.add(x, y);
      if (!rings_) continue;
      const Beam beam = beam_at(x, y);
      footprint_.add(x + tail_length_ * beam.x, y + tail_length_ * beam.y);
    }

    // entries at whole multiples of the step from the tip, so that they find the same grain wherever the needle is
    double step = GRAIN;
    while ((last - first) / step > PROFILE_COUNT - 4) step *= 2;
    const int64_t begin = int64_t(__builtin_floor((length_ - last) / step));
    count_ = int(smaller<double>((last - first) / step + 3, PROFILE_COUNT));
    first_ = float(begin), per_step_ = float(1 / step);
    float weight[2 * MOST_TAPS + 1 + LANES];
    float old_sigma = -1, per_norm = 1;
    int half = 0;
    const float patches = float(n.patches), wobble = float(n.wobble), length = float(length_);
    const float even = __builtin_expf(-0.5f * patches * patches * 0.05301898f);  // mean power of the patches is 1
    for (int k = 0; k < count_; k += LANES) {
      const Floats v = (counted() + (first_ + float(k))) * float(step), s = length - v;  // from the tip, from the entry
      const Floats at = within((s - float(first)) * float(1 / gap), 0.0f, float(KNOTS - 1));
      const Ints i = to_ints(at);
      const Floats f = at - to_floats(i);
      Floats specular, rough, tail, sigma, steady;
      for (int lane = 0; lane < LANES; ++lane) {
        const Knot &a = knots[i[lane]], &b = knots[i[lane] + 1];
        specular[lane] = a.specular + f[lane] * (b.specular - a.specular),
        rough[lane] = a.rough + f[lane] * (b.rough - a.rough);
        tail[lane] = a.tail + f[lane] * (b.tail - a.tail), sigma[lane] = a.sigma + f[lane] * (b.sigma - a.sigma);
        steady[lane] = a.steady + f[lane] * (b.steady - a.steady);
      }
      // grain, smoothed by the resolution along the needle
      const float width = sigma[LANES / 2] / float(step);
      if (!(width > old_sigma * 0.99f && width < old_sigma * 1.01f)) {
        old_sigma = width, half = int(smaller(3 * width + 1, float(MOST_TAPS)));
        float square = 0;
        for (int tap = -half; tap <= half; ++tap) {
          const float w = __builtin_expf(-0.5f * float(tap * tap) / (width * width));
          weight[tap + half] = w, square += w * w;
        }
        per_norm = 1 / __builtin_sqrtf(square);
      }
      const int64_t from = (begin + k - half) & (NOISE_COUNT - 1);
      Floats real[LOOKS] = {}, imaginary[LOOKS] = {};
      for (int tap = 0; tap <= 2 * half; ++tap)
        for (int look = 0; look < LOOKS; ++look) {
          real[look] += weight[tap] * load(noise.real[look].data() + from + tap);
          imaginary[look] += weight[tap] * load(noise.imaginary[look].data() + from + tap);
        }
      const int64_t here = (begin + k) & (NOISE_COUNT - 1);
      const Floats slow = power_of(load(noise.slow.data() + here) * wobble);
      const Floats patch = power_of(load(noise.patch.data() + here) * patches) * even;
      const Floats per_sigma = 0.70710678f / sigma;
      const Floats end = 0.5f * (error_function(s * per_sigma) - error_function((s - length) * per_sigma));
      const Floats shown = end * end * slow;
      const Floats within_shaft = smooth_step(s * 0.5f) * smooth_step((length - s) * 0.5f);  // no hard edge of the tail
      // the mirror echo fades over the bevel and towards both ends
      const float bevel = float(BEVEL_LENGTH * n.diameter);
      const Floats fade = -BEVEL_LOSS * exp_minus(greatest(v, all(0.0f)) * (1.4f / bevel)) -
                          4.0f * exp_minus(greatest(s, all(0.0f)) * 0.3f);
      const Floats mirror = power_of(specular + fade),
                   grain = power_of(rough) * (1.0f - steady) * patch * (per_norm * per_norm);
      Floats cross = Floats{}, square = Floats{};
      for (int look = 0; look < LOOKS; ++look)
        cross += real[look], square += real[look] * real[look] + imaginary[look] * imaginary[look];
      cross *= 1.0f / LOOKS, square *= 1.0f / LOOKS;
      const Floats line = mirror + 2.0f * root(mirror * grain) * cross + grain * square + power_of(rough) * steady;
      store(tables_.profile.data() + k, shown * greatest(line, all(0.0f)));
      store(tables_.tail_profile.data() + k, slow * within_shaft * power_of(tail + fade));
    }
    if (rings_) tabulate_ring_down(n, noise);
  }

  /// The tail below a shaft that lies across the beam: rungs of uneven height and distance, weaker with every
  /// millimetre.
  void tabulate_ring_down(const echospline_needle& n, const Noise& noise) {
    per_ring_ = (TAIL_COUNT - 1) / tail_length_;
    const float *shift = noise.patch.data() + NOISE_COUNT / 3, *height = noise.patch.data() + 2 * NOISE_COUNT / 3;
    float* ring = tables_.ring_down.data();
    for (int k = 0; k < TAIL_COUNT + LANES; ++k) {
      const float t = k / per_ring_;
      const int at = smaller(int(t / GRAIN), NOISE_COUNT / 3 - 1);
      const float wave = 0.5f + 0.5f * __builtin_cosf(6.2831853f * (t / COMB + 0.4f * shift[at]));
      const float comb = (0.6f + 0.4f * wave * wave) * __builtin_expf(0.35f * height[at]),
                  rise = smaller(1.0f, t / 0.3f);
      const float left = larger(0.0f, 1 - t / tail_length_),
                  end = smaller(1.0f, 4 * left);  // fades out over its last quarter
      ring[k] = rise * end * comb * comb * decibels(-n.ring_down_loss * t);
    }
  }

  EchoTables& tables_;
  bool curved_, rings_ = false;
  uint32_t parts_ = 0;
  double entry_[3], u_[3], length_ = 0, apex_[2] = {}, face_ = 0, radius_ = 0;
  float ql_ = 0, qa_ = 0, elevation_ = 0, elevation_depth_ = 0, spread_ = 0, steepest_ = 1, opacity_ = 0, arrival_ = 0;
  float ux_ = 0, uy_ = 0, uz_ = 0, ex_ = 0, ey_ = 0, ez_ = 0, spot_[2][3] = {}, spot_power_[2] = {};
  double spot_reach_ = 0;
  float tail_length_ = 0, per_ring_ = 0, first_ = 0, per_step_ = 0;
  int count_ = 1;
  Footprint footprint_;
};

/// Grey level of tissue with an echo's power added before log compression.
ECHOSPLINE_INLINE Floats with_echo(Floats grey, Floats power, float white, float range) {
  const Floats tissue = power_of((grey * (1.0f / white) - 1.0f) * range);
  const Floats sum = white * (1.0f + decibels_of(tissue + power) * (1.0f / range));
  const Floats shown = greatest(least(sum, greatest(grey, all(white))), grey);
  return pick(power > 1e-8f, shown, grey);
}

}  // namespace echospline::ECHOSPLINE_CORE
