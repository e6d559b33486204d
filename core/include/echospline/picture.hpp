// The picture: reference image, deformation and needle echo, drawn in one pass over the rows.
#pragma once
#include "deformation.hpp"
#include "needle_echo.hpp"
#include "sampling.hpp"

namespace echospline::ECHOSPLINE_CORE {

/// Bytes of one pixel of a type.
constexpr int64_t pixel_size(int32_t type) { return type == ECHOSPLINE_UINT8 ? 1 : type == ECHOSPLINE_FLOAT32 ? 4 : 2; }

/// Grey level of white where none is given.
constexpr float full_scale(int32_t type) {
  switch (type) {
    case ECHOSPLINE_UINT8: return PixelRange<uint8_t>::full;
    case ECHOSPLINE_UINT16: return PixelRange<uint16_t>::full;
    case ECHOSPLINE_INT16: return PixelRange<int16_t>::full;
    default: return PixelRange<float>::full;
  }
}

/// One reference image with its present deformation. All memory is reserved by `prepare`; nothing after it allocates.
class Picture {
 public:
  /// False when memory runs out.
  bool prepare(const echospline_picture_options& options, const void* pixels) {
    o_ = options;
    columns_ = o_.columns, rows_ = o_.rows, channels_ = o_.channels;
    white_ = o_.white > 0 ? float(o_.white) : full_scale(o_.pixel_type);
    room_ = rounded_up(columns_, LATTICE * LANES) + LANES;
    raster_ = Raster::of(LATTICE, columns_, rows_);
    cell_columns_ = larger(1, raster_.columns - 1), cell_rows_ = larger(1, raster_.rows - 1);
    // margins: LANES before a row, and more behind it
    lattice_room_ = rounded_up(cell_columns_ + 1, LANES) + 4 * LANES;
    const int64_t pixel_count = int64_t(columns_) * rows_;
    const bool bytes = o_.pixel_type == ECHOSPLINE_UINT8;
    Mesh& m = mesh_;
    m.nx = o_.mesh_shape[0], m.ny = o_.mesh_shape[1], m.stride = rounded_up(m.nx, LANES) + LANES;
    m.x0 = float((o_.mesh_origin[0] - o_.origin[0]) / o_.spacing[0]),
    m.y0 = float((o_.mesh_origin[1] - o_.origin[1]) / o_.spacing[1]);
    m.hx = float(o_.mesh_spacing[0] / o_.spacing[0]), m.hy = float(o_.mesh_spacing[1] / o_.spacing[1]);
    m.slack = 5e-7f * float(larger(columns_, rows_) + 32);
    exact_ = o_.method == ECHOSPLINE_METHOD_EXACT ||
             (o_.method == ECHOSPLINE_METHOD_AUTO && (m.hx < LATTICE || m.hy < LATTICE));

    const bool there = ux_.reserve((m.ny + 3) * m.stride) && uy_.reserve((m.ny + 3) * m.stride) &&
                       x_.reserve(rows_ * room_) && y_.reserve(rows_ * room_) &&
                       lattice_x_.reserve((cell_rows_ + 4) * lattice_room_) &&
                       lattice_y_.reserve((cell_rows_ + 4) * lattice_room_) &&
                       marks_.reserve(cell_rows_ * lattice_room_ + 8) && row_.reserve(2 * (room_ + LATTICE * LANES)) &&
                       values_.reserve(3 * room_ + 4 * LANES) && true && noise_.reserve() && tables_.reserve() &&
                       (bytes ? words_.reserve(channels_ * pixel_count)
                              : planes_.reserve(channels_ * int64_t(columns_ + 1) * (rows_ + 1)));
    if (!there) return false;
    // the shadow is evaluated each half millimetre or finer
    const double pitch = larger(o_.spacing[0], o_.spacing[1]);
    shade_step_ = pitch * 4 <= 0.5 ? 4 : pitch * 2 <= 0.5 ? 2 : 1;
    shade_columns_ = (columns_ - 1) / shade_step_ + 2, shade_rows_ = (rows_ - 1) / shade_step_ + 2;
    shade_room_ = rounded_up(shade_columns_, LANES) + LANES;
    if (!shade_.reserve(shade_rows_ * shade_room_) || !shaded_.reserve(shade_rows_)) return false;
    m.ux = ux_.data() + m.stride, m.uy = uy_.data() + m.stride;
    noise_.make(0);
    set_reference(pixels);
    return true;
  }

  int64_t size() const {
    return int64_t(columns_) * rows_ * (o_.border == ECHOSPLINE_BORDER_TRANSPARENT ? 4 : channels_) *
           pixel_size(o_.pixel_type);
  }

  void set_reference(const void* pixels) {
    for (int c = 0; c < channels_; ++c) {
      float* plane = planes_.data() + c * int64_t(columns_ + 1) * (rows_ + 1);
      switch (o_.pixel_type) {
        case ECHOSPLINE_UINT8:
          pack(static_cast<const uint8_t*>(pixels), channels_, c, columns_, rows_,
               words_.data() + c * int64_t(columns_) * rows_);
          break;
        case ECHOSPLINE_UINT16:
          unpack(static_cast<const uint16_t*>(pixels), channels_, c, columns_, rows_, plane);
          break;
        case ECHOSPLINE_INT16: unpack(static_cast<const int16_t*>(pixels), channels_, c, columns_, rows_, plane); break;
        default: unpack(static_cast<const float*>(pixels), channels_, c, columns_, rows_, plane);
      }
    }
  }

  /// Displacement of node n is (u[n * step], v[n * step]) mm.
  template <class Real>
  void deform(const Real* u, const Real* v, int64_t step) {
    const Real per_x = Real(1 / o_.spacing[0]), per_y = Real(1 / o_.spacing[1]);
    for (int j = 0; j < mesh_.ny; ++j) {
      const int64_t first = int64_t(j) * mesh_.nx;
      float *to_u = ux_.data() + (j + 1) * mesh_.stride, *to_v = uy_.data() + (j + 1) * mesh_.stride;
      for (int i = 0; i < mesh_.nx; ++i) {
        to_u[i] = static_cast<float>(u[(first + i) * step] * per_x);
        to_v[i] = static_cast<float>(v[(first + i) * step] * per_y);
      }
    }
    traced_ = latticed_ = false;
  }

  void draw(const echospline_needle* needle, void* out) {
    exact_ ? trace_pixels() : trace_lattice();
    const Extent extent = {o_.origin[0], o_.origin[0] + (columns_ - 1) * o_.spacing[0], o_.origin[1],
                           o_.origin[1] + (rows_ - 1) * o_.spacing[1]};
    if (!needle) return draw_rows(nullptr, 0, out);
    noise_.make(needle->seed);
    const NeedleEcho echo(*needle, extent, noise_, tables_);
    shade_lattice(echo, white_ / float(needle->dynamic_range));
    draw_rows(&echo, float(needle->dynamic_range), out);
  }

  void inverse(float* x, float* y) {
    trace_pixels();
    for (int row = 0; row < rows_; ++row) {
      std::memcpy(x + int64_t(row) * columns_, x_.data() + row * room_, size_t(columns_) * sizeof(float));
      std::memcpy(y + int64_t(row) * columns_, y_.data() + row * room_, size_t(columns_) * sizeof(float));
    }
  }

  void check(echospline_picture_report& report) {
    const Folds folds = find_folds(mesh_);
    report.folded_cells = folds.cells, report.smallest_jacobian = folds.smallest;
    report.place[0] = o_.mesh_origin[0] + folds.node_x * o_.mesh_spacing[0];
    report.place[1] = o_.mesh_origin[1] + folds.node_y * o_.mesh_spacing[1];
    report.method = exact_ ? ECHOSPLINE_METHOD_EXACT : ECHOSPLINE_METHOD_PULL;
    if (exact_) {
      trace_pixels();
      report.residual = residual_of(mesh_, pixels()), report.difference = 0, report.exact_share = 1;
    } else {
      trace_lattice();
      report.residual = residual_of(mesh_, lattice(), marks(), raster_), report.difference = check_.difference;
      report.exact_share = double(check_.marked) / (double(cell_columns_) * cell_rows_);
    }
  }

  void echo_at(const echospline_needle& needle, const double* points, int64_t count, double* power,
               double* transmission) {
    noise_.make(needle.seed);
    Extent extent = {1e30, -1e30, 1e30, -1e30};
    for (int64_t k = 0; k < count; ++k) {
      extent.left = smaller(extent.left, points[2 * k]), extent.right = larger(extent.right, points[2 * k]);
      extent.top = smaller(extent.top, points[2 * k + 1]), extent.bottom = larger(extent.bottom, points[2 * k + 1]);
    }
    const NeedleEcho echo(needle, extent, noise_, tables_);
    for (int64_t k = 0; k < count; k += LANES) {
      const int held = int(smaller<int64_t>(LANES, count - k));
      Floats x = Floats{}, y = Floats{};
      for (int lane = 0; lane < held; ++lane)
        x[lane] = float(points[2 * (k + lane)]), y[lane] = float(points[2 * (k + lane) + 1]);
      Floats light = echo.footprint().count ? echo.line(x, y) : Floats{};
      for (int spot = 0; spot < echo.spots(); ++spot) light += echo.spot(spot, x, y);
      const Floats passed = echo.shades() ? power_of(echo.shade(x, y)) : all(1.0f);
      for (int lane = 0; lane < held; ++lane) power[k + lane] = light[lane], transmission[k + lane] = passed[lane];
    }
  }

 private:
  Positions pixels() { return {x_.data(), y_.data(), columns_, rows_, room_}; }
  /// Lattice points; a margin that is nowhere lies around them.
  Positions lattice() {
    const int64_t first = lattice_room_ + LANES;
    return {lattice_x_.data() + first, lattice_y_.data() + first, cell_columns_ + 1, cell_rows_ + 1, lattice_room_};
  }
  Marks marks() { return {marks_.data(), cell_columns_, cell_rows_, lattice_room_}; }

  /// Trace every pixel back.
  void trace_pixels() {
    if (traced_) return;
    set_nowhere(x_.data(), x_.size()), set_nowhere(y_.data(), y_.size());
    trace(mesh_, Raster::of(1, columns_, rows_), nullptr, pixels());
    traced_ = true;
  }

  /// Trace the lattice, and the pixels of the cells in which it is not good enough.
  void trace_lattice() {
    if (latticed_) return;
    set_nowhere(lattice_x_.data(), lattice_x_.size()), set_nowhere(lattice_y_.data(), lattice_y_.size());
    const Positions points = lattice();
    trace(mesh_, raster_, nullptr, points);
    extend(points.x, points.stride), extend(points.y, points.stride);
    Marks bad = marks();
    const Raster every_pixel = Raster::of(1, columns_, rows_);
    check_ = mark_cells(mesh_, points, every_pixel, bad);
    if (check_.marked && !traced_) {
      for (int row = 0; row < rows_; ++row)
        each_marked_run(row, [&](int first, int count) {
          set_nowhere(x_.data() + row * room_ + first, count), set_nowhere(y_.data() + row * room_ + first, count);
        });
      trace(mesh_, every_pixel, &bad, pixels());
    }
    latticed_ = true;
  }
  /// The last points were traced at the last pixels, which may be less than a step away: move them on to a whole step.
  void extend(float* p, int64_t stride) const {
    const int across = raster_.last_column - (cell_columns_ - 1) * LATTICE,
              down = raster_.last_row - (cell_rows_ - 1) * LATTICE;
    for (int row = 0; row < raster_.rows; ++row) {
      float* last = p + row * stride + cell_columns_;
      if (across == 0)
        last[0] = last[-1];
      else if (across < LATTICE)
        last[0] = last[-1] + (last[0] - last[-1]) * (float(LATTICE) / across);
      last[1] = last[0];  // a last pixel that is a lattice point has no next one
    }
    float *last = p + cell_rows_ * stride, *before = last - stride;
    for (int k = 0; k <= cell_columns_ && down < LATTICE; ++k) {
      if (down == 0)
        last[k] = before[k];
      else
        last[k] = before[k] + (last[k] - before[k]) * (float(LATTICE) / down);
    }
  }
  /// Call `visit` with the first pixel and the number of pixels of each marked lattice cell of a row of pixels.
  template <class Visit>
  ECHOSPLINE_INLINE void each_marked_run(int row, Visit visit) const {
    const uint8_t* mark = marks_.data() + smaller(row / LATTICE, cell_rows_ - 1) * lattice_room_;
    for (int k = 0; k < cell_columns_; k += 8) {
      uint64_t eight;
      std::memcpy(&eight, mark + k, sizeof eight);
      if (!eight) continue;
      for (int n = k; n < smaller(k + 8, cell_columns_); ++n)
        if (mark[n]) visit(n * LATTICE, n == cell_columns_ - 1 ? columns_ - n * LATTICE : LATTICE);
    }
  }

  /// Positions of a row's pixels between the lattice points, then those of marked cells from the map.
  void interpolate_row(int row, float* x, float* y) {
    const Positions points = lattice();
    const int band = smaller(row / LATTICE, cell_rows_ - 1);
    const float f = (row - band * LATTICE) * (1.0f / LATTICE);
    interpolate_line(points.x + band * points.stride, f, x), interpolate_line(points.y + band * points.stride, f, y);
    const float *exact_x = x_.data() + row * room_, *exact_y = y_.data() + row * room_;
    each_marked_run(row, [&](int first, int count) __attribute__((always_inline)) {
      for (int k = first; k < first + count; ++k) x[k] = exact_x[k], y[k] = exact_y[k];
    });
  }
  ECHOSPLINE_INLINE void interpolate_line(const float* above, float f, float* out) const {
    const float* below = above + lattice_room_;
    for (int k = 0; k * LATTICE < columns_; k += LANES) {
      const Floats a = load(above + k), b = load(above + k + 1);
      const Floats from = a + f * (load(below + k) - a), to = b + f * (load(below + k + 1) - b);
      spread_line<LATTICE>(from, to - from, [&](int part, Floats v) __attribute__((always_inline)) {
        store(out + k * LATTICE + part * LANES, v);
      });
    }
  }

  /// Grey levels that the shadow takes away, at lattice points.
  void shade_lattice(const NeedleEcho& echo, float per_decibel) {
    for (int row = 0; row < shade_rows_; ++row) {
      Reach& reach = shaded_[row];
      reach = {shade_columns_, -1};
      if (!echo.shades()) continue;
      const Floats y = all(float(o_.origin[1] + row * shade_step_ * o_.spacing[1]));
      float* shade = shade_.data() + row * shade_room_;
      for (int k = 0; k < shade_columns_; k += LANES) {
        const Floats x = float(o_.origin[0]) + (counted() + float(k)) * float(shade_step_ * o_.spacing[0]);
        const Floats loss = echo.shade(x, y);
        store(shade + k, loss * per_decibel);
        if (any(loss < -0.003f))
          reach.first = smaller(reach.first, k), reach.last = smaller(k + LANES - 1, shade_columns_ - 1);
      }
    }
  }
  template <int STEP>
  void shade_pixels(int row, float* values) {
    const int band = row / STEP;
    const Reach &above = shaded_[band], &below = shaded_[band + 1];
    const int first = larger(smaller(above.first, below.first) - 1, 0), last = larger(above.last, below.last);
    if (first > last) return;
    const float f = (row % STEP) * (1.0f / STEP);
    const float *a = shade_.data() + band * shade_room_, *b = a + shade_room_;
    for (int k = first / LANES * LANES; k <= last && k * STEP < columns_; k += LANES) {
      const Floats here = load(a + k), next = load(a + k + 1);
      const Floats from = here + f * (load(b + k) - here), to = next + f * (load(b + k + 1) - next);
      spread_line<STEP>(from, to - from, [&](int part, Floats loss) __attribute__((always_inline)) {
        for (int c = 0; c < channels_; ++c) {
          float* at = values + c * room_ + k * STEP + part * LANES;
          const Floats v = load(at);
          store(at, greatest(v + loss, least(v, all(0.0f))));
        }
      });
    }
  }

  /// Shadow and echo of a row; with `tissue`, only where it is not NaN.
  void draw_needle(const NeedleEcho& __restrict echo, float range, int row, const float* tissue,
                   float* __restrict values) {
    if (shade_step_ == 4) shade_pixels<4>(row, values);
    if (shade_step_ == 2) shade_pixels<2>(row, values);
    if (shade_step_ == 1) shade_pixels<1>(row, values);
    const double y = o_.origin[1] + row * o_.spacing[1];
    double first, last;
    if (echo.footprint().interval(y, first, last))
      add_power(first, last, range, tissue, values,
                [&](Floats x) __attribute__((always_inline)) { return echo.line(x, all(float(y))); });
    const double reach = echo.spot_reach();
    for (int k = 0; k < echo.spots(); ++k)
      if (y > echo.spot_y(k) - reach && y < echo.spot_y(k) + reach)
        add_power(echo.spot_x(k) - reach, echo.spot_x(k) + reach, range, tissue, values,
                  [&](Floats x) __attribute__((always_inline)) { return echo.spot(k, x, all(float(y))); });
  }
  /// Add the power between two places of a row, mm, to its values.
  template <class Power>
  ECHOSPLINE_INLINE void add_power(double first, double last, float range, const float* tissue,
                                   float* __restrict values, Power power_at) {
    const double per = 1 / o_.spacing[0];
    const int begin = int(larger(0.0, smaller((first - o_.origin[0]) * per, double(columns_))));
    const int end = int(larger(0.0, smaller((last - o_.origin[0]) * per + 1, double(columns_))));
    for (int k = begin; k < end; k += LANES) {
      Floats power = power_at(float(o_.origin[0]) + (counted() + float(k)) * float(o_.spacing[0]));
      if (tissue) power = pick(load(tissue + k) == load(tissue + k), power, Floats{});
      if (!any(power > 1e-8f)) continue;
      for (int c = 0; c < channels_; ++c)
        store(values + c * room_ + k, with_echo(load(values + c * room_ + k), power, white_, range));
    }
  }

  void draw_rows(const NeedleEcho* echo, float range, void* out) {
    const float border = o_.border == ECHOSPLINE_BORDER_TRANSPARENT ? 0.0f : float(o_.border_value);
    float *room_x = row_.data(), *room_y = room_x + room_ + LATTICE * LANES;
    for (int row = 0; row < rows_; ++row) {
      const float *x = x_.data() + row * room_, *y = y_.data() + row * room_;
      if (!exact_) {
        interpolate_row(row, room_x, room_y);
        x = room_x, y = room_y;
      }
      sample(x, y, border);
      if (echo)
        draw_needle(*echo, range, row, o_.border == ECHOSPLINE_BORDER_TRANSPARENT ? x : nullptr, values_.data());
      write(row, x, out);
    }
  }

  void sample(const float* x, const float* y, float border) {
    const bool nearest = o_.interpolation == ECHOSPLINE_NEAREST;
    for (int c = 0; c < channels_; ++c) {
      float* values = values_.data() + c * room_;
      if (o_.pixel_type == ECHOSPLINE_UINT8) {
        const Quads source = {words_.data() + c * int64_t(columns_) * rows_, columns_, rows_};
        nearest ? sample_row<true>(source, x, y, columns_, border, values)
                : sample_row<false>(source, x, y, columns_, border, values);
      } else {
        const Plane source = {planes_.data() + c * int64_t(columns_ + 1) * (rows_ + 1), columns_, rows_};
        nearest ? sample_row<true>(source, x, y, columns_, border, values)
                : sample_row<false>(source, x, y, columns_, border, values);
      }
    }
  }

  void write(int row, const float* x, void* out) {
    switch (o_.pixel_type) {
      case ECHOSPLINE_UINT8: return write_as<uint8_t>(row, x, out);
      case ECHOSPLINE_UINT16: return write_as<uint16_t>(row, x, out);
      case ECHOSPLINE_INT16: return write_as<int16_t>(row, x, out);
      default: return write_as<float>(row, x, out);
    }
  }
  template <class Pixel>
  void write_as(int row, const float* x, void* out) {
    if (o_.border == ECHOSPLINE_BORDER_TRANSPARENT)
      write_row_with_alpha(values_.data(), room_, channels_, x, columns_,
                           static_cast<Pixel*>(out) + int64_t(row) * columns_ * 4);
    else
      write_row(values_.data(), room_, channels_, columns_,
                static_cast<Pixel*>(out) + int64_t(row) * columns_ * channels_);
  }

  /// Columns of a row of the shadow's lattice that are not 0.
  struct Reach {
    int first, last;
  };

  echospline_picture_options o_ = {};
  Mesh mesh_ = {};
  Raster raster_ = {};
  int columns_ = 0, rows_ = 0, channels_ = 1, cell_columns_ = 1, cell_rows_ = 1, shade_step_ = 4, shade_columns_ = 0,
      shade_rows_ = 0;
  int64_t room_ = 0, lattice_room_ = 0, shade_room_ = 0;
  float white_ = 255;
  bool exact_ = true, traced_ = false, latticed_ = false;
  LatticeCheck check_;
  Array<float> ux_, uy_;  // displacement, pixels
  Array<float> x_, y_;    // exact map: of every pixel, or of those in marked cells
  Array<float> lattice_x_, lattice_y_;
  Array<uint8_t> marks_;
  Array<float> row_, values_;  // of the row that is drawn
  Array<float> shade_;
  Array<Reach> shaded_;
  Array<uint32_t> words_;  // reference: 8-bit pixels
  Array<float> planes_;    // reference: other types
  Noise noise_;
  EchoTables tables_;
};

}  // namespace echospline::ECHOSPLINE_CORE
