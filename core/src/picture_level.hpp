// Pictures at one processor level.
#pragma once
#include "picture_entries.hpp"
#include "../include/echospline/array.hpp"
#include "../include/echospline/lanes.hpp"
namespace echospline::ECHOSPLINE_CORE {
namespace {
const PictureEntries picture_entries = {};
}
}  // namespace echospline::ECHOSPLINE_CORE
