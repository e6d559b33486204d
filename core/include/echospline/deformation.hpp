// The deformation of the picture: the map x -> x + u(x), bilinear in the cells of a mesh, and its inverse. Lengths are pixels.
//
// Inside a cell the map is x = a + s b + t c + s t d, so t is the root of a quadratic equation and s follows: the inverse is a formula,
// and needs no starting guess however steep the field is. Two ways lead to the picture:
// - exact: every pixel is traced back in every cell that covers it;
// - pull: only each fourth pixel of each fourth row is (the lattice), and between them the reference position is interpolated.
//   Where that would differ by more than a tenth of a pixel, or tissue ends or folds, lattice cells are traced pixel by pixel.
#pragma once
#include "array.hpp"
#include "gathering.hpp"

namespace echospline::ECHOSPLINE_CORE {

constexpr int LATTICE = 4;              // pixels between lattice points: at 8 the interpolation misses 0.05 px near a tip, at 4 0.012 px
constexpr float CENTRE_LIMIT = 0.05f;   // px at the centre of a lattice cell; a kink elsewhere in the cell misses at most twice that
constexpr float RIM = 0.5f;             // px: a pixel has an area, so tissue reaches half a pixel beyond the mesh's outermost nodes
constexpr int CHECK_EVERY = 8;          // rows and columns between pixels at which the exact inverse is composed with the forward map

/// Nodes and displacement, in pixels; rows of `stride` numbers, readable LANES beyond their end.
struct Mesh {
  int nx, ny;
  int64_t stride;
  float x0, y0, hx, hy;  // first node and spacing
  const float *ux, *uy;
  float slack;           // px by which cells overlap, so that rounding leaves no pixel between two cells
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

/// Where in the cell the point a + q lies. SIGN +1: where the map keeps the orientation, -1: where it turns tissue over.
template <int SIGN>
ECHOSPLINE_INLINE void invert(const Cell& c, float A, float B0, Floats qx, float qy, Floats& s, Floats& t) {
  // (q - t c) x (b + t d) = 0, that is A t^2 + B t + C = 0
  const Floats B = B0 - (qx * c.dy - qy * c.dx), C = qy * c.bx - qx * c.by;
  const Floats r = root(greatest(B * B - 4.0f * A * C, all(0.0f)));
  t = 2.0f * C / (float(SIGN) * r - B);
  const Floats ex = c.bx + t * c.dx, ey = c.by + t * c.dy;
  s = ((qx - t * c.cx) * ex + (qy - t * c.cy) * ey) / (ex * ex + ey * ey);
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

/// For LANES cells from (i, j): the lattice points (every `step`-th pixel, columns x rows of them) that they may cover, and whether they fold.
struct Boxes {
  int32_t first_row[LANES], last_row[LANES], first[LANES], last[LANES], folded[LANES];
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

ECHOSPLINE_INLINE Boxes boxes_at(const Mesh& m, int i, int j, int step, int columns, int rows) {
  const CellLanes c = cells_at(m, i, j);
  const Ints n = counting() + i;
  const Limits inner = {-m.slack / m.hx, 1 + m.slack / m.hx, -m.slack / m.hy, 1 + m.slack / m.hy};
  const Floats s0 = pick(n == 0, all(inner.s0 - RIM / m.hx), all(inner.s0));
  const Floats s1 = pick(n == m.nx - 2, all(inner.s1 + RIM / m.hx), all(inner.s1));
  const Floats t0 = all(j == 0 ? inner.t0 - RIM / m.hy : inner.t0), t1 = all(j == m.ny - 2 ? inner.t1 + RIM / m.hy : inner.t1);
  Floats low_x = all(3e38f), low_y = low_x, high_x = -low_x, high_y = -low_x;
  const Floats ss[2] = {s0, s1}, ts[2] = {t0, t1};
  for (const Floats& s : ss)
    for (const Floats& t : ts) {
      const Floats x = c.ax + s * c.bx + t * (c.cx + s * c.dx), y = c.ay + s * c.by + t * (c.cy + s * c.dy);
      low_x = least(x, low_x), high_x = greatest(x, high_x), low_y = least(y, low_y), high_y = greatest(y, high_y);
    }
  // first point at or after `low`, last at or before `high`, within the lattice
  const float per = 1.0f / step;
  const auto first = [&](Floats low, int count) __attribute__((always_inline)) {
    const Floats x = within(low * per, 0.0f, float(count));
    const Ints k = to_ints(x);
    return k - (Ints)(x > to_floats(k));
  };
  const auto last = [&](Floats high, int count) __attribute__((always_inline)) {
    return to_ints(within(high * per + 1.0f, 0.0f, float(count))) - 1;
  };
  Boxes b;
  const Ints r0 = first(low_y, rows), r1 = last(high_y, rows), c0 = first(low_x, columns), c1 = last(high_x, columns);
  const Ints folded = ~(smallest(jacobian(c)) > 0.0f);
  std::memcpy(b.first_row, &r0, sizeof r0), std::memcpy(b.last_row, &r1, sizeof r1);
  std::memcpy(b.first, &c0, sizeof c0), std::memcpy(b.last, &c1, sizeof c1), std::memcpy(b.folded, &folded, sizeof folded);
  return b;
}

/// Reference positions of lattice points or pixels, NaN where no tissue is; rows of `stride`, writable LANES beyond their end.
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
};

/// Trace points first..last of one row in one cell. A turned-over place counts only where no upright one is found.
template <bool FOLDED>
ECHOSPLINE_INLINE void trace_row(const Mesh& m, const Cell& c, const Limits& limits, int step, int row, int first, int last,
                                 const Positions& out) {
  const float A = c.cx * c.dy - c.cy * c.dx, B0 = c.cx * c.by - c.cy * c.bx;
  const float qy = row * float(step) - c.ay;
  float *x = out.x + row * out.stride, *y = out.y + row * out.stride;
  for (int k = first; k <= last; k += LANES) {
    const Floats qx = (counted() + float(k)) * float(step) - c.ax;
    Floats s, t;
    invert<1>(c, A, B0, qx, qy, s, t);
    const Ints in = (s >= limits.s0) & (s <= limits.s1) & (t >= limits.t0) & (t <= limits.t1);
    Floats at_x = load(x + k), at_y = load(y + k);
    if constexpr (FOLDED) {
      Floats turned_s, turned_t;
      invert<-1>(c, A, B0, qx, qy, turned_s, turned_t);
      const Ints turned = (turned_s >= limits.s0) & (turned_s <= limits.s1) & (turned_t >= limits.t0) &
                          (turned_t <= limits.t1) & (at_x != at_x);
      at_x = pick(turned, c.px + turned_s * m.hx, at_x), at_y = pick(turned, c.py + turned_t * m.hy, at_y);
    }
    store(x + k, pick(in, c.px + s * m.hx, at_x));
    store(y + k, pick(in, c.py + t * m.hy, at_y));
  }
}

template <bool FOLDED>
ECHOSPLINE_INLINE void trace_cell(const Mesh& m, int i, int j, int step, const Boxes& b, int lane, const Marks* marks,
                                  const Positions& out) {
  const Cell c = cell_at(m, i, j);
  const Limits limits = limits_of(m, i, j);
  const int first = b.first[lane], last = b.last[lane], first_row = b.first_row[lane], last_row = b.last_row[lane];
  if (!marks) {
    for (int row = first_row; row <= last_row; ++row) trace_row<FOLDED>(m, c, limits, step, row, first, last, out);
    return;
  }
  for (int band = first_row / LATTICE; band <= last_row / LATTICE; ++band) {
    const uint8_t* mark = marks->at + band * marks->stride;
    const int top = larger(first_row, band * LATTICE), bottom = smaller(last_row, band * LATTICE + LATTICE - 1);
    for (int k = first / LATTICE; k <= last / LATTICE; ++k) {
      if (!mark[k]) continue;
      const int begin = larger(first, k * LATTICE);
      while (k < last / LATTICE && mark[k + 1]) ++k;
      const int end = smaller(last, k * LATTICE + LATTICE - 1);
      for (int row = top; row <= bottom; ++row) trace_row<FOLDED>(m, c, limits, step, row, begin, end, out);
    }
  }
}

/// Trace every `step`-th pixel back, cell by cell; with marks, only pixels of marked lattice cells.
inline void trace(const Mesh& m, int step, const Marks* marks, const Positions& out) {
  for (int j = 0; j < m.ny - 1; ++j)
    for (int i = 0; i < m.nx - 1; i += LANES) {
      const Boxes b = boxes_at(m, i, j, step, out.columns, out.rows);
      for (int lane = 0; lane < LANES && i + lane < m.nx - 1; ++lane) {
        if (b.first[lane] > b.last[lane] || b.first_row[lane] > b.last_row[lane]) continue;
        if (b.folded[lane])
          trace_cell<true>(m, i + lane, j, step, b, lane, marks, out);
        else
          trace_cell<false>(m, i + lane, j, step, b, lane, marks, out);
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
      const Floats corners[4] = {c.top_left * scale, c.top_right * scale, c.bottom_left * scale, c.bottom_right * scale};
      for (int lane = 0; lane < LANES && i + lane < m.nx - 1; ++lane) {
        found.cells += !(worst[lane] > 0);
        for (int k = 0; k < 4; ++k)
          if (corners[k][lane] < found.smallest)
            found.smallest = corners[k][lane], found.node_x = i + lane + k % 2, found.node_y = j + k / 2;
      }
    }
  return found;
}

/// Forward map at reference positions less the pixels p where they should come to lie, and the same traced back through the gradient:
/// how far the position is off.
struct Misfit {
  Floats forward, back;  // squared, px^2
};
ECHOSPLINE_INLINE Misfit misfit_at(const Mesh& m, Floats x, Floats y, Floats px, Floats py) {
  const Floats fx = (x - m.x0) * (1.0f / m.hx), fy = (y - m.y0) * (1.0f / m.hy);
  const Ints i = to_ints(within(fx, 0.0f, float(m.nx - 2))), j = to_ints(within(fy, 0.0f, float(m.ny - 2)));
  const Floats s = fx - to_floats(i), t = fy - to_floats(j);
  const Ints at = j * int32_t(m.stride) + i, below = at + int32_t(m.stride);
  const Floats u00 = gather(m.ux, at), u01 = gather(m.ux + 1, at) - u00, u10 = gather(m.ux, below) - u00,
               u11 = gather(m.ux + 1, below) - u00 - u01 - u10;
  const Floats v00 = gather(m.uy, at), v01 = gather(m.uy + 1, at) - v00, v10 = gather(m.uy, below) - v00,
               v11 = gather(m.uy + 1, below) - v00 - v01 - v10;
  const Floats rx = x + (u00 + s * u01 + t * (u10 + s * u11)) - px, ry = y + (v00 + s * v01 + t * (v10 + s * v11)) - py;
  const Floats xx = 1.0f + (u01 + t * u11) * (1.0f / m.hx), xy = (u10 + s * u11) * (1.0f / m.hy);
  const Floats yx = (v01 + t * v11) * (1.0f / m.hx), yy = 1.0f + (v10 + s * v11) * (1.0f / m.hy);
  const Floats det = 1.0f / (xx * yy - xy * yx), bx = (yy * rx - xy * ry) * det, by = (xx * ry - yx * rx) * det;
  return {rx * rx + ry * ry, bx * bx + by * by};
}

/// What the lattice left to be traced exactly, and how far the rest is off.
struct LatticeCheck {
  int64_t marked = 0;
  float residual = 0;    // px, largest misfit of the forward map
  float difference = 0;  // px, largest estimated distance from the exact position: twice the one at cell centres
};

/// Mark the lattice cells in which interpolation is not good enough.
inline LatticeCheck mark_cells(const Mesh& m, const Positions& lattice, Marks& marks) {
  // A mesh finer than the lattice bends between the centre and the corners too.
  const bool fine = m.hx < LATTICE || m.hy < LATTICE;
  constexpr float share[5][2] = {{0.5f, 0.5f}, {0.25f, 0.25f}, {0.75f, 0.25f}, {0.25f, 0.75f}, {0.75f, 0.75f}};
  LatticeCheck check;
  Floats residual = all(0.0f), difference = all(0.0f);
  for (int row = 0; row < marks.rows; ++row) {
    const float *x0 = lattice.x + row * lattice.stride, *y0 = lattice.y + row * lattice.stride;
    const float *x1 = x0 + lattice.stride, *y1 = y0 + lattice.stride;
    uint8_t* mark = marks.at + row * marks.stride;
    for (int k = 0; k < marks.columns; k += LANES) {
      const Ints held = counting() + k < marks.columns;
      const Floats xa = load(x0 + k), xb = load(x0 + k + 1), xc = load(x1 + k), xd = load(x1 + k + 1);
      const Floats ya = load(y0 + k), yb = load(y0 + k + 1), yc = load(y1 + k), yd = load(y1 + k + 1);
      Floats forward = all(0.0f), back = forward;
      Ints good = held;
      for (int n = 0; n < (fine ? 5 : 1); ++n) {
        const float f = share[n][0], g = share[n][1];
        const Floats x = (1 - g) * ((1 - f) * xa + f * xb) + g * ((1 - f) * xc + f * xd);
        const Floats y = (1 - g) * ((1 - f) * ya + f * yb) + g * ((1 - f) * yc + f * yd);
        const Misfit miss = misfit_at(m, x, y, (counted() + (float(k) + f)) * float(LATTICE), all((row + g) * float(LATTICE)));
        good &= miss.back < CENTRE_LIMIT * CENTRE_LIMIT;  // no where a corner is nowhere
        forward = greatest(miss.forward, forward), back = greatest(miss.back, back);
      }
      residual = pick(good, greatest(forward, residual), residual);
      difference = pick(good, greatest(back, difference), difference);
      const Ints bad = ~good & held & 1;
      for (int lane = 0; lane < LANES && k + lane < marks.columns; ++lane) {
        mark[k + lane] = uint8_t(bad[lane]);
        check.marked += bad[lane];
      }
    }
  }
  check.residual = __builtin_sqrtf(largest<float>(residual));
  check.difference = 2 * __builtin_sqrtf(largest<float>(difference));
  return check;
}

/// Mark the lattice cells that folded cells of the mesh may cover.
inline int64_t mark_folds(const Mesh& m, Marks& marks) {
  int64_t added = 0;
  for (int j = 0; j < m.ny - 1; ++j)
    for (int i = 0; i < m.nx - 1; i += LANES) {
      const Boxes b = boxes_at(m, i, j, 1, marks.columns * LATTICE, marks.rows * LATTICE);
      for (int lane = 0; lane < LANES && i + lane < m.nx - 1; ++lane) {
        if (!b.folded[lane]) continue;
        const int first = larger(b.first[lane] - 1, 0) / LATTICE, last = smaller((b.last[lane] + 1) / LATTICE, marks.columns - 1);
        const int top = larger(b.first_row[lane] - 1, 0) / LATTICE,
                  bottom = smaller((b.last_row[lane] + 1) / LATTICE, marks.rows - 1);
        for (int row = top; row <= bottom; ++row)
          for (int k = first; k <= last; ++k) {
            uint8_t& mark = marks.at[row * marks.stride + k];
            added += !mark;
            mark = 1;
          }
      }
    }
  return added;
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
      const Misfit miss = misfit_at(m, x, y, to_floats(at), all(float(row)));
      worst = pick(in, greatest(miss.forward, worst), worst);
    }
  return __builtin_sqrtf(largest<float>(worst));
}

}  // namespace echospline::ECHOSPLINE_CORE
