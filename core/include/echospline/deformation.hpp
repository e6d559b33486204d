// The deformation of the picture: the map x -> x + u(x), bilinear in the cells of a mesh, and its inverse. Lengths are
// pixels.
//
// Inside a cell the map is x = a + s b + t c + s t d, so t is the root of a quadratic equation and s follows: the
// inverse is a formula, and needs no starting guess however steep the field is. Two ways lead to the picture:
// - exact: every pixel is traced back in every cell that covers it;
// - pull: only each fourth pixel of each fourth row is (the lattice); between them the position is interpolated.
//   Where that would differ by more than a tenth of a pixel, or tissue ends or folds, lattice cells are traced pixel by
// pixel.
#pragma once
#include "array.hpp"
#include "gathering.hpp"

namespace echospline::ECHOSPLINE_CORE {

constexpr int LATTICE = 4;  // pixels between lattice points: at 8 they miss 0.05 px near a tip, at 4 0.012 px
constexpr float LATTICE_LIMIT = 0.1f;  // px that an interpolated position may miss: a tenth of a pixel is not seen
constexpr float RIM = 0.5f;            // px: a pixel has an area, so tissue reaches half of one beyond the mesh
constexpr int CHECK_EVERY = 8;         // rows and columns between pixels at which the inverse is checked

/// Nodes and displacement, in pixels; rows of `stride` numbers, readable LANES beyond their ends and a row before and
/// after them.
struct Mesh {
  int nx, ny;
  int64_t stride;
  float x0, y0, hx, hy;  // first node and spacing
  const float *ux, *uy;
  float slack;  // px by which cells overlap, so that rounding leaves no pixel between two cells
};

/// x = a + s b + t c + s t d in one cell; p: its first node in the reference.
struct Cell {
  float px, py, ax, ay, bx, by, cx, cy, dx, dy;
};

ECHOSPLINE_INLINE Cell cell_at(const Mesh& m, int i, int j) {
  const float *u = m.ux + j * m.stride + i, *v = m.uy + j * m.stride + i;
  const float *below_u = u + m.stride, *below_v = v + m.stride;
  Cell c;
  c.px = m.x0 + i * m.hx, c.py = m.y0 + j * m.hy;
  c.ax = c.px + u[0], c.ay = c.py + v[0];
  c.bx = m.hx + (u[1] - u[0]), c.by = v[1] - v[0];
  c.cx = below_u[0] - u[0], c.cy = m.hy + (below_v[0] - v[0]);
  c.dx = (below_u[1] - below_u[0]) - (u[1] - u[0]), c.dy = (below_v[1] - below_v[0]) - (v[1] - v[0]);
  return c;
}

/// Where in the cell the point a + q lies. SIGN +1: where the map keeps the orientation, -1: where it turns tissue
/// over. Number: a float for one cell, or lanes for many.
template <int SIGN, class Number>
ECHOSPLINE_INLINE void invert(Number bx, Number by, Number cx, Number cy, Number dx, Number dy, Floats qx, Floats qy,
                              Floats& s, Floats& t) {
  // (q - t c) x (b + t d) = 0, that is A t^2 + B t + C = 0
  const Number A = cx * dy - cy * dx;
  const Floats B = (cx * by - cy * bx) - (qx * dy - qy * dx), C = qy * bx - qx * by;
  const Floats r = root(B * B - 4.0f * A * C);  // not a number, and so in no cell, where the point has no place
  t = 2.0f * C / (float(SIGN) * r - B);
  const Floats ex = bx + t * dx, ey = by + t * dy;
  s = ((qx - t * cx) * ex + (qy - t * cy) * ey) / (ex * ex + ey * ey);
}

/// Limits of s and t in which a cell covers pixels: its own square, and the rim where the mesh ends.
struct Limits {
  float s0, s1, t0, t1;
};
ECHOSPLINE_INLINE Limits limits_of(const Mesh& m, int i, int j) {
  const float es = m.slack / m.hx, et = m.slack / m.hy;
  return {i == 0 ? -RIM / m.hx - es : -es, i == m.nx - 2 ? 1 + RIM / m.hx + es : 1 + es,
          j == 0 ? -RIM / m.hy - et : -et, j == m.ny - 2 ? 1 + RIM / m.hy + et : 1 + et};
}

/// For LANES cells: the points that they may cover, and whether they fold.
struct Boxes {
  Ints first_row, last_row, first, last, folded;
};
/// Corners' Jacobian determinants times hx hy; bilinear cells have their extremes there.
struct Corners {
  Floats top_left, top_right, bottom_left, bottom_right;
};
struct CellLanes {
  Floats ax, ay, bx, by, cx, cy, dx, dy;
};
ECHOSPLINE_INLINE CellLanes cells_at(const Mesh& m, int i, int j) {
  const float *u = m.ux + j * m.stride + i, *v = m.uy + j * m.stride + i;
  const Floats u00 = load(u), u01 = load(u + 1), u10 = load(u + m.stride), u11 = load(u + m.stride + 1);
  const Floats v00 = load(v), v01 = load(v + 1), v10 = load(v + m.stride), v11 = load(v + m.stride + 1);
  CellLanes c;
  c.ax = (m.x0 + (counted() + float(i)) * m.hx) + u00, c.ay = (m.y0 + j * m.hy) + v00;
  c.bx = m.hx + (u01 - u00), c.by = v01 - v00;
  c.cx = u10 - u00, c.cy = m.hy + (v10 - v00);
  c.dx = (u11 - u10) - (u01 - u00), c.dy = (v11 - v10) - (v01 - v00);
  return c;
}
ECHOSPLINE_INLINE Corners jacobian(const CellLanes& c) {
  const Floats rx = c.cx + c.dx, ry = c.cy + c.dy, lx = c.bx + c.dx, ly = c.by + c.dy;
  return {c.bx * c.cy - c.by * c.cx, c.bx * ry - c.by * rx, lx * c.cy - ly * c.cx, lx * ry - ly * rx};
}
ECHOSPLINE_INLINE Floats smallest(const Corners& c) {
  return least(least(c.top_left, c.top_right), least(c.bottom_left, c.bottom_right));
}

/// Which pixels are traced: every `step`-th, and the last of each row and column whatever the step.
struct Raster {
  int step, last_column, last_row;  // in pixels
  int columns, rows;                // points

  static constexpr Raster of(int step, int columns, int rows) {
    return {step, columns - 1, rows - 1, (columns - 2 + step) / step + 1, (rows - 2 + step) / step + 1};
  }
};

ECHOSPLINE_INLINE Boxes boxes_at(const Mesh& m, int i, int j, const CellLanes& c, const Raster& raster) {
  const Ints n = counting() + i;
  const Limits inner = {-m.slack / m.hx, 1 + m.slack / m.hx, -m.slack / m.hy, 1 + m.slack / m.hy};
  const Floats s0 = pick(n == 0, all(inner.s0 - RIM / m.hx), all(inner.s0));
  const Floats s1 = pick(n == m.nx - 2, all(inner.s1 + RIM / m.hx), all(inner.s1));
  const Floats t0 = all(j == 0 ? inner.t0 - RIM / m.hy : inner.t0),
               t1 = all(j == m.ny - 2 ? inner.t1 + RIM / m.hy : inner.t1);
  Floats low_x = all(3e38f), low_y = low_x, high_x = -low_x, high_y = -low_x;
  const Floats ss[2] = {s0, s1}, ts[2] = {t0, t1};
  for (const Floats& s : ss)
    for (const Floats& t : ts) {
      const Floats x = c.ax + s * c.bx + t * (c.cx + s * c.dx), y = c.ay + s * c.by + t * (c.cy + s * c.dy);
      low_x = least(x, low_x), high_x = greatest(x, high_x), low_y = least(y, low_y), high_y = greatest(y, high_y);
    }
  // first point at or after `low`, last at or before `high`
  const float per = 1.0f / raster.step;
  const auto first = [&](Floats low, int last_pixel, int count) __attribute__((always_inline)) {
    const Floats x = within(low * per, 0.0f, float(count));
    const Ints k = to_ints(x), up = k - (Ints)(x > to_floats(k));
    return pick(low > float(last_pixel), all_ints(count), pick(up < count, up, all_ints(count - 1)));
  };
  const auto last = [&](Floats high, int last_pixel, int count) __attribute__((always_inline)) {
    const Ints k = to_ints(within(high * per + 1.0f, 0.0f, float(count))) - 1;
    return pick(high >= float(last_pixel), all_ints(count - 1), k);
  };
  Boxes b;
  b.first_row = first(low_y, raster.last_row, raster.rows), b.last_row = last(high_y, raster.last_row, raster.rows);
  b.first = first(low_x, raster.last_column, raster.columns), b.last = last(high_x, raster.last_column, raster.columns);
  b.folded = ~(smallest(jacobian(c)) > 0.0f);
  // empty ones: none of the lanes beyond the mesh, and none that lie outside the picture
  const Ints empty = (n > m.nx - 2) | (b.first > b.last) | (b.first_row > b.last_row);
  b.last = pick(empty, b.first - 1, b.last);
  return b;
}

/// Reference positions of lattice points or pixels, NaN where no tissue is; rows of `stride`, writable LANES beyond
/// their end.
struct Positions {
  float *x, *y;
  int columns, rows;
  int64_t stride;
};

/// Lattice cells whose pixels are traced one by one.
struct Marks {
  uint8_t* at;
  int columns, rows;
  int64_t stride;
  int first = 0, last = -1, first_row = 0, last_row = -1;  // box around all of them

  void widen(int row, int begin, int end) {
    if (last_row < 0) first = begin, last = end, first_row = row;
    first = smaller(first, begin), last = larger(last, end), first_row = smaller(first_row, row),
    last_row = larger(last_row, row);
  }
};

/// Trace points first..last of one row in one cell. A turned-over place counts only where no upright one is found.
template <bool FOLDED>
ECHOSPLINE_INLINE void trace_row(const Mesh& m, const Cell& c, const Limits& limits, const Raster& raster, int row,
                                 int first, int last, const Positions& out) {
  const Floats qy = all(smaller(row * raster.step, raster.last_row) - c.ay);
  float *x = out.x + row * out.stride, *y = out.y + row * out.stride;
  for (int k = first; k <= last; k += LANES) {
    Floats at = (counted() + float(k)) * float(raster.step);
    if (raster.step > 1) at = least(at, all(float(raster.last_column)));
    const Floats qx = at - c.ax;
    Floats s, t;
    invert<1>(c.bx, c.by, c.cx, c.cy, c.dx, c.dy, qx, qy, s, t);
    const Ints in = (s >= limits.s0) & (s <= limits.s1) & (t >= limits.t0) & (t <= limits.t1);
    Floats at_x = load(x + k), at_y = load(y + k);
    if constexpr (FOLDED) {
      Floats turned_s, turned_t;
      invert<-1>(c.bx, c.by, c.cx, c.cy, c.dx, c.dy, qx, qy, turned_s, turned_t);
      const Ints turned = (turned_s >= limits.s0) & (turned_s <= limits.s1) & (turned_t >= limits.t0) &
                          (turned_t <= limits.t1) & (at_x != at_x);
      at_x = pick(turned, c.px + turned_s * m.hx, at_x), at_y = pick(turned, c.py + turned_t * m.hy, at_y);
    }
    store(x + k, pick(in, c.px + s * m.hx, at_x));
    store(y + k, pick(in, c.py + t * m.hy, at_y));
  }
}

/// Trace points first..last, at most half as many as lanes, of all rows of a cell that does not fold: two rows at a
/// time.
ECHOSPLINE_INLINE void trace_row_pairs(const Mesh& m, const Cell& c, const Limits& limits, const Raster& raster,
                                       int first_row, int last_row, int first, const Positions& out) {
  constexpr int HALF = LANES / 2;
  const Ints second = counting() >= HALF;
  Floats column = to_floats(first + (counting() & (HALF - 1))) * float(raster.step);
  if (raster.step > 1) column = least(column, all(float(raster.last_column)));
  const Floats qx = column - c.ax;
  for (int row = first_row; row <= last_row; row += 2) {
    const int next = smaller(row + 1, last_row);  // the last row may come twice
    const float above = float(smaller(row * raster.step, raster.last_row)),
                below = float(smaller(next * raster.step, raster.last_row));
    Floats s, t;
    invert<1>(c.bx, c.by, c.cx, c.cy, c.dx, c.dy, qx, pick(second, all(below), all(above)) - c.ay, s, t);
    const Ints in = (s >= limits.s0) & (s <= limits.s1) & (t >= limits.t0) & (t <= limits.t1);
    const int64_t at = row * out.stride + first, at_next = next * out.stride + first;
    store_halves(out.x + at, out.x + at_next, pick(in, c.px + s * m.hx, load_halves(out.x + at, out.x + at_next)));
    store_halves(out.y + at, out.y + at_next, pick(in, c.py + t * m.hy, load_halves(out.y + at, out.y + at_next)));
  }
}

template <bool FOLDED>
inline void trace_cell(const Mesh& m, int i, int j, const Raster& raster, const Boxes& b, int lane, const Marks* marks,
                       const Positions& out) {
  const Cell c = cell_at(m, i, j);
  const Limits limits = limits_of(m, i, j);
  const int first = b.first[lane], last = b.last[lane], first_row = b.first_row[lane], last_row = b.last_row[lane];
  if (!marks) {
    if constexpr (!FOLDED && LANES >= 8)
      if (last - first < LANES / 2) return trace_row_pairs(m, c, limits, raster, first_row, last_row, first, out);
    for (int row = first_row; row <= last_row; ++row) trace_row<FOLDED>(m, c, limits, raster, row, first, last, out);
    return;
  }
  // runs of marked lattice cells; the last one of a row or column holds the picture's last pixels
  const int first_cell = smaller(first / LATTICE, marks->columns - 1),
            last_cell = smaller(last / LATTICE, marks->columns - 1);
  const int first_band = smaller(first_row / LATTICE, marks->rows - 1),
            last_band = smaller(last_row / LATTICE, marks->rows - 1);
  for (int band = first_band; band <= last_band; ++band) {
    const uint8_t* mark = marks->at + band * marks->stride;
    const int top = larger(first_row, band * LATTICE),
              bottom = band == last_band ? last_row : band * LATTICE + LATTICE - 1;
    for (int k = first_cell; k <= last_cell; ++k) {
      if (!mark[k]) continue;
      const int begin = larger(first, k * LATTICE);
      while (k < last_cell && mark[k + 1]) ++k;
      const int end = k == last_cell ? last : k * LATTICE + LATTICE - 1;
      for (int row = top; row <= bottom; ++row) trace_row<FOLDED>(m, c, limits, raster, row, begin, end, out);
    }
  }
}

/// Trace the points of LANES cells that do not fold, each lane in its own cell: for cells that hold few points.
ECHOSPLINE_INLINE void trace_cells(const Mesh& m, int i, int j, const CellLanes& c, const Boxes& b,
                                   const Raster& raster, const Positions& out) {
  const Ints n = counting() + i;
  const float es = m.slack / m.hx, et = m.slack / m.hy;
  const Floats s0 = pick(n == 0, all(-es - RIM / m.hx), all(-es)),
               s1 = pick(n == m.nx - 2, all(1 + es + RIM / m.hx), all(1 + es));
  const Floats t0 = all(j == 0 ? -et - RIM / m.hy : -et), t1 = all(j == m.ny - 2 ? 1 + et + RIM / m.hy : 1 + et);
  const Floats px = m.x0 + to_floats(n) * m.hx;
  const float py = m.y0 + j * m.hy;
  const int wide = most(b.last - b.first), high = most(b.last_row - b.first_row);
  const Ints nowhere = all_ints(int32_t(out.stride - 1));  // padding: what is written there is not read
  for (int down = 0; down <= high; ++down) {
    const Ints row = b.first_row + down;
    const Floats qy = least(to_floats(row) * float(raster.step), all(float(raster.last_row))) - c.ay;
    for (int across = 0; across <= wide; ++across) {
      const Ints column = b.first + across;
      const Floats qx = least(to_floats(column) * float(raster.step), all(float(raster.last_column))) - c.ax;
      Floats s, t;
      invert<1>(c.bx, c.by, c.cx, c.cy, c.dx, c.dy, qx, qy, s, t);
      const Ints in = (s >= s0) & (s <= s1) & (t >= t0) & (t <= t1) & (column <= b.last) & (row <= b.last_row);
      scatter(pick(in, row * int32_t(out.stride) + column, nowhere), px + s * m.hx, py + t * m.hy, out.x, out.y);
    }
  }
}
constexpr int FEW_POINTS = 25;  // in a cell: above that a row of points of one cell fills the lanes better

/// Trace the raster's points back, cell by cell; with marks, only pixels of marked lattice cells.
inline void trace(const Mesh& m, const Raster& raster, const Marks* marks, const Positions& out) {
  for (int j = 0; j < m.ny - 1; ++j)
    for (int i = 0; i < m.nx - 1; i += LANES) {
      const CellLanes c = cells_at(m, i, j);
      Boxes b = boxes_at(m, i, j, c, raster);
      Ints alone = b.first <= b.last;  // lanes that are traced on their own
      if (marks)
        alone &= (b.last >= marks->first * LATTICE) & (b.first < (marks->last + 1) * LATTICE + 1) &
                 (b.last_row >= marks->first_row * LATTICE) & (b.first_row < (marks->last_row + 1) * LATTICE + 1);
      if (!any(alone)) continue;
      if (!marks && (most(b.last - b.first) + 1) * (most(b.last_row - b.first_row) + 1) <= FEW_POINTS) {
        alone &= b.folded;
        Boxes sound = b;
        sound.last = pick(b.folded, b.first - 1, b.last);
        trace_cells(m, i, j, c, sound, raster, out);
        if (!any(alone)) continue;
      }
      for (int lane = 0; lane < LANES; ++lane) {
        if (!alone[lane]) continue;
        if (b.folded[lane])
          trace_cell<true>(m, i + lane, j, raster, b, lane, marks, out);
        else
          trace_cell<false>(m, i + lane, j, raster, b, lane, marks, out);
      }
    }
}

inline void set_nowhere(float* p, int64_t count) {
  for (int64_t i = 0; i < count; ++i) p[i] = __builtin_nanf("");
}

/// Where the map folds.
struct Folds {
  int64_t cells = 0;   // in which the Jacobian determinant is not positive somewhere
  float smallest = 0;  // Jacobian determinant over all cells
  int node_x = 0, node_y = 0;
};
inline Folds find_folds(const Mesh& m) {
  Folds found;
  found.smallest = 3e38f;
  const float scale = 1.0f / (m.hx * m.hy);
  for (int j = 0; j < m.ny - 1; ++j)
    for (int i = 0; i < m.nx - 1; i += LANES) {
      const Corners c = jacobian(cells_at(m, i, j));
      const Ints held = counting() + i < m.nx - 1;
      const Floats worst = smallest(c) * scale;
      if (!any(held & ~(worst > larger(0.0f, found.smallest)))) continue;
      const Floats corners[4] = {c.top_left * scale, c.top_right * scale, c.bottom_left * scale,
                                 c.bottom_right * scale};
      for (int lane = 0; lane < LANES && i + lane < m.nx - 1; ++lane) {
        found.cells += !(worst[lane] > 0);
        for (int k = 0; k < 4; ++k)
          if (corners[k][lane] < found.smallest)
            found.smallest = corners[k][lane], found.node_x = i + lane + k % 2, found.node_y = j + k / 2;
      }
    }
  return found;
}

/// Squared distance between the forward map of reference positions and the pixels p where they should come to lie,
/// px^2.
ECHOSPLINE_INLINE Floats square_misfit_at(const Mesh& m, Floats x, Floats y, Floats px, Floats py) {
  const Floats fx = (x - m.x0) * (1.0f / m.hx), fy = (y - m.y0) * (1.0f / m.hy);
  const Ints i = to_ints(within(fx, 0.0f, float(m.nx - 2))), j = to_ints(within(fy, 0.0f, float(m.ny - 2)));
  const Floats s = fx - to_floats(i), t = fy - to_floats(j);
  const Ints at = j * int32_t(m.stride) + i, below = at + int32_t(m.stride);
  const auto between = [&](const float* u) __attribute__((always_inline)) {
    const Floats a = gather(u, at), b = gather(u + 1, at), c = gather(u, below), d = gather(u + 1, below);
    const Floats top = a + s * (b - a), bottom = c + s * (d - c);
    return top + t * (bottom - top);
  };
  const Floats rx = x + between(m.ux) - px, ry = y + between(m.uy) - py;
  return rx * rx + ry * ry;
}

/// What the lattice left to be traced exactly, and how far the rest is off.
struct LatticeCheck {
  int64_t marked = 0;
  float difference = 0;  // px, bound of the distance between interpolated and exact positions
};

/// Squared bend of the displacement at nodes: its second difference towards `step`.
ECHOSPLINE_INLINE Floats bend_at(const float* u, const float* v, int64_t step) {
  const Floats x = (load(u + step) - load(u)) - (load(u) - load(u - step)),
               y = (load(v + step) - load(v)) - (load(v) - load(v - step));
  return x * x + y * y;
}
/// How far positions between lattice points may be off in LANES cells, px; huge where they fold.
///
/// Between lattice points lie l = LATTICE |J^-1| pixels of the reference. Where the gradient jumps by g across an edge
/// of the mesh, the displacement leaves its chord by at most g l / 4, and by l / 2h times as much where the mesh is
/// finer than that; the position is off by |J^-1| times that.
ECHOSPLINE_INLINE Floats lattice_error_at(const Mesh& m, int i, int j, const CellLanes& c) {
  const float *u = m.ux + j * m.stride + i, *v = m.uy + j * m.stride + i;
  const int64_t down = m.stride;
  const Ints n = counting() + i;
  const Floats none = all(0.0f);
  // the mesh's own edges do not bend
  const Floats left = pick(n > 0, greatest(bend_at(u, v, 1), bend_at(u + down, v + down, 1)), none);
  const Floats right =
      pick(n < m.nx - 2, greatest(bend_at(u + 1, v + 1, 1), bend_at(u + down + 1, v + down + 1, 1)), none);
  const Floats top = j > 0 ? greatest(bend_at(u, v, down), bend_at(u + 1, v + 1, down)) : none;
  const Floats bottom =
      j < m.ny - 2 ? greatest(bend_at(u + down, v + down, down), bend_at(u + down + 1, v + down + 1, down)) : none;
  const float px = 1.0f / m.hx, py = 1.0f / m.hy;
  const Floats jump_x = root(greatest(left, right)) * px, jump_y = root(greatest(top, bottom)) * py;
  // |J^-1|: largest singular value of J over its determinant, at the cell's worst
  const Floats xx = (c.bx + 0.5f * c.dx) * px, yx = (c.by + 0.5f * c.dy) * px, xy = (c.cx + 0.5f * c.dx) * py,
               yy = (c.cy + 0.5f * c.dy) * py;
  const Floats sum_a = xx + yy, sum_b = yx - xy, difference_a = xx - yy, difference_b = yx + xy;
  const Floats stretch =
      0.5f * (root(sum_a * sum_a + sum_b * sum_b) + root(difference_a * difference_a + difference_b * difference_b));
  const Floats determinant = smallest(jacobian(c)) * (px * py);
  const Floats inverse = stretch / greatest(determinant, all(1e-6f)), chord = inverse * float(LATTICE);
  const Floats twist = root(c.dx * c.dx + c.dy * c.dy) * (px * py) * chord * 0.25f;
  const Floats off = 0.25f * (jump_x * greatest(chord * (0.5f * px), all(1.0f)) +
                              jump_y * greatest(chord * (0.5f * py), all(1.0f)) + twist);
  return pick(determinant > 0.0f, inverse * chord * off, all(3e38f));
}

/// Mark the lattice cells in which interpolation is not good enough.
inline LatticeCheck mark_cells(const Mesh& m, const Positions& lattice, const Raster& pixels, Marks& marks) {
  LatticeCheck check;
  // where tissue ends
  for (int row = 0; row < marks.rows; ++row) {
    const float *x = lattice.x + row * lattice.stride, *below = x + lattice.stride;
    uint8_t* mark = marks.at + row * marks.stride;
    for (int k = 0; k < marks.columns; k += LANES) {
      const Floats corners = load(x + k) + load(x + k + 1) + load(below + k) + load(below + k + 1);
      const Ints ends = (corners != corners) & (counting() + k < marks.columns);
      store_bytes(mark + k, ends & 1);
      if (!any(ends)) continue;
      check.marked -= sum(ends);
      marks.widen(row, k, smaller(k + LANES, marks.columns) - 1);
    }
  }
  // where the mesh bends much, or folds
  for (int j = 0; j < m.ny - 1; ++j)
    for (int i = 0; i < m.nx - 1; i += LANES) {
      const CellLanes c = cells_at(m, i, j);
      const Floats off = pick(counting() + i < m.nx - 1, lattice_error_at(m, i, j, c), all(0.0f));
      const Ints bad = ~(off < LATTICE_LIMIT);
      check.difference = larger(check.difference, largest<float>(pick(bad, all(0.0f), off)));
      if (!any(bad)) continue;
      const Boxes b = boxes_at(m, i, j, c, pixels);
      for (int lane = 0; lane < LANES; ++lane) {
        if (!bad[lane] || b.first[lane] > b.last[lane]) continue;
        const int first = larger(b.first[lane] - 1, 0) / LATTICE,
                  last = smaller((b.last[lane] + 1) / LATTICE, marks.columns - 1);
        const int top = larger(b.first_row[lane] - 1, 0) / LATTICE,
                  bottom = smaller((b.last_row[lane] + 1) / LATTICE, marks.rows - 1);
        for (int row = top; row <= bottom; ++row)
          for (int k = first; k <= last; ++k) {
            uint8_t& mark = marks.at[row * marks.stride + k];
            check.marked += !mark;
            mark = 1;
          }
        if (top <= bottom && first <= last) marks.widen(top, first, last), marks.widen(bottom, first, last);
      }
    }
  return check;
}

/// Largest misfit of the forward map in the middle of the cells that are interpolated, px.
inline float residual_of(const Mesh& m, const Positions& lattice, const Marks& marks, const Raster& raster) {
  Floats worst = all(0.0f);
  for (int row = 0; row < marks.rows; ++row)
    for (int k = 0; k < marks.columns; k += LANES) {
      const float *x = lattice.x + row * lattice.stride + k, *y = lattice.y + row * lattice.stride + k;
      const uint8_t* mark = marks.at + row * marks.stride + k;
      // the last column and row of points lie at the last pixel
      const Floats left = (counted() + float(k)) * float(LATTICE),
                   right = least(left + float(LATTICE), all(float(raster.last_column)));
      const float top = float(row * LATTICE), bottom = smaller(top + LATTICE, float(raster.last_row));
      const float f = row == marks.rows - 1 ? (bottom - top) / (2 * LATTICE) : 0.5f;  // stored as if a whole step below
      const Floats g = (right - left) * (0.5f / LATTICE);
      const Floats ax = load(x) + f * (load(x + lattice.stride) - load(x)),
                   bx = load(x + 1) + f * (load(x + lattice.stride + 1) - load(x + 1));
      const Floats ay = load(y) + f * (load(y + lattice.stride) - load(y)),
                   by = load(y + 1) + f * (load(y + lattice.stride + 1) - load(y + 1));
      Ints good = counting() + k < marks.columns;
      for (int lane = 0; lane < LANES; ++lane) good[lane] &= mark[lane] ? 0 : -1;
      const Floats miss = square_misfit_at(m, ax + g * (bx - ax), ay + g * (by - ay), 0.5f * (left + right),
                                           all(0.5f * (top + bottom)));
      worst = pick(good, greatest(miss, worst), worst);
    }
  return __builtin_sqrtf(largest<float>(worst));
}

/// Largest misfit of the forward map at every eighth row and column, px; pixels in the rim are left out.
inline float residual_of(const Mesh& m, const Positions& p) {
  Floats worst = all(0.0f);
  const float right = m.x0 + (m.nx - 1) * m.hx, bottom = m.y0 + (m.ny - 1) * m.hy;
  for (int row = 0; row < p.rows; row += CHECK_EVERY)
    for (int k = 0; k < p.columns; k += CHECK_EVERY * LANES) {
      const Ints column = counting() * CHECK_EVERY + k;
      const Ints at = pick(column < p.columns, column, Ints{});
      const Floats x = gather(p.x + row * p.stride, at), y = gather(p.y + row * p.stride, at);
      const Ints in = (x >= m.x0) & (x <= right) & (y >= m.y0) & (y <= bottom);
      const Floats miss = square_misfit_at(m, x, y, to_floats(at), all(float(row)));
      worst = pick(in, greatest(miss, worst), worst);
    }
  return __builtin_sqrtf(largest<float>(worst));
}

}  // namespace echospline::ECHOSPLINE_CORE
