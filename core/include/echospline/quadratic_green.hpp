// Tissue of any regions that answers point forces: quadratic triangles, factored once.
//
// Triangles, shape functions and loads are those of `mechanics/quadratic.py`. The stiffness matrix is never put together: the rectangle is
// halved along lines of elements until a few are left, each part is eliminated but for the nodes on its outline, and what is left
// of it is added to the part that contains it (multifrontal Cholesky with nested dissection; George 1973, Duff and Reid 1983).
// A load touches the parts that contain it alone, so that the first half of a solution is nearly free.
#pragma once
#include <cmath>
#include <cstdint>

#include "boundary_green.hpp"

namespace echospline::ECHOSPLINE_CORE {

constexpr int64_t LEAF = 2;  // elements along either side of a part that is not halved further
constexpr int RING_POINTS =
    12;  // of a blob: six each on two circles that hold a quarter and three quarters of the force
constexpr double RINGS[2] = {0.393, 1.0};

/// Nodes of the triangle at a point and their shape functions.
struct SixNodes {
  int64_t node[6];
  double weight[6];
};

class QuadraticGreen {
 public:
  enum Outcome { done, no_memory, not_held };

  ECHOSPLINE_SET_UP Outcome build(const echospline_green_options& o, const GreenMesh& mesh) {
    mesh_ = &mesh, radius_ = o.radius;
    columns_ = o.line_x_count - 1, rows_ = o.line_y_count - 1, across_ = 2 * columns_ + 1;
    if (!x_.reserve(columns_ + 1) || !y_.reserve(rows_ + 1) || !held_.reserve(o.held_count) ||
        !moduli_.reserve(2 * o.triangle_count) || !at_node_.reserve(mesh.nodes()))
      return no_memory;
    for (int64_t i = 0; i <= columns_; ++i) x_[i] = o.lines_x[i];
    for (int64_t i = 0; i <= rows_; ++i) y_[i] = o.lines_y[i];
    for (int64_t i = 0; i < o.held_count; ++i) held_[i] = o.held[i];
    for (int64_t i = 0; i < 2 * o.triangle_count; ++i) moduli_[i] = o.moduli[i];
    for (int64_t i = 0; i < mesh.nodes(); ++i) at_node_[i] = locate(mesh.node(i));
    if (!parts_.reserve(4 * columns_ * rows_ + 1) || !place_.reserve(nodes())) return no_memory;
    for (int64_t i = 0; i < nodes(); ++i) place_[i] = -1;
    int64_t indices = 0, numbers = 0;
    divide(0, columns_, 0, rows_, indices, numbers);
    if (!index_.reserve(indices) || !factor_.reserve(numbers)) return no_memory;
    Array<double> whole;
    const Outcome outcome = eliminate(0, columns_, 0, rows_, whole);
    moduli_.reserve(0);
    return outcome;
  }

  int64_t nodes() const { return across_ * (2 * rows_ + 1); }
  /// Numbers of one solution.
  int64_t unknowns() const { return 2 * nodes(); }
  /// Numbers that `solve` works in.
  int64_t solve_room() const { return 2 * largest_; }

  /// Add a force to two loads, (nodes, 2).
  void add_load(const GreenForce& f, double* a, double* b) const {
    for (int k = 0; k < RING_POINTS; ++k) {
      const double angle = CIRCLE / 6 * k + (k < 6 ? 0 : CIRCLE / 12), r = radius_ * RINGS[k / 6];
      Vec<2> p = f.place + Vec<2>{{r * std::cos(angle), r * std::sin(angle)}};
      for (int d = 0; d < 2; ++d) p[d] = std::fmin(std::fmax(p[d], mesh_->low[d]), mesh_->high[d]);
      const SixNodes at = locate(p);
      for (int i = 0; i < 6; ++i)
        for (int d = 0; d < 2; ++d)
          if (const int64_t k = 2 * at.node[i] + d; !held_[k]) {
            a[k] += at.weight[i] / RING_POINTS * f.force[0][d];
            b[k] += at.weight[i] / RING_POINTS * f.force[1][d];
          }
    }
  }

  /// Turn two loads into displacements in place; room holds `solve_room` numbers.
  void solve(double* a, double* b, double* room) const {
    double* const p = room;
    double* const q = room + largest_;
    for (int64_t k = 0; k < part_count_; ++k) {  // parts stand after those that they contain
      const Part& part = parts_[k];
      const int32_t* index = index_.data() + part.index;
      bool any = false;
      for (int64_t i = 0; i < part.own && !any; ++i) any = a[index[i]] != 0 || b[index[i]] != 0;
      if (!any) continue;
      gather(part, index, a, b, p, q);
      const double* column = factor_.data() + part.factor;
      for (int64_t j = 0; j < part.own; ++j) {
        const int64_t n = part.all - j;
        const double s = p[j] *= column[0], t = q[j] *= column[0];  // the diagonal is kept as its inverse
        for (int64_t i = 1; i < n; ++i) p[j + i] -= s * column[i], q[j + i] -= t * column[i];
        column += n;
      }
      for (int64_t i = 0; i < part.all; ++i) a[index[i]] = p[i], b[index[i]] = q[i];
    }
    for (int64_t k = part_count_; k-- > 0;) {
      const Part& part = parts_[k];
      const int32_t* index = index_.data() + part.index;
      gather(part, index, a, b, p, q);
      const double* column = factor_.data() + part.factor + part.numbers;
      for (int64_t j = part.own; j-- > 0;) {
        const int64_t n = part.all - j;
        column -= n;
        double s, t;
        two_products(column + 1, p + j + 1, q + j + 1, n - 1, s, t);
        p[j] = (p[j] - s) * column[0], q[j] = (q[j] - t) * column[0];
      }
      for (int64_t i = 0; i < part.own; ++i) a[index[i]] = p[i], b[index[i]] = q[i];
    }
  }

  template <class Number>
  Vec<2> at(const SixNodes& six, const Number* solution) const {
    Vec<2> u = {};
    for (int i = 0; i < 6; ++i)
      for (int d = 0; d < 2; ++d) u[d] += six.weight[i] * static_cast<double>(solution[2 * six.node[i] + d]);
    return u;
  }
  const SixNodes& at_node(int64_t i) const { return at_node_[i]; }

  /// Triangle and shape functions at a point of the tissue.
  __attribute__((noinline)) SixNodes locate(const Vec<2>& p) const {
    const int64_t i = interval(x_, p[0]), j = interval(y_, p[1]);
    const double s = share(x_, i, p[0]), t = share(y_, j, p[1]);
    const bool turned = (i + j) % 2 == 1, second = turned ? s + t > 1 : t > s;
    double one, two;
    if (turned)
      one = second ? 1 - t : 1 - s - t, two = second ? s + t - 1 : s;
    else
      one = second ? 1 - t : 1 - s, two = second ? s : s - t;
    double L[3] = {one, two, 1 - one - two};
    for (double& l : L)
      if (std::fabs(l) < 1e-12) l = 0;  // rounding: a point on an edge has no share of the nodes off it
    SixNodes at;
    triangle(i, j, second, at.node);
    for (int k = 0; k < 3; ++k) at.weight[k] = L[k] * (2 * L[k] - 1), at.weight[3 + k] = 4 * L[k] * L[(k + 1) % 3];
    return at;
  }

 private:
  /// A part of the rectangle: nodes that are eliminated in it, then those of its outline that are not.
  struct Part {
    int64_t index, own, all, factor, numbers;  ///< unknowns, two for each node
  };

  const GreenMesh* mesh_ = nullptr;
  double radius_ = 0;
  int64_t columns_ = 0, rows_ = 0, across_ = 0, part_count_ = 0, largest_ = 0;
  Array<double> x_, y_, moduli_, factor_;
  Array<uint8_t> held_;
  Array<SixNodes> at_node_;
  Array<Part> parts_;
  Array<int32_t> index_, place_;

  static int64_t interval(const Array<double>& lines, double at) {
    int64_t low = 0, high = lines.size() - 1;
    while (high - low > 1) {
      const int64_t middle = (low + high) / 2;
      if (at >= lines[middle])
        low = middle;
      else
        high = middle;
    }
    return low;
  }
  static double share(const Array<double>& lines, int64_t i, double at) {
    return std::fmin(std::fmax((at - lines[i]) / (lines[i + 1] - lines[i]), 0.0), 1.0);
  }

  /// Nodes of a triangle: three corners, then the middles of sides 12, 23 and 31.
  void triangle(int64_t i, int64_t j, bool second, int64_t (&node)[6]) const {
    static const int corners[2][2][3][2] = {{{{0, 0}, {2, 0}, {2, 2}}, {{0, 0}, {2, 2}, {0, 2}}},
                                            {{{0, 0}, {2, 0}, {0, 2}}, {{2, 0}, {2, 2}, {0, 2}}}};
    const auto& c = corners[(i + j) % 2][second ? 1 : 0];
    for (int k = 0; k < 3; ++k) {
      const int* next = c[(k + 1) % 3];
      node[k] = (2 * j + c[k][1]) * across_ + 2 * i + c[k][0];
      node[3 + k] = (2 * j + (c[k][1] + next[1]) / 2) * across_ + 2 * i + (c[k][0] + next[0]) / 2;
    }
  }

  /// Whether a part of columns [a, b) and rows [c, d) is halved, and where.
  static bool halved(int64_t a, int64_t b, int64_t c, int64_t d) { return b - a > LEAF || d - c > LEAF; }
  static bool upright(int64_t a, int64_t b, int64_t c, int64_t d) { return b - a >= d - c; }

  /// Number the nodes of a part: `visit(node)` for those that it eliminates, then for those of its outline.
  template <class Visit>
  void visit(int64_t a, int64_t b, int64_t c, int64_t d, bool outline, Visit&& each) const {
    const int64_t left = a > 0 ? 2 * a + 1 : 0, right = b < columns_ ? 2 * b - 1 : 2 * b;
    const int64_t upper = c > 0 ? 2 * c + 1 : 0, lower = d < rows_ ? 2 * d - 1 : 2 * d;
    if (outline) {
      for (int64_t j = 2 * c; j <= 2 * d; ++j)
        for (int64_t i = 2 * a; i <= 2 * b; ++i)
          if (i < left || i > right || j < upper || j > lower) each(j * across_ + i);
    } else if (!halved(a, b, c, d)) {
      for (int64_t j = upper; j <= lower; ++j)
        for (int64_t i = left; i <= right; ++i) each(j * across_ + i);
    } else if (upright(a, b, c, d)) {
      for (int64_t j = upper; j <= lower; ++j) each(j * across_ + 2 * ((a + b) / 2));
    } else {
      for (int64_t i = left; i <= right; ++i) each(2 * ((c + d) / 2) * across_ + i);
    }
  }

  /// Count what the parts need.
  ECHOSPLINE_SET_UP void divide(int64_t a, int64_t b, int64_t c, int64_t d, int64_t& indices, int64_t& numbers) {
    if (halved(a, b, c, d)) {
      const bool up = upright(a, b, c, d);
      const int64_t middle = up ? (a + b) / 2 : (c + d) / 2;
      divide(a, up ? middle : b, c, up ? d : middle, indices, numbers);
      divide(up ? middle : a, b, up ? c : middle, d, indices, numbers);
    }
    int64_t own = 0, outline = 0;
    visit(a, b, c, d, false, [&](int64_t) { own += 2; });
    visit(a, b, c, d, true, [&](int64_t) { outline += 2; });
    const int64_t all = own + outline, count = own * all - own * (own - 1) / 2;
    parts_[part_count_++] = {indices, own, all, numbers, count};
    indices += all, numbers += count;
    largest_ = all > largest_ ? all : largest_;
  }

  /// Eliminate a part, after the two that it contains; `left` becomes what it leaves to its outline, (outline, outline) lower half by columns.
  Outcome eliminate(int64_t a, int64_t b, int64_t c, int64_t d, Array<double>& left) {
    part_count_ = 0;
    return eliminated(a, b, c, d, left);
  }
  Outcome eliminated(int64_t a, int64_t b, int64_t c, int64_t d, Array<double>& left) {
    Array<double> halves[2];
    int64_t inner[2] = {-1, -1};
    if (halved(a, b, c, d)) {
      const bool up = upright(a, b, c, d);
      const int64_t middle = up ? (a + b) / 2 : (c + d) / 2;
      Outcome outcome = eliminated(a, up ? middle : b, c, up ? d : middle, halves[0]);
      inner[0] = part_count_ - 1;
      if (outcome == done) outcome = eliminated(up ? middle : a, b, up ? c : middle, d, halves[1]);
      inner[1] = part_count_ - 1;
      if (outcome != done) return outcome;
    }
    const Part& part = parts_[part_count_++];
    int32_t* index = index_.data() + part.index;
    int64_t count = 0;
    const auto number = [&](int64_t node) {
      place_[node] = static_cast<int32_t>(count);
      for (int k = 0; k < 2; ++k) index[count++] = static_cast<int32_t>(2 * node + k);
    };
    visit(a, b, c, d, false, number);
    visit(a, b, c, d, true, number);
    const int64_t n = part.all, own = part.own;
    Array<double> front;  // lower half by columns of n numbers
    if (!front.reserve(n * n)) return no_memory;
    for (int h = 0; h < 2 && inner[h] >= 0; ++h) {
      const Part& half = parts_[inner[h]];
      const int32_t* other = index_.data() + half.index + half.own;
      const int64_t m = half.all - half.own;
      for (int64_t j = 0; j < m; ++j) {
        const int64_t column = place_[other[j] / 2] + other[j] % 2;
        for (int64_t i = j; i < m; ++i) {
          const int64_t row = place_[other[i] / 2] + other[i] % 2;
          front[row >= column ? column * n + row : row * n + column] += halves[h][j * m + i];
        }
      }
      halves[h].reserve(0);
    }
    if (inner[0] < 0)
      for (int64_t j = c; j < d; ++j)
        for (int64_t i = a; i < b; ++i)
          for (int half = 0; half < 2; ++half) add_element(i, j, half == 1, front.data(), n);
    for (int64_t j = 0; j < own; ++j)
      if (held_[index[j]]) front[j * n + j] = 1;
    for (int64_t j = 0; j < own; ++j) {
      double* column = front.data() + j * n;
      if (!(column[j] > 0)) return not_held;
      const double inverse = 1 / std::sqrt(column[j]);
      if (!std::isfinite(inverse)) return not_held;
      for (int64_t i = j + 1; i < n; ++i) column[i] *= inverse;
      column[j] = inverse;
      for (int64_t k = j + 1; k < n; ++k) {
        const double f = column[k];
        if (f == 0) continue;
        double* other = front.data() + k * n;
        for (int64_t i = k; i < n; ++i) other[i] -= f * column[i];
      }
    }
    double* to = factor_.data() + part.factor;
    for (int64_t j = 0; j < own; ++j)
      for (int64_t i = j; i < n; ++i) *to++ = front[j * n + i];
    const int64_t m = n - own;
    if (!left.reserve(m * m)) return no_memory;
    for (int64_t j = 0; j < m; ++j)
      for (int64_t i = j; i < m; ++i) left[j * m + i] = front[(own + j) * n + own + i];
    return done;
  }

  /// Add the stiffness of a triangle, by three points, which integrate it exactly.
  void add_element(int64_t i, int64_t j, bool second, double* front, int64_t n) const {
    int64_t node[6];
    triangle(i, j, second, node);
    double px[3], py[3];
    for (int k = 0; k < 3; ++k) px[k] = x_[node[k] % across_ / 2], py[k] = y_[node[k] / across_ / 2];
    const double twice = (px[1] - px[0]) * (py[2] - py[0]) - (px[2] - px[0]) * (py[1] - py[0]);
    const double* moduli = moduli_.data() + 2 * (2 * (j * columns_ + i) + (second ? 1 : 0));
    const double lam = moduli[0] * std::fabs(twice) / 6, mu = moduli[1] * std::fabs(twice) / 6;
    double slope[3][2];  // of the area coordinates
    for (int k = 0; k < 3; ++k) {
      const int next = (k + 1) % 3, last = (k + 2) % 3;
      slope[k][0] = (py[next] - py[last]) / twice, slope[k][1] = (px[last] - px[next]) / twice;
    }
    double K[12][12] = {};
    for (int point = 0; point < 3; ++point) {
      double q[3] = {2.0 / 3, 2.0 / 3, 2.0 / 3}, g[6][2];  // four times the area coordinates
      q[point] = 8.0 / 3;
      for (int k = 0; k < 3; ++k)
        for (int e = 0; e < 2; ++e) {
          const int next = (k + 1) % 3;
          g[k][e] = (q[k] - 1) * slope[k][e];
          g[3 + k][e] = q[next] * slope[k][e] + q[k] * slope[next][e];
        }
      for (int r = 0; r < 6; ++r)
        for (int s = 0; s < 6; ++s) {
          const double alike = mu * (g[r][0] * g[s][0] + g[r][1] * g[s][1]);
          for (int e = 0; e < 2; ++e)
            for (int f = 0; f < 2; ++f)
              K[2 * r + e][2 * s + f] += lam * g[r][e] * g[s][f] + mu * g[r][f] * g[s][e] + (e == f ? alike : 0);
        }
    }
    for (int r = 0; r < 12; ++r) {
      if (held_[2 * node[r / 2] + r % 2]) continue;
      const int64_t row = place_[node[r / 2]] + r % 2;
      for (int s = 0; s < 12; ++s) {
        const int64_t column = place_[node[s / 2]] + s % 2;
        if (row >= column && !held_[2 * node[s / 2] + s % 2]) front[column * n + row] += K[r][s];
      }
    }
  }

  static void gather(const Part& part, const int32_t* index, const double* a, const double* b, double* p, double* q) {
    for (int64_t i = 0; i < part.all; ++i) p[i] = a[index[i]], q[i] = b[index[i]];
  }
};

}  // namespace echospline::ECHOSPLINE_CORE
