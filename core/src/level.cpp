// The core at one processor level. Compiled once per level with -DECHOSPLINE_LEVEL=baseline, avx2, avx512, neon or simd128.
#include "../include/echospline/level_begin.hpp"
#include "force_level.hpp"
#include "green_level.hpp"
#include "picture_level.hpp"
#include "space_level.hpp"
#include "spatial_level.hpp"
#include "tissue_level.hpp"

#define ECHOSPLINE_JOIN2(a, b) a##b
#define ECHOSPLINE_JOIN(a, b) ECHOSPLINE_JOIN2(a, b)

namespace {
constexpr int32_t baseline = ECHOSPLINE_LEVEL_BASELINE, avx2 = ECHOSPLINE_LEVEL_AVX2, avx512 = ECHOSPLINE_LEVEL_AVX512,
                  neon = ECHOSPLINE_LEVEL_NEON, simd128 = ECHOSPLINE_LEVEL_SIMD128;
constexpr int32_t every[] = {baseline, avx2, avx512, neon, simd128};
static_assert(sizeof every / sizeof *every == 5);
}  // namespace

extern "C" {
extern const echospline::Level ECHOSPLINE_JOIN(echospline_level_, ECHOSPLINE_LEVEL);
const echospline::Level ECHOSPLINE_JOIN(echospline_level_, ECHOSPLINE_LEVEL) = {
    ECHOSPLINE_LEVEL,
    &echospline::ECHOSPLINE_CORE::tissue_entries,
    &echospline::ECHOSPLINE_CORE::picture_entries,
    &echospline::ECHOSPLINE_CORE::force_entries,
    &echospline::ECHOSPLINE_CORE::space_entries,
    &echospline::ECHOSPLINE_CORE::green_entries,
    &echospline::ECHOSPLINE_CORE::spatial_entries};
}
