// More operations on lanes, for pictures: counting, gathering, rounding, spreading a lattice over pixels, exponentials.
#pragma once
#include "lanes.hpp"

namespace echospline::ECHOSPLINE_CORE {

typedef uint8_t LaneBytes __attribute__((vector_size(LANES)));
typedef uint16_t LaneShorts __attribute__((vector_size(2 * LANES)));

/// 0, 1, 2, ... over the lanes.
ECHOSPLINE_INLINE Ints counting() {
  Ints n;
  for (int i = 0; i < LANES; ++i) n[i] = i;
  return n;
}
ECHOSPLINE_INLINE Floats counted() { return to_floats(counting()); }

/// Numbers p[at], lane by lane: single loads are faster than the gather instruction on many processors.
template <class T, class Result>
ECHOSPLINE_INLINE Result gathered(const T* p, Ints at) {
#if defined(__AVX512F__)
  return Result{p[at[0]], p[at[1]], p[at[2]],  p[at[3]],  p[at[4]],  p[at[5]],  p[at[6]],  p[at[7]],
                p[at[8]], p[at[9]], p[at[10]], p[at[11]], p[at[12]], p[at[13]], p[at[14]], p[at[15]]};
#elif defined(__AVX2__)
  return Result{p[at[0]], p[at[1]], p[at[2]], p[at[3]], p[at[4]], p[at[5]], p[at[6]], p[at[7]]};
#else
  return Result{p[at[0]], p[at[1]], p[at[2]], p[at[3]]};
#endif
}
ECHOSPLINE_INLINE Floats gather(const float* p, Ints at) { return gathered<float, Floats>(p, at); }
ECHOSPLINE_INLINE Words gather(const uint32_t* p, Ints at) { return gathered<uint32_t, Words>(p, at); }

/// Each of the first LANES / STEP numbers at p, repeated STEP times; LANES numbers are read.
template <int STEP>
ECHOSPLINE_INLINE Floats spread(const float* p) {
  static_assert(STEP == 1 || STEP == 2 || STEP == 4);
  if constexpr (STEP == 1) return load(p);
  if constexpr (STEP >= LANES) return all(*p);
  const Floats v = load(p);
#if defined(__AVX512F__)
  if constexpr (STEP == 4) return __builtin_shufflevector(v, v, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3);
  return __builtin_shufflevector(v, v, 0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7);
#elif defined(__AVX2__)
  if constexpr (STEP == 4) return __builtin_shufflevector(v, v, 0, 0, 0, 0, 1, 1, 1, 1);
  return __builtin_shufflevector(v, v, 0, 0, 1, 1, 2, 2, 3, 3);
#else
  return __builtin_shufflevector(v, v, 0, 0, 1, 1);
#endif
}

ECHOSPLINE_INLINE Floats magnitude(Floats x) { return (Floats)((Ints)x & 0x7fffffff); }
ECHOSPLINE_INLINE Floats within(Floats x, float low, float high) { return least(greatest(x, all(low)), all(high)); }
/// Nearest whole number, halves to even; for numbers below 2^22.
ECHOSPLINE_INLINE Floats rounded(Floats x) { return (x + 12582912.0f) - 12582912.0f; }
ECHOSPLINE_INLINE bool any(Ints mask) {
  typedef uint64_t Long __attribute__((vector_size(WIDTH)));
  const Long m = (Long)mask;
  uint64_t found = 0;
  for (int i = 0; i < WIDTH / 8; ++i) found |= m[i];
  return found != 0;
}

/// e^-x for x >= 0, to 2e-6 relative; not below 2^-126.
ECHOSPLINE_INLINE Floats exp_minus(Floats x) {
  const Floats v = greatest(x * -1.442695041f, all(-126.0f));
  const Ints whole = to_ints(v - 0.5f);
  const Floats f = v - to_floats(whole);
  Floats p = f * 0.00133335581f + 0.00961812911f;
  p = p * f + 0.0555041087f;
  p = p * f + 0.240226507f;
  p = p * f + 0.693147181f;
  p = p * f + 1.0f;
  return p * (Floats)((whole + 127) << 23);
}
/// 10^(x/10) for x in dB between -370 and 380.
ECHOSPLINE_INLINE Floats power_of(Floats decibels) {
  const Floats v = within(decibels * 0.3321928095f, -125.0f, 125.0f);
  const Ints whole = to_ints(v + 128.0f) - 128;
  return exp_minus((to_floats(whole + 1) - v) * 0.6931471806f) * (Floats)((whole + 128) << 23);
}
/// 10 log10 x of positive numbers.
ECHOSPLINE_INLINE Floats decibels_of(Floats power) { return logarithm(power) * 4.342944819f; }

/// Error function, to 2e-6 (Abramowitz and Stegun 7.1.26).
ECHOSPLINE_INLINE Floats error_function(Floats x) {
  const Floats z = magnitude(x), t = 1.0f / (1.0f + 0.3275911f * z);
  Floats p = t * 1.061405429f - 1.453152027f;
  p = p * t + 1.421413741f;
  p = p * t - 0.284496736f;
  p = p * t + 0.254829592f;
  const Floats y = 1.0f - p * t * exp_minus(z * z);
  return pick(x < 0.0f, -y, y);
}
/// Rise from 0 at t = 0 to 1 at t = 1, level at both ends.
ECHOSPLINE_INLINE Floats smooth_step(Floats t) {
  const Floats x = within(t, 0.0f, 1.0f);
  return x * x * (3.0f - 2.0f * x);
}

}  // namespace echospline::ECHOSPLINE_CORE
