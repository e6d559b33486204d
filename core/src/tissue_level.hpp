// Scenes and tissues at one processor level.
#pragma once
#include "tissue_entries.hpp"
#include "../include/echospline/array.hpp"
#include "../include/echospline/lanes.hpp"
namespace echospline::ECHOSPLINE_CORE {
namespace {
const TissueEntries tissue_entries = {};
}
}  // namespace echospline::ECHOSPLINE_CORE
