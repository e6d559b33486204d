// Grey picture to RGBA for a display: gain, gain by depth, dynamic range.
//
// A recorded picture is compressed logarithmically, grey g of 255 being R (g/255 - 1) dB relative to white over its range R. A gain of
// G dB and a shown range of D dB make it 255 (1 + (R (g/255 - 1) + G) / D): one line per row, tabulated in whole numbers, so that every
// processor level gives the same bytes. Below grey DARK that line is bent to black: where nothing was recorded nothing is shown.
#pragma once
#include <cmath>
#include <cstdint>

#include "echospline.h"
#include "lanes.hpp"

namespace echospline::ECHOSPLINE_CORE {

constexpr int DARK = 8;  // grey level; smaller: a gain makes salt and pepper of dark tissue; larger: dark tissue fades
constexpr int POINT =
    12;  // binary digits after the point: a slope to 0.03 grey levels, and the greatest shift fits 31 bits

/// Gain of a row in dB: sliders stand at even distances from the first row to the last; between them the gain is linear.
inline double gain_of_row(const echospline_look& look, int row, int rows) {
  const int last = look.depth_gain_count - 1;
  if (last < 0) return look.gain;
  const double place = rows > 1 ? static_cast<double>(row) * last / (rows - 1) : 0.0;
  const int before = smaller(static_cast<int>(place), larger(last - 1, 0)), after = smaller(before + 1, last);
  const double share = place - before;
  return look.gain + (1 - share) * look.depth_gains[before] + share * look.depth_gains[after];
}

/// Shown pixel, opaque grey, of every recorded grey level under a gain.
inline void tabulate(const echospline_look& look, double gain, uint32_t* table) {
  const double rise = look.recorded_range / look.dynamic_range, start = 255 * (1 - rise + gain / look.dynamic_range);
  const double bend = rise + larger(0.0, start) / DARK, one = 1 << POINT;
  const auto slope = static_cast<int32_t>(std::lround(rise * one)),
             shift = static_cast<int32_t>(std::lround(start * one));
  const auto steep = static_cast<int32_t>(std::lround(bend * one));
  const int32_t inverted = look.invert ? 255 : 0;
  for (int32_t grey = 0; grey < 256; ++grey) {
    const int32_t line = grey * slope + shift, dark = grey * steep, lower = smaller(line, dark);
    const int32_t shown = smaller((larger(lower, 0) + (1 << (POINT - 1))) >> POINT, 255) ^ inverted;
    table[grey] = static_cast<uint32_t>(shown) * 0x010101u | 0xff000000u;  // the same bytes in either order but alpha
  }
}

/// Shade a grey picture; red, green, blue and alpha of a pixel are four bytes.
inline void shade(const echospline_look& look, const uint8_t* grey, int columns, int rows, uint8_t* rgba) {
  uint32_t table[256];
  double tabulated = 0;
  for (int row = 0; row < rows; ++row, grey += columns, rgba += 4 * int64_t(columns)) {
    const double gain = gain_of_row(look, row, rows);
    if (row == 0 || gain != tabulated) tabulate(look, tabulated = gain, table);
    for (int column = 0; column < columns; ++column) {
      const int to = look.flip ? columns - 1 - column : column;
      std::memcpy(rgba + 4 * int64_t(to), table + grey[column], 4);
    }
  }
}

}  // namespace echospline::ECHOSPLINE_CORE
