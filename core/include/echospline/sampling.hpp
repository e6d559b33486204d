// Reference pixels, packed for sampling, and rows of the picture written in the pixels' own type.
//
// Pixels of 8 bits are packed once with their right, lower and lower right neighbours into one word, so that a sample
// is one load; other types are kept as floats. Channels lie in planes of their own. Beyond the outermost centres the
// outermost pixel counts.
#pragma once
#include "array.hpp"
#include "gathering.hpp"

namespace echospline::ECHOSPLINE_CORE {

/// A channel of 8-bit pixels, each in a word with its right (bits 8), lower (16) and lower right (24) neighbour.
struct Quads {
  const uint32_t* words;
  int columns, rows;
};
inline void pack(const uint8_t* pixels, int channels, int channel, int columns, int rows, uint32_t* words) {
  for (int row = 0; row < rows; ++row) {
    const uint8_t* here = pixels + (int64_t(row) * columns) * channels + channel;
    const uint8_t* below = row + 1 < rows ? here + int64_t(columns) * channels : here;
    uint32_t* word = words + int64_t(row) * columns;
    for (int k = 0; k < columns; ++k) {
      const int64_t at = int64_t(k) * channels, next = k + 1 < columns ? at + channels : at;
      word[k] =
          uint32_t(here[at]) | uint32_t(here[next]) << 8 | uint32_t(below[at]) << 16 | uint32_t(below[next]) << 24;
    }
  }
}

/// A channel of floats with its last column and row repeated.
struct Plane {
  const float* values;
  int columns, rows;  // without the repeated ones
};
template <class Pixel>
inline void unpack(const Pixel* pixels, int channels, int channel, int columns, int rows, float* values) {
  for (int row = 0; row <= rows; ++row)
    for (int k = 0; k <= columns; ++k) {
      const int64_t from = int64_t(smaller(row, rows - 1)) * columns + smaller(k, columns - 1);
      values[int64_t(row) * (columns + 1) + k] = static_cast<float>(pixels[from * channels + channel]);
    }
}

/// Column, row and what is left over, of a position within the reference.
struct Place {
  Ints column, row;
  Floats across, down;
};
template <bool NEAREST>
ECHOSPLINE_INLINE Place place_of(Floats x, Floats y, int columns, int rows) {
  x = within(x, 0.0f, float(columns - 1)), y = within(y, 0.0f, float(rows - 1));
  if constexpr (NEAREST) return {to_ints(rounded(x)), to_ints(rounded(y)), Floats{}, Floats{}};
  const Ints i = to_ints(x), j = to_ints(y);
  return {i, j, x - to_floats(i), y - to_floats(j)};
}
template <bool NEAREST>
ECHOSPLINE_INLINE Floats sample(const Quads& q, Floats x, Floats y) {
  const Place p = place_of<NEAREST>(x, y, q.columns, q.rows);
  const Words word = gather(q.words, p.row * q.columns + p.column);
  const Floats a = to_floats((Ints)(word & 255));
  if constexpr (NEAREST) return a;
  const Floats b = to_floats((Ints)((word >> 8) & 255)), c = to_floats((Ints)((word >> 16) & 255)),
               d = to_floats((Ints)(word >> 24));
  const Floats top = a + p.across * (b - a), bottom = c + p.across * (d - c);
  return top + p.down * (bottom - top);
}
template <bool NEAREST>
ECHOSPLINE_INLINE Floats sample(const Plane& q, Floats x, Floats y) {
  const Place p = place_of<NEAREST>(x, y, q.columns, q.rows);
  const int stride = q.columns + 1;
  const Ints at = p.row * stride + p.column;
  const Floats a = gather(q.values, at);
  if constexpr (NEAREST) return a;
  const Floats b = gather(q.values + 1, at), c = gather(q.values + stride, at), d = gather(q.values + stride + 1, at);
  const Floats top = a + p.across * (b - a), bottom = c + p.across * (d - c);
  return top + p.down * (bottom - top);
}

/// Sample a row at reference positions; `border` where they are NaN.
template <bool NEAREST, class Source>
inline void sample_row(const Source& source, const float* x, const float* y, int columns, float border, float* values) {
  for (int k = 0; k < columns; k += LANES) {
    const Floats at_x = load(x + k), at_y = load(y + k);
    const Ints tissue = at_x == at_x;
    store(values + k, pick(tissue, sample<NEAREST>(source, at_x, at_y), all(border)));
  }
}

/// A pixel type: its range, and a number rounded into it.
template <class Pixel>
struct PixelRange;
template <>
struct PixelRange<uint8_t> {
  static constexpr float low = 0, high = 255, full = 255;
};
template <>
struct PixelRange<uint16_t> {
  static constexpr float low = 0, high = 65535, full = 65535;
};
template <>
struct PixelRange<int16_t> {
  static constexpr float low = -32768, high = 32767, full = 32767;
};
template <>
struct PixelRange<float> {
  static constexpr float full = 1;
};
template <class Pixel>
ECHOSPLINE_INLINE Pixel pixel_of(float value) {
  if constexpr (sizeof(Pixel) == 4) {
    return value;
  } else {
    constexpr float low = PixelRange<Pixel>::low, high = PixelRange<Pixel>::high;
    const float v = value > low ? (value < high ? value : high) : low;
    return static_cast<Pixel>(static_cast<int32_t>(v + (v < 0 ? -0.5f : 0.5f)));
  }
}

/// Write a grey row of 8-bit pixels; `values` is readable LANES beyond its end, `out` is not written beyond it.
inline void write_row(const float* values, int columns, uint8_t* out) {
  int k = 0;
  for (; k + LANES <= columns; k += LANES) {
    store_bytes(out + k, to_ints(within(load(values + k), 0.0f, 255.0f) + 0.5f));
  }
  for (; k < columns; ++k) out[k] = pixel_of<uint8_t>(values[k]);
}
/// Write a row: `channels` planes of values, `room` numbers apart, interleaved.
template <class Pixel>
inline void write_row(const float* values, int64_t room, int channels, int columns, Pixel* out) {
  if (channels == 1) {
    if constexpr (sizeof(Pixel) == 1) return write_row(values, columns, out);
    for (int k = 0; k < columns; ++k) out[k] = pixel_of<Pixel>(values[k]);
    return;
  }
  for (int k = 0; k < columns; ++k)
    for (int c = 0; c < channels; ++c) out[k * channels + c] = pixel_of<Pixel>(values[c * room + k]);
}
/// Write a row of red, green, blue and alpha: 0 where positions are NaN, else full.
template <class Pixel>
inline void write_row_with_alpha(const float* values, int64_t room, int channels, const float* x, int columns,
                                 Pixel* out) {
  for (int k = 0; k < columns; ++k) {
    for (int c = 0; c < 3; ++c) out[4 * k + c] = pixel_of<Pixel>(values[(channels == 3 ? c : 0) * room + k]);
    out[4 * k + 3] = x[k] == x[k] ? static_cast<Pixel>(PixelRange<Pixel>::full) : Pixel{};
  }
}

}  // namespace echospline::ECHOSPLINE_CORE
