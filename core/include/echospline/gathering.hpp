// More operations on lanes, for pictures: counting, gathering, rounding, spreading a lattice over pixels, exponentials.
#pragma once
#include "lanes.hpp"
#if defined(__AVX2__) || defined(__SSE2__)
#include <immintrin.h>
#endif

namespace echospline::ECHOSPLINE_CORE {

typedef uint8_t LaneBytes __attribute__((vector_size(LANES)));

/// 0, 1, 2, ... over the lanes.
ECHOSPLINE_INLINE Ints counting() {
  Ints n;
  for (int i = 0; i < LANES; ++i) n[i] = i;
  return n;
}
ECHOSPLINE_INLINE Floats counted() { return to_floats(counting()); }

/// Numbers p[at], lane by lane. With 8 lanes single loads are as fast as the gather instruction, with 16 half as fast.
template <class T, class Result>
ECHOSPLINE_INLINE Result one_by_one(const T* p, Ints at) {
#if defined(__AVX2__)
  return Result{p[at[0]], p[at[1]], p[at[2]], p[at[3]], p[at[4]], p[at[5]], p[at[6]], p[at[7]]};
#else
  return Result{p[at[0]], p[at[1]], p[at[2]], p[at[3]]};
#endif
}
ECHOSPLINE_INLINE Floats gather(const float* p, Ints at) {
#if defined(__AVX512F__)
  // masked: the plain intrinsics read an undefined register, of which g++ 12 warns
  return (Floats)_mm512_mask_i32gather_ps(_mm512_setzero_ps(), 0xffff, (__m512i)at, p, 4);
#else
  return one_by_one<float, Floats>(p, at);
#endif
}
ECHOSPLINE_INLINE Words gather(const uint32_t* p, Ints at) {
#if defined(__AVX512F__)
  return (Words)_mm512_mask_i32gather_epi32(_mm512_setzero_si512(), 0xffff, (__m512i)at, p, 4);
#else
  return one_by_one<uint32_t, Words>(p, at);
#endif
}

/// Lanes PART * LANES / STEP and on, each repeated STEP times.
template <int STEP, int PART>
ECHOSPLINE_INLINE Floats spread(Floats v) {
  static_assert((STEP == 1 || STEP == 2 || STEP == 4) && PART < STEP);
  constexpr int from = PART * LANES / STEP;
  if constexpr (STEP == 1) return v;
#if defined(__AVX512F__)
  else if constexpr (STEP == 4)
    return __builtin_shufflevector(v, v, from, from, from, from, from + 1, from + 1, from + 1, from + 1, from + 2,
                                   from + 2, from + 2, from + 2, from + 3, from + 3, from + 3, from + 3);
  else
    return __builtin_shufflevector(v, v, from, from, from + 1, from + 1, from + 2, from + 2, from + 3, from + 3,
                                   from + 4, from + 4, from + 5, from + 5, from + 6, from + 6, from + 7, from + 7);
#elif defined(__AVX2__)
  else if constexpr (STEP == 4)
    return __builtin_shufflevector(v, v, from, from, from, from, from + 1, from + 1, from + 1, from + 1);
  else
    return __builtin_shufflevector(v, v, from, from, from + 1, from + 1, from + 2, from + 2, from + 3, from + 3);
#else
  else if constexpr (STEP == 4)
    return __builtin_shufflevector(v, v, from, from, from, from);
  else
    return __builtin_shufflevector(v, v, from, from, from + 1, from + 1);
#endif
}
/// Interpolate between numbers STEP apart: LANES numbers and their rises to the next give STEP * LANES.
template <int STEP, class Take>
ECHOSPLINE_INLINE void spread_line(Floats from, Floats rise, Take take) {
  const Floats part = to_floats(counting() & (STEP - 1)) * (1.0f / STEP);
  take(0, spread<STEP, 0>(from) + part * spread<STEP, 0>(rise));
  if constexpr (STEP > 1) take(1, spread<STEP, 1>(from) + part * spread<STEP, 1>(rise));
  if constexpr (STEP > 2) {
    take(2, spread<STEP, 2>(from) + part * spread<STEP, 2>(rise));
    take(3, spread<STEP, 3>(from) + part * spread<STEP, 3>(rise));
  }
}

/// Whole numbers 0 to 255 as bytes.
ECHOSPLINE_INLINE void store_bytes(uint8_t* p, Ints v) {
#if defined(__AVX512F__)
  _mm_storeu_si128((__m128i*)p, _mm512_maskz_cvtepi32_epi8(0xffff, (__m512i)v));
#elif defined(__AVX2__)
  const __m128i low = _mm256_castsi256_si128((__m256i)v), high = _mm256_extracti128_si256((__m256i)v, 1);
  const __m128i shorts = _mm_packs_epi32(low, high);
  _mm_storel_epi64((__m128i*)p, _mm_packus_epi16(shorts, shorts));
#elif defined(__SSE2__)
  const __m128i shorts = _mm_packs_epi32((__m128i)v, (__m128i)v), bytes = _mm_packus_epi16(shorts, shorts);
  const int32_t word = _mm_cvtsi128_si32(bytes);
  std::memcpy(p, &word, sizeof word);
#else
  const LaneBytes bytes = __builtin_convertvector(v, LaneBytes);
  std::memcpy(p, &bytes, sizeof bytes);
#endif
}

/// Half a vector from each of two places.
ECHOSPLINE_INLINE Floats load_halves(const float* p, const float* q) {
  Floats v;
  std::memcpy(&v, p, sizeof v / 2);
  std::memcpy(reinterpret_cast<char*>(&v) + sizeof v / 2, q, sizeof v / 2);
  return v;
}
ECHOSPLINE_INLINE void store_halves(float* p, float* q, Floats v) {
  std::memcpy(p, &v, sizeof v / 2);
  std::memcpy(q, reinterpret_cast<const char*>(&v) + sizeof v / 2, sizeof v / 2);
}

ECHOSPLINE_INLINE Ints all_ints(int32_t n) { return Ints{} + n; }
ECHOSPLINE_INLINE int32_t sum(Ints v) {
  int32_t s = 0;
  for (int i = 0; i < LANES; ++i) s += v[i];
  return s;
}
ECHOSPLINE_INLINE int32_t most(Ints v) {
  int32_t s = v[0];
  for (int i = 1; i < LANES; ++i) s = v[i] > s ? v[i] : s;
  return s;
}
/// Write x and y to places of two arrays, lane by lane; of two lanes with the same place the later one counts.
ECHOSPLINE_INLINE void scatter(Ints at, Floats x, Floats y, float* to_x, float* to_y) {
#if defined(__AVX512F__)
  _mm512_i32scatter_ps(to_x, (__m512i)at, (__m512)x, 4);
  _mm512_i32scatter_ps(to_y, (__m512i)at, (__m512)y, 4);
#else
  for (int i = 0; i < LANES; ++i) to_x[at[i]] = x[i], to_y[at[i]] = y[i];
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
/// The same to 5e-4, in a fifth of the time (7.1.27).
ECHOSPLINE_INLINE Floats rough_error_function(Floats x) {
  const Floats z = magnitude(x);
  Floats p = z * 0.078108f + 0.000972f;
  p = p * z + 0.230389f;
  p = p * z + 0.278393f;
  p = p * z + 1.0f;
  const Floats y = 1.0f - 1.0f / (p * p * p * p);
  return pick(x < 0.0f, -y, y);
}
/// Rise from 0 at t = 0 to 1 at t = 1, level at both ends.
ECHOSPLINE_INLINE Floats smooth_step(Floats t) {
  const Floats x = within(t, 0.0f, 1.0f);
  return x * x * (3.0f - 2.0f * x);
}

}  // namespace echospline::ECHOSPLINE_CORE
