// What a level offers for scenes and tissues. Arguments have been checked: pointers, sizes and finite numbers.
#pragma once
#include "level.hpp"
namespace echospline {
struct TissueEntries {};
}  // namespace echospline
