// Numbers in lanes: vectors as wide as the level's registers, by the vector extension that g++ and clang share. Loops over points are
// written with them, because what compilers make of plain loops differs by a factor of three.
#pragma once
#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>
#if defined(__AVX512F__)
#include <immintrin.h>
#endif

#include "level_begin.hpp"

#define ECHOSPLINE_INLINE inline __attribute__((always_inline))
/// Set-up runs once: these functions are compiled for size.
#define ECHOSPLINE_SET_UP __attribute__((noinline, cold))

namespace echospline::ECHOSPLINE_CORE {

#if defined(__AVX512F__)
constexpr int WIDTH = 64;  // bytes of a register
#elif defined(__AVX2__)
constexpr int WIDTH = 32;
#else
constexpr int WIDTH = 16;
#endif

constexpr int LANES = WIDTH / 4;         // floats in a register
constexpr int DOUBLE_LANES = WIDTH / 8;  // doubles in a register

typedef float Floats __attribute__((vector_size(WIDTH)));
typedef double Doubles __attribute__((vector_size(WIDTH)));
typedef int32_t Ints __attribute__((vector_size(WIDTH)));
typedef int64_t Longs __attribute__((vector_size(WIDTH)));
typedef uint32_t Words __attribute__((vector_size(WIDTH)));

/// The vector that belongs to a scalar type, its number of lanes and its mask type.
template <class Real>
struct Lanes;
template <>
struct Lanes<float> {
  typedef Floats type;
  typedef Ints mask;
  static constexpr int count = LANES;
};
template <>
struct Lanes<double> {
  typedef Doubles type;
  typedef Longs mask;
  static constexpr int count = DOUBLE_LANES;
};
template <class Real>
using Vector = typename Lanes<Real>::type;
template <class Real>
using Mask = typename Lanes<Real>::mask;

template <class Real>
ECHOSPLINE_INLINE Vector<Real> load(const Real* p) {
  Vector<Real> v;
  std::memcpy(&v, p, sizeof v);
  return v;
}
template <class Real>
ECHOSPLINE_INLINE void store(Real* p, Vector<Real> v) {
  std::memcpy(p, &v, sizeof v);
}
typedef float HalfFloats __attribute__((vector_size(WIDTH / 2)));
/// Numbers of one precision read and written as vectors of another.
template <class Number>
ECHOSPLINE_INLINE Vector<Number> load_as(const Number* p) {
  return load(p);
}
template <class Number>
ECHOSPLINE_INLINE std::enable_if_t<sizeof(Number) == 8, Doubles> load_as(const float* p) {
  HalfFloats v;
  std::memcpy(&v, p, sizeof v);
  return __builtin_convertvector(v, Doubles);
}
template <class Number>
ECHOSPLINE_INLINE void store_as(Number* p, Vector<Number> v) {
  store(p, v);
}
ECHOSPLINE_INLINE void store_as(float* p, Doubles v) {
  const HalfFloats h = __builtin_convertvector(v, HalfFloats);
  std::memcpy(p, &h, sizeof h);
}
/// Every lane the same number.
template <class Real>
ECHOSPLINE_INLINE Vector<Real> all(Real x) {
  return Vector<Real>{} + x;
}

ECHOSPLINE_INLINE Floats pick(Ints where, Floats a, Floats b) {
  return (Floats)((where & (Ints)a) | (~where & (Ints)b));
}
ECHOSPLINE_INLINE Doubles pick(Longs where, Doubles a, Doubles b) {
  return (Doubles)((where & (Longs)a) | (~where & (Longs)b));
}
ECHOSPLINE_INLINE Ints pick(Ints where, Ints a, Ints b) { return (where & a) | (~where & b); }
/// Smaller and larger of two numbers per lane; the second where the first is not a number.
ECHOSPLINE_INLINE Floats least(Floats a, Floats b) { return a < b ? a : b; }
ECHOSPLINE_INLINE Floats greatest(Floats a, Floats b) { return a > b ? a : b; }
ECHOSPLINE_INLINE Doubles least(Doubles a, Doubles b) { return a < b ? a : b; }
ECHOSPLINE_INLINE Doubles greatest(Doubles a, Doubles b) { return a > b ? a : b; }

#if defined(__clang__)
ECHOSPLINE_INLINE Floats root(Floats a) { return __builtin_elementwise_sqrt(a); }
ECHOSPLINE_INLINE Doubles root(Doubles a) { return __builtin_elementwise_sqrt(a); }
#else
ECHOSPLINE_INLINE Floats root(Floats a) {
  Floats r;
  for (int i = 0; i < LANES; ++i) r[i] = __builtin_sqrtf(a[i]);
  return r;
}
ECHOSPLINE_INLINE Doubles root(Doubles a) {
  Doubles r;
  for (int i = 0; i < DOUBLE_LANES; ++i) r[i] = __builtin_sqrt(a[i]);
  return r;
}
#endif

/// 1 / sqrt of positive numbers, to 1e-7 relative: a guess and its correction, which are faster than root and quotient.
ECHOSPLINE_INLINE Floats inverse_root(Floats a) {
#if defined(__AVX512F__)
  const Floats y = (Floats)_mm512_maskz_rsqrt14_ps(0xffff, (__m512)a);  // masked: see gathering.hpp
#else
  Floats y = (Floats)(0x5f3759df - ((Ints)a >> 1));  // from the exponent, to 3 %
  const Floats e = 1.0f - a * y * y;
  y += y * e * (0.5f + 0.375f * e);  // to 1e-4
#endif
  return y + y * (0.5f - 0.5f * (a * y) * y);
}
ECHOSPLINE_INLINE Doubles inverse_root(Doubles a) { return 1.0 / root(a); }

ECHOSPLINE_INLINE Floats to_floats(Ints a) { return __builtin_convertvector(a, Floats); }
/// Whole numbers, towards zero.
ECHOSPLINE_INLINE Ints to_ints(Floats a) { return __builtin_convertvector(a, Ints); }

/// Natural logarithm to 1e-7 relative of positive numbers; finite at 0, where every use multiplies it by a power that vanishes.
ECHOSPLINE_INLINE Floats logarithm(Floats x) {
  const Ints bits = (Ints)x, exponent = (bits - 0x3f3504f3) >> 23;
  const Floats m = (Floats)(bits - (exponent << 23)), s = (m - 1.0f) / (m + 1.0f), z = s * s;
  Floats p = z * 0.2222222f + 0.28571430f;
  p = p * z + 0.4f;
  p = p * z + 0.66666667f;
  return to_floats(exponent) * 0.69314718f + (s * 2.0f + s * z * p);
}
/// The same in double precision, to 2e-16 relative.
ECHOSPLINE_INLINE Doubles logarithm(Doubles x) {
  const Longs bits = (Longs)x, exponent = (bits - 0x3fe6a09e667f3bcdll) >> 52;
  const Doubles m = (Doubles)(bits - (exponent << 52)), s = (m - 1.0) / (m + 1.0), z = s * s;
  Doubles p = z * (2.0 / 21) + 2.0 / 19;
  p = p * z + 2.0 / 17;
  p = p * z + 2.0 / 15;
  p = p * z + 2.0 / 13;
  p = p * z + 2.0 / 11;
  p = p * z + 2.0 / 9;
  p = p * z + 2.0 / 7;
  p = p * z + 2.0 / 5;
  p = p * z + 2.0 / 3;
  // a whole number in the low bits of 1.5 * 2^52: conversion without an instruction that older processors lack
  const Doubles e = (Doubles)(exponent + 0x4338000000000000ll) - 6755399441055744.0;
  return e * 0.693147180559945309417 + (s * 2.0 + s * z * p);
}

typedef double Doubles2 __attribute__((vector_size(16)));
typedef double Doubles4 __attribute__((vector_size(32)));
typedef double Doubles8 __attribute__((vector_size(64)));
/// Sum of the two halves of a vector.
template <class Half, class Whole>
ECHOSPLINE_INLINE Half fold(const Whole& v) {
  Half a, b;
  std::memcpy(&a, &v, sizeof a);
  std::memcpy(&b, reinterpret_cast<const char*>(&v) + sizeof a, sizeof b);
  return a + b;
}
/// Sum over the lanes, in an order that depends on the level's width alone.
ECHOSPLINE_INLINE double total(const Doubles2& v) { return v[0] + v[1]; }
ECHOSPLINE_INLINE double total(const Doubles4& v) { return total(fold<Doubles2>(v)); }
ECHOSPLINE_INLINE double total(const Doubles8& v) { return total(fold<Doubles4>(v)); }
template <class Real>
ECHOSPLINE_INLINE Real largest(Vector<Real> v) {
  Real s = v[0];
  for (int i = 1; i < Lanes<Real>::count; ++i) s = v[i] > s ? v[i] : s;
  return s;
}

template <class T>
constexpr T smaller(T a, T b) {
  return b < a ? b : a;
}
template <class T>
constexpr T larger(T a, T b) {
  return a < b ? b : a;
}

}  // namespace echospline::ECHOSPLINE_CORE
