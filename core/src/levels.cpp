// Which processor levels are here: own detection, because `__builtin_cpu_supports` answers no to everything in some compilers.
#include <cstdint>

#include "level.hpp"

#if defined(__x86_64__) || defined(_M_X64)
#include <cpuid.h>
#endif

extern "C" {
#if defined(__x86_64__) || defined(_M_X64)
extern const echospline::Level echospline_level_baseline;
extern const echospline::Level echospline_level_avx2;
extern const echospline::Level echospline_level_avx512;
#elif defined(__aarch64__)
extern const echospline::Level echospline_level_neon;
#elif defined(__wasm__)
extern const echospline::Level echospline_level_simd128;
#else
extern const echospline::Level echospline_level_baseline;
#endif
}

namespace echospline {
namespace {

#if defined(__x86_64__) || defined(_M_X64)
/// Registers that the operating system saves (XCR0).
uint64_t saved_registers() {
  uint32_t low, high;
  __asm__("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
  return low | static_cast<uint64_t>(high) << 32;
}

int32_t best() {
  constexpr uint32_t FMA = 1u << 12, OSXSAVE = 1u << 27, AVX = 1u << 28;                        // leaf 1, ecx
  constexpr uint32_t BMI1 = 1u << 3, AVX2 = 1u << 5, BMI2 = 1u << 8;                            // leaf 7, ebx
  constexpr uint32_t F = 1u << 16, DQ = 1u << 17, CD = 1u << 28, BW = 1u << 30, VL = 1u << 31;  // leaf 7, ebx
  constexpr uint32_t F16C = 1u << 29, MOVBE = 1u << 22;                                         // leaf 1, ecx
  constexpr uint32_t LZCNT = 1u << 5;                                                           // leaf 0x80000001, ecx
  uint32_t a, b, c, d;
  if (!__get_cpuid(1, &a, &b, &c, &d)) return ECHOSPLINE_LEVEL_BASELINE;
  constexpr uint32_t first = FMA | OSXSAVE | AVX | F16C | MOVBE;
  if ((c & first) != first) return ECHOSPLINE_LEVEL_BASELINE;
  const uint64_t saved = saved_registers();
  if ((saved & 0x6) != 0x6) return ECHOSPLINE_LEVEL_BASELINE;
  if (!__get_cpuid(0x80000001u, &a, &b, &c, &d) || !(c & LZCNT)) return ECHOSPLINE_LEVEL_BASELINE;
  if (!__get_cpuid_count(7, 0, &a, &b, &c, &d)) return ECHOSPLINE_LEVEL_BASELINE;
  constexpr uint32_t second = BMI1 | AVX2 | BMI2;
  if ((b & second) != second) return ECHOSPLINE_LEVEL_BASELINE;
  constexpr uint32_t third = F | DQ | CD | BW | VL;
  return (b & third) == third && (saved & 0xe6) == 0xe6 ? ECHOSPLINE_LEVEL_AVX512 : ECHOSPLINE_LEVEL_AVX2;
}
#elif defined(__aarch64__)
int32_t best() { return ECHOSPLINE_LEVEL_NEON; }
#elif defined(__wasm__)
int32_t best() { return ECHOSPLINE_LEVEL_SIMD128; }
#else
int32_t best() { return ECHOSPLINE_LEVEL_BASELINE; }
#endif

}  // namespace

const Level* find_level(int32_t id) {
  const int32_t highest = best();
  if (id == ECHOSPLINE_LEVEL_BEST) id = highest;
#if defined(__x86_64__) || defined(_M_X64)
  if (id > highest) return nullptr;
  switch (id) {
    case ECHOSPLINE_LEVEL_BASELINE: return &echospline_level_baseline;
    case ECHOSPLINE_LEVEL_AVX2: return &echospline_level_avx2;
    case ECHOSPLINE_LEVEL_AVX512: return &echospline_level_avx512;
    default: return nullptr;
  }
#elif defined(__aarch64__)
  return id == ECHOSPLINE_LEVEL_NEON ? &echospline_level_neon : nullptr;
#elif defined(__wasm__)
  return id == ECHOSPLINE_LEVEL_SIMD128 ? &echospline_level_simd128 : nullptr;
#else
  return id == ECHOSPLINE_LEVEL_BASELINE ? &echospline_level_baseline : nullptr;
#endif
}

}  // namespace echospline

extern "C" {

uint32_t echospline_version(void) {
  return ECHOSPLINE_VERSION_MAJOR << 16 | ECHOSPLINE_VERSION_MINOR << 8 | ECHOSPLINE_VERSION_PATCH;
}

int32_t echospline_level_best(void) { return echospline::find_level(ECHOSPLINE_LEVEL_BEST)->id; }

int32_t echospline_level_available(int32_t level) { return echospline::find_level(level) != nullptr; }

const char* echospline_level_name(int32_t level) {
  switch (level) {
    case ECHOSPLINE_LEVEL_BEST: return "best";
    case ECHOSPLINE_LEVEL_BASELINE: return "baseline";
    case ECHOSPLINE_LEVEL_AVX2: return "AVX2";
    case ECHOSPLINE_LEVEL_AVX512: return "AVX-512";
    case ECHOSPLINE_LEVEL_NEON: return "NEON";
    case ECHOSPLINE_LEVEL_SIMD128: return "simd128";
    default: return "unknown";
  }
}

const char* echospline_status_text(echospline_status status) {
  switch (status) {
    case ECHOSPLINE_OK: return "ok";
    case ECHOSPLINE_NULL_POINTER: return "null pointer";
    case ECHOSPLINE_WRONG_SIZE: return "wrong size";
    case ECHOSPLINE_WRONG_VALUE: return "wrong value";
    case ECHOSPLINE_OUT_OF_MEMORY: return "out of memory";
    case ECHOSPLINE_NOT_HELD: return "not held";
    case ECHOSPLINE_NOT_SOLVED: return "not solved";
    case ECHOSPLINE_WRONG_STATE: return "wrong state";
    case ECHOSPLINE_FAILED_HANDLE: return "failed handle";
    case ECHOSPLINE_NEEDS_STATION: return "needs station";
    default: return "unknown status";
  }
}

}  // extern "C"
