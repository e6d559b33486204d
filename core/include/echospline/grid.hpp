// The mesh and what of it can be a landmark: anchors along clamped and sliding edges, and the lattice of nodes that the needle can touch.
#pragma once
#include <cmath>

#include "array.hpp"
#include "lanes.hpp"
#include "vec.hpp"

namespace echospline::ECHOSPLINE_CORE {

constexpr double SAME_ANCHOR = 1e-6;  // mm; anchors closer than this are one
constexpr double ALONG = 1e9;         // mm; a sliding edge further away than this along the needle is not ahead of it

/// Points at constant spacing, x fastest.
template <int D>
struct Grid {
  int32_t shape[D];
  Vec<D> spacing, origin;  ///< mm

  int64_t size() const {
    int64_t n = 1;
    for (int d = 0; d < D; ++d) n *= shape[d];
    return n;
  }
  double last(int d) const { return origin[d] + (shape[d] - 1) * spacing[d]; }
  void index(int64_t node, int32_t (&i)[D]) const {
    for (int d = 0; d < D; ++d) i[d] = static_cast<int32_t>(node % shape[d]), node /= shape[d];
  }
  int64_t node_at(const int32_t (&i)[D]) const {
    int64_t node = 0;
    for (int d = D; d-- > 0;) node = node * shape[d] + i[d];
    return node;
  }
  Vec<D> place(int64_t node) const {
    int32_t i[D];
    index(node, i);
    Vec<D> p;
    for (int d = 0; d < D; ++d) p[d] = origin[d] + spacing[d] * i[d];
    return p;
  }
  /// Node nearest to a point.
  int64_t nearest(const Vec<D>& p) const {
    int32_t i[D];
    for (int d = 0; d < D; ++d) {
      const double f = std::nearbyint((p[d] - origin[d]) / spacing[d]);
      i[d] = static_cast<int32_t>(smaller(larger(f, 0.0), shape[d] - 1.0));
    }
    return node_at(i);
  }
  bool contains(const Vec<D>& p) const {
    for (int d = 0; d < D; ++d)
      if (!(p[d] >= origin[d] && p[d] <= last(d))) return false;
    return true;
  }
};

/// A landmark that stays, and the components of the displacement that it holds at zero.
template <int D>
struct Anchor {
  Vec<D> place;  ///< mm
  bool held[D];
};

enum class Edge : unsigned char { free, sliding, clamped };

/// What is held: whole edges or faces, clamped or sliding (the normal component alone is held), and clamped points.
template <int D>
struct Clamps {
  Edge edge[D][2];       ///< the edge or face where a coordinate is least, and where it is greatest
  Array<Vec<D>> points;  ///< mm

  bool holds(int d, int side, int component) const {
    return edge[d][side] == Edge::clamped || (edge[d][side] == Edge::sliding && component == d);
  }
  /// Whether any component of a node is held: it lies in a clamped or sliding edge or is the nearest one to a clamped point.
  bool hold(const Grid<D>& grid, int64_t node) const {
    int32_t i[D];
    grid.index(node, i);
    for (int d = 0; d < D; ++d)
      if ((edge[d][0] != Edge::free && i[d] == 0) || (edge[d][1] != Edge::free && i[d] == grid.shape[d] - 1))
        return true;
    for (int64_t p = 0; p < points.size(); ++p)
      if (grid.nearest(points[p]) == node) return true;
    return false;
  }
  /// Distance over which a needle with its tip at p can push, mm: to what is clamped; along the needle to an edge that slides, which stops
  /// no more than the part of a push along its normal. 0 on what is held and beyond it; infinite where nothing is.
  double clearance(const Grid<D>& grid, const Vec<D>& p, const Vec<D>& axis) const {
    double nearest = INFINITY;
    for (int d = 0; d < D; ++d)
      for (int side = 0; side < 2; ++side) {
        if (edge[d][side] == Edge::free) continue;
        double gap = side ? grid.last(d) - p[d] : p[d] - grid.origin[d];
        const double steep = std::fabs(axis[d]);
        if (edge[d][side] == Edge::sliding && gap > 0) gap = gap < ALONG * steep ? gap / steep : INFINITY;
        nearest = smaller(nearest, gap);
      }
    for (int64_t i = 0; i < points.size(); ++i) nearest = smaller(nearest, norm(p - points[i]));
    return larger(0.0, nearest);
  }

  /// Anchors along the clamped and sliding edges, at most `spacing` mm apart along each direction, then the points. Where every affine motion
  /// is free of energy (a thin plate), a component that one edge alone holds could tilt about it: a second row, one spacing outside the mesh,
  /// holds its slope. Writes to `out` when it is not nullptr; returns how many there are, an upper bound while anchors that coincide
  /// have not been merged.
  int64_t anchors(const Grid<D>& grid, double spacing, bool affine, Anchor<D>* out) const {
    int64_t count = 0;
    for (int d = 0; d < D; ++d)
      for (int side = 0; side < 2; ++side)
        if (edge[d][side] != Edge::free) {
          Anchor<D> anchor;
          for (int e = 0; e < D; ++e) anchor.held[e] = holds(d, side, e);
          count += row(grid, spacing, d, side, 0, anchor, out, count);
        }
    for (int64_t i = 0; i < points.size(); ++i) {
      Anchor<D> anchor;
      anchor.place = points[i];
      for (int e = 0; e < D; ++e) anchor.held[e] = true;
      count += add(anchor, out, count);
    }
    for (int d = 0; affine && d < D; ++d)
      for (int side = 0; side < 2; ++side) {
        Anchor<D> anchor;
        bool any = false;
        for (int e = 0; e < D; ++e) any |= anchor.held[e] = tilts_about(grid, spacing, d, side, e);
        if (any) count += row(grid, spacing, d, side, spacing, anchor, out, count);
      }
    return count;
  }

 private:
  /// Whether an edge holds a component that no other edge holds, and no clamped point further than one spacing from it.
  bool tilts_about(const Grid<D>& grid, double spacing, int d, int side, int component) const {
    int edges = 0;
    for (int e = 0; e < D; ++e) edges += holds(e, 0, component) + holds(e, 1, component);
    if (edges != 1 || !holds(d, side, component)) return false;
    for (int64_t i = 0; i < points.size(); ++i)
      if (std::fabs(points[i][d] - (side ? grid.last(d) : grid.origin[d])) > spacing) return false;
    return true;
  }
  /// Anchors along one edge, that far outside it.
  static int64_t row(const Grid<D>& grid, double spacing, int d, int side, double outside, Anchor<D>& anchor,
                     Anchor<D>* out, int64_t before) {
    int64_t gaps[D], total = 1, count = 0;
    for (int e = 0; e < D; ++e) {
      const double width = grid.last(e) - grid.origin[e];
      gaps[e] = e == d ? 0 : static_cast<int64_t>(larger(1.0, std::ceil(width / spacing - 1e-9)));
      total *= gaps[e] + 1;
    }
    for (int64_t j = 0; j < total; ++j) {
      int64_t rest = j;
      for (int e = 0; e < D; ++e) {
        const int64_t i = rest % (gaps[e] + 1);
        rest /= gaps[e] + 1;
        const double a = grid.origin[e], b = grid.last(e);
        anchor.place[e] = e == d ? (side ? b + outside : a - outside)
                                 : a + static_cast<double>(i) / static_cast<double>(gaps[e]) * (b - a);
      }
      count += add(anchor, out, before + count);
    }
    return count;
  }
  static int64_t add(const Anchor<D>& anchor, Anchor<D>* out, int64_t count) {
    if (!out) return 1;
    for (int64_t i = 0; i < count; ++i) {
      bool same = true;
      for (int d = 0; d < D; ++d) same = same && std::fabs(out[i].place[d] - anchor.place[d]) < SAME_ANCHOR;
      if (!same) continue;
      for (int d = 0; d < D; ++d) out[i].held[d] |= anchor.held[d];
      return 0;
    }
    out[count] = anchor;
    return 1;
  }
};

/// The mesh nodes that may become contacts: every one, or every second, third ..., about `spacing` apart, without held ones. A contact
/// stands for the tissue around it, so that a fine mesh has no more of them than a coarse one.
template <int D>
struct ContactLattice {
  int32_t stride[D], first[D], lines[D];
  Array<int32_t> source;  ///< of a place in the lattice, x fastest; -1 where the node is held
  Array<int64_t> node;    ///< mesh node of each source, ascending
  double gap;             ///< a quarter of the smallest distance between lines that hold a source, mm

  bool build(const Grid<D>& grid, const Clamps<D>& clamps, double spacing) {
    int64_t places = 1, count = 0;
    for (int d = 0; d < D; ++d) {
      // about the spacing in the plane; in space not more, for shafts lie between its rows
      const double share = spacing / grid.spacing[d], whole = D == 2 ? std::nearbyint(share) : std::floor(share + 1e-9);
      stride[d] = static_cast<int32_t>(larger(1.0, smaller(whole, 1e9)));
      first[d] = (grid.shape[d] - 1) % stride[d] / 2;
      lines[d] = (grid.shape[d] - 1 - first[d]) / stride[d] + 1;
      places *= lines[d];
    }
    if (!source.reserve(places)) return false;
    for (int64_t j = 0; j < places; ++j)
      source[j] = clamps.hold(grid, mesh_node(grid, j)) ? -1 : static_cast<int32_t>(count++);
    if (!node.reserve(count)) return false;
    for (int64_t j = 0; j < places; ++j)
      if (source[j] >= 0) node[source[j]] = mesh_node(grid, j);
    return find_gap(grid);
  }

 private:
  int64_t mesh_node(const Grid<D>& grid, int64_t place) const {
    int32_t i[D];
    for (int d = 0; d < D; ++d) i[d] = first[d] + stride[d] * static_cast<int32_t>(place % lines[d]), place /= lines[d];
    return grid.node_at(i);
  }
  bool find_gap(const Grid<D>& grid) {
    double least = INFINITY;
    for (int d = 0; d < D; ++d) {
      Array<char> used;
      if (!used.reserve(lines[d])) return false;
      int64_t inner = 1;
      for (int e = 0; e < d; ++e) inner *= lines[e];
      for (int64_t j = 0; j < source.size(); ++j)
        if (source[j] >= 0) used[j / inner % lines[d]] = 1;
      int64_t before = -1;
      for (int64_t i = 0; i < lines[d]; ++i)
        if (used[i]) {
          if (before >= 0) least = smaller(least, static_cast<double>(i - before) * stride[d] * grid.spacing[d]);
          before = i;
        }
    }
    for (int d = 0; d < D && !(least < INFINITY); ++d) gap = d ? smaller(gap, grid.spacing[d]) : grid.spacing[d];
    gap = 0.25 * (least < INFINITY ? least : gap);
    return true;
  }
};

}  // namespace echospline::ECHOSPLINE_CORE
