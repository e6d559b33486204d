// Opens the namespace of the processor level that a translation unit is compiled for: `echospline::ECHOSPLINE_CORE` is
// `echospline::core_avx2` there, and so on. A translation unit that does not say uses the plain level.
#pragma once
#ifndef ECHOSPLINE_LEVEL
#define ECHOSPLINE_LEVEL baseline
#endif
#define ECHOSPLINE_LEVEL_NAME2(name) core_##name
#define ECHOSPLINE_LEVEL_NAME(name) ECHOSPLINE_LEVEL_NAME2(name)
#define ECHOSPLINE_CORE ECHOSPLINE_LEVEL_NAME(ECHOSPLINE_LEVEL)
