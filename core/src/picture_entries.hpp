// What a level offers for pictures. Arguments have been checked: pointers, sizes and finite numbers.
#pragma once
#include "level.hpp"
namespace echospline {
struct PictureEntries {};
}  // namespace echospline
