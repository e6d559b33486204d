// The C interface of Green's function: checks what comes from outside, then calls the level of the handle.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>

#include "force_handle.hpp"
#include "green_entries.hpp"

using echospline::Level;
using echospline::Message;

struct echospline_green {
  const Level* level = nullptr;
  void* self = nullptr;
  int64_t nodes = 0;
  double low[2] = {}, high[2] = {};
  Message message;
};

namespace {

constexpr double LARGEST = 1e9;
constexpr int64_t MOST_NODES = int64_t{1} << 22;  // of the mesh
constexpr int64_t MOST_UNKNOWNS = 4096;           // of the least squares
constexpr int64_t MOST_CONDITIONS = 1 << 16;
constexpr int64_t MOST_NUMBERS = 1 << 24;  // of the least squares
constexpr int64_t MOST_TRIANGLES = int64_t{1} << 19;
constexpr int64_t MOST_CASES = 1 << 16;

template <class... Numbers>
echospline_status refuse(Message& message, echospline_status status, const char* format, Numbers... numbers) {
  std::snprintf(message.text, sizeof message.text, format, numbers...);
  return status;
}
long long wide(int64_t n) { return static_cast<long long>(n); }

/// A table of `count` times `width` finite numbers that has to be there if count is not 0.
echospline_status check_table(Message& m, const char* name, const double* table, int64_t count, int64_t width,
                              int64_t most) {
  if (!(count >= 0 && count <= most))
    return refuse(m, ECHOSPLINE_WRONG_SIZE, "%s must have from 0 to %lld entries; got %lld", name, wide(most),
                  wide(count));
  if (count && !table)
    return refuse(m, ECHOSPLINE_NULL_POINTER, "%s must be given, %lld entries; got NULL", name, wide(count));
  for (int64_t i = 0; i < count * width; ++i)
    if (!(std::fabs(table[i]) <= LARGEST))
      return refuse(m, ECHOSPLINE_WRONG_VALUE, "%s must be finite numbers below 1e9; number %lld is %g", name, wide(i),
                    table[i]);
  return ECHOSPLINE_OK;
}

echospline_status check_ascending(Message& m, const char* name, const double* lines, int64_t count, double low,
                                  double high) {
  const double slack = 1e-9 * (std::fabs(low) + std::fabs(high));
  for (int64_t i = 1; i < count; ++i)
    if (!(lines[i] > lines[i - 1]))
      return refuse(m, ECHOSPLINE_WRONG_VALUE, "%s must ascend; entry %lld is %g after %g", name, wide(i), lines[i],
                    lines[i - 1]);
  if (!(std::fabs(lines[0] - low) <= slack && std::fabs(lines[count - 1] - high) <= slack))
    return refuse(m, ECHOSPLINE_WRONG_VALUE, "%s must reach from %g to %g mm, as the mesh; got %g to %g", name, low,
                  high, lines[0], lines[count - 1]);
  return ECHOSPLINE_OK;
}

echospline_status check_mesh(const echospline_green_options& o, echospline_green& g) {
  Message& m = g.message;
  constexpr uint32_t EDGES = ECHOSPLINE_LEFT | ECHOSPLINE_RIGHT | ECHOSPLINE_TOP | ECHOSPLINE_BOTTOM;
  if (o.method != ECHOSPLINE_GREEN_BOUNDARY && o.method != ECHOSPLINE_GREEN_SOLVE)
    return refuse(m, ECHOSPLINE_WRONG_VALUE,
                  "method must be ECHOSPLINE_GREEN_BOUNDARY (0) or ECHOSPLINE_GREEN_SOLVE (1); got %d", o.method);
  if ((o.clamped | o.sliding) & ~EDGES || o.clamped & o.sliding)
    return refuse(m, ECHOSPLINE_WRONG_VALUE,
                  "clamped and sliding must be bits of the four edges, none in both; got %u and %u", o.clamped,
                  o.sliding);
  for (int d = 0; d < 2; ++d) {
    if (!(o.shape[d] >= 2 && o.shape[d] <= MOST_NODES))
      return refuse(m, ECHOSPLINE_WRONG_SIZE, "shape must be 2 nodes or more along %c; got %d", "xy"[d], o.shape[d]);
    if (!(o.spacing[d] >= 1e-6 && o.spacing[d] <= 1e6 && std::fabs(o.origin[d]) <= 1e6))
      return refuse(m, ECHOSPLINE_WRONG_VALUE,
                    "spacing must be from 1e-6 to 1e6 mm and origin within 1e6 mm along %c; got %g and %g", "xy"[d],
                    o.spacing[d], o.origin[d]);
    g.low[d] = o.origin[d], g.high[d] = o.origin[d] + o.spacing[d] * (o.shape[d] - 1);
  }
  g.nodes = static_cast<int64_t>(o.shape[0]) * o.shape[1];
  if (g.nodes > MOST_NODES)
    return refuse(m, ECHOSPLINE_WRONG_SIZE, "a mesh must have %lld nodes at most; got %lld", wide(MOST_NODES),
                  wide(g.nodes));
  if (!(o.radius >= 1e-6 && o.radius <= 1e6))
    return refuse(m, ECHOSPLINE_WRONG_VALUE, "radius of a force must be from 1e-6 to 1e6 mm; got %g", o.radius);
  return ECHOSPLINE_OK;
}

bool inside(const echospline_green& g, const double* p) {
  const double width = g.high[0] - g.low[0], height = g.high[1] - g.low[1];
  const double slack = 1e-9 * (width > height ? width : height);
  for (int d = 0; d < 2; ++d)
    if (!(p[d] >= g.low[d] - slack && p[d] <= g.high[d] + slack)) return false;
  return true;
}

/// Points of the tissue.
echospline_status check_points(const echospline_green& g, Message& m, const char* name, const double* points,
                               int64_t count) {
  if (!(count >= 0 && count <= int64_t{1} << 40))
    return refuse(m, ECHOSPLINE_WRONG_SIZE, "the number of %s must be zero or more; got %lld", name, wide(count));
  if (count && !points) return refuse(m, ECHOSPLINE_NULL_POINTER, "%s must be given; got NULL", name);
  for (int64_t i = 0; i < count; ++i)
    if (!inside(g, points + 2 * i))
      return refuse(m, ECHOSPLINE_WRONG_VALUE,
                    "%s must lie in the tissue, x %g to %g mm and y %g to %g mm; got (%g, %g)", name, g.low[0],
                    g.high[0], g.low[1], g.high[1], points[2 * i], points[2 * i + 1]);
  return ECHOSPLINE_OK;
}

echospline_status check_boundary(const echospline_green_options& o, echospline_green& g) {
  Message& m = g.message;
  const int64_t rounds = o.body_count - o.band_count;
  if (!(o.band_count >= 1 && rounds >= 0 && o.body_count <= MOST_UNKNOWNS))
    return refuse(m, ECHOSPLINE_WRONG_SIZE,
                  "band_count must be from 1 to body_count, and that at most %lld; got %lld and %lld",
                  wide(MOST_UNKNOWNS), wide(o.band_count), wide(o.body_count));
  const struct {
    const char* name;
    const double* table;
    int64_t count, width, most;
  } tables[] = {{"bodies", o.bodies, o.body_count, 2, MOST_UNKNOWNS},
                {"depths", o.depths, o.band_count + 1, 1, MOST_UNKNOWNS + 1},
                {"circles", o.circles, rounds, 3, MOST_UNKNOWNS},
                {"sources", o.sources, o.source_count, 2, MOST_UNKNOWNS / 2},
                {"conditions", o.conditions, o.condition_count, 4, MOST_CONDITIONS}};
  for (const auto& t : tables)
    if (const echospline_status status = check_table(m, t.name, t.table, t.count, t.width, t.most)) return status;
  if (!o.source_counts || (o.condition_count && !o.sides) || (o.rank > 0 && !o.order))
    return refuse(m, ECHOSPLINE_NULL_POINTER, "source_counts, sides and order must be given; got NULL");
  if (!o.left != !o.right) return refuse(m, ECHOSPLINE_NULL_POINTER, "right and left must be given both, or neither");
  if (!(o.weight > 0 && o.weight <= LARGEST && o.pin_weight > 0 && o.pin_weight <= LARGEST && o.lattice >= 0 &&
        o.lattice <= LARGEST && (o.pin_count == 0 || (o.pin_radius >= 1e-6 && o.pin_radius <= LARGEST))))
    return refuse(m, ECHOSPLINE_WRONG_VALUE,
                  "weight, pin_weight and pin_radius must be positive and lattice zero or more; got %g, %g, %g and %g",
                  o.weight, o.pin_weight, o.pin_radius, o.lattice);
  if (o.lattice > 0 && o.lattice < 1e-3 * (g.high[0] - g.low[0] + g.high[1] - g.low[1]))
    return refuse(m, ECHOSPLINE_WRONG_VALUE, "lattice must be 0 or a thousandth of the tissue or more; got %g",
                  o.lattice);
  if (const echospline_status status = check_points(g, m, "pins", o.pins, o.pin_count)) return status;
  if (o.pin_count > MOST_UNKNOWNS / 2)
    return refuse(m, ECHOSPLINE_WRONG_SIZE, "pins must be %lld at most; got %lld", wide(MOST_UNKNOWNS / 2),
                  wide(o.pin_count));
  if (const echospline_status status = check_ascending(m, "depths", o.depths, o.band_count + 1, g.low[1], g.high[1]))
    return status;
  int64_t sources = 0, unknowns = 2 * o.pin_count, rows = 2 * o.pin_count;
  for (int64_t q = 0; q < o.body_count; ++q) {
    if (!(o.bodies[2 * q] > -1 && o.bodies[2 * q] < 0.5 && o.bodies[2 * q + 1] > 0))
      return refuse(m, ECHOSPLINE_WRONG_VALUE,
                    "a body must have Poisson's ratio above -1 and below 0.5 and a positive stiffness; got %g and %g",
                    o.bodies[2 * q], o.bodies[2 * q + 1]);
    if (o.source_counts[q] < 0 || o.source_counts[q] > o.source_count)
      return refuse(m, ECHOSPLINE_WRONG_SIZE, "source_counts must be from 0 to source_count; got %d",
                    o.source_counts[q]);
    sources += o.source_counts[q];
    const bool image = q == 0 && !(o.clamped & ECHOSPLINE_TOP);
    unknowns += 2 * o.source_counts[q] + (image && o.sliding & ECHOSPLINE_TOP ? 1 : 3);
  }
  if (sources != o.source_count || unknowns > MOST_UNKNOWNS)
    return refuse(m, ECHOSPLINE_WRONG_SIZE,
                  "source_counts must add up to source_count and make %lld unknowns at most; got %lld of %lld and %lld",
                  wide(MOST_UNKNOWNS), wide(sources), wide(o.source_count), wide(unknowns));
  for (int64_t i = 0; i < o.condition_count; ++i) {
    const int32_t kind = o.sides[3 * i], body = o.sides[3 * i + 1], other = o.sides[3 * i + 2];
    const bool interface = kind == ECHOSPLINE_CONDITION_INTERFACE;
    if (!(kind >= 0 && kind <= ECHOSPLINE_CONDITION_INTERFACE && body >= 0 && body < o.body_count &&
          (interface ? other >= 0 && other < o.body_count && other != body : other == -1)))
      return refuse(m, ECHOSPLINE_WRONG_VALUE,
                    "sides must be a kind, a body and -1 or at an interface another body; entry %lld is %d, %d, %d",
                    wide(i), kind, body, other);
    rows += interface ? 4 : 2;
  }
  if (!(o.rank >= 1 && o.rank <= unknowns && o.rank <= rows))
    return refuse(m, ECHOSPLINE_WRONG_SIZE,
                  "rank must be from 1 to %lld, the unknowns, and at most %lld, the conditions; got %lld",
                  wide(unknowns), wide(rows), wide(o.rank));
  if (unknowns * rows > MOST_NUMBERS)
    return refuse(m, ECHOSPLINE_WRONG_SIZE,
                  "unknowns times conditions must be %lld at most, for they are factored; got %lld times %lld",
                  wide(MOST_NUMBERS), wide(unknowns), wide(rows));
  bool seen[MOST_UNKNOWNS] = {};
  for (int64_t i = 0; i < o.rank; ++i) {
    const int32_t j = o.order[i];
    if (j < 0 || j >= unknowns || seen[j])
      return refuse(m, ECHOSPLINE_WRONG_VALUE, "order must be different unknowns below %lld; entry %lld is %d",
                    wide(unknowns), wide(i), j);
    seen[j] = true;
  }
  if (!o.left) return ECHOSPLINE_OK;
  for (int k = 0; k < 2; ++k) {
    const double* table = k == 0 ? o.right : o.left;
    for (int64_t i = 0; i < o.rank * (k == 0 ? unknowns : rows); ++i)
      if (!(std::fabs(table[i]) <= 1e18))
        return refuse(m, ECHOSPLINE_WRONG_VALUE, "right and left must be finite numbers; number %lld of %s is not",
                      wide(i), k == 0 ? "right" : "left");
  }
  return ECHOSPLINE_OK;
}

echospline_status check_solve(const echospline_green_options& o, echospline_green& g) {
  Message& m = g.message;
  const int64_t along[2] = {o.line_x_count, o.line_y_count};
  for (int d = 0; d < 2; ++d) {
    const char* name = d == 0 ? "lines_x" : "lines_y";
    const double* lines = d == 0 ? o.lines_x : o.lines_y;
    if (along[d] < 2)
      return refuse(m, ECHOSPLINE_WRONG_SIZE, "%s must have 2 entries or more; got %lld", name, wide(along[d]));
    if (const echospline_status status = check_table(m, name, lines, along[d], 1, MOST_TRIANGLES)) return status;
    if (const echospline_status status = check_ascending(m, name, lines, along[d], g.low[d], g.high[d])) return status;
  }
  const int64_t triangles = 2 * (along[0] - 1) * (along[1] - 1);
  const int64_t held = 2 * (2 * along[0] - 1) * (2 * along[1] - 1);
  if (triangles > MOST_TRIANGLES || o.triangle_count != triangles || o.held_count != held)
    return refuse(
        m, ECHOSPLINE_WRONG_SIZE,
        "these lines make %lld triangles, of %lld at most, and %lld components that may be held; got %lld and %lld",
        wide(triangles), wide(MOST_TRIANGLES), wide(held), wide(o.triangle_count), wide(o.held_count));
  if (const echospline_status status = check_table(m, "moduli", o.moduli, triangles, 2, MOST_TRIANGLES)) return status;
  if (!o.held) return refuse(m, ECHOSPLINE_NULL_POINTER, "held must be given; got NULL");
  return ECHOSPLINE_OK;
}

echospline_status usable(const echospline_green* g) {
  if (!g) return ECHOSPLINE_NULL_POINTER;
  return g->self ? ECHOSPLINE_OK : ECHOSPLINE_FAILED_HANDLE;
}

}  // namespace

extern "C" {

void echospline_green_defaults(echospline_green_options* o) {
  if (!o || o->struct_size != sizeof *o) return;
  std::memset(o, 0, sizeof *o);
  o->struct_size = sizeof *o;
}

echospline_status echospline_green_create(const echospline_green_options* options, echospline_green** green) {
  if (!green) return ECHOSPLINE_NULL_POINTER;
  *green = static_cast<echospline_green*>(std::malloc(sizeof(echospline_green)));
  if (!*green) return ECHOSPLINE_OUT_OF_MEMORY;
  const echospline_green fresh;
  std::memcpy(static_cast<void*>(*green), &fresh, sizeof fresh);
  echospline_green& made = **green;
  if (!options) return refuse(made.message, ECHOSPLINE_NULL_POINTER, "options must be given; got NULL");
  if (options->struct_size != sizeof *options)
    return refuse(made.message, ECHOSPLINE_WRONG_SIZE,
                  "struct_size must be %u, sizeof(echospline_green_options); got %u",
                  static_cast<unsigned>(sizeof *options), options->struct_size);
  echospline_status status = check_mesh(*options, made);
  if (status == ECHOSPLINE_OK)
    status = options->method == ECHOSPLINE_GREEN_SOLVE ? check_solve(*options, made) : check_boundary(*options, made);
  if (status != ECHOSPLINE_OK) return status;
  made.level = echospline::find_level(options->level);
  if (!made.level)
    return refuse(
        made.message, ECHOSPLINE_WRONG_VALUE, "level must be one that this processor has, at most %s; got %d (%s)",
        echospline_level_name(echospline_level_best()), options->level, echospline_level_name(options->level));
  status = made.level->green->create(*options, &made.self);
  if (status == ECHOSPLINE_NOT_HELD)
    return refuse(
        made.message, status,
        "the tissue must be held such that it cannot move as a whole, by moduli above zero; its stiffness is not "
        "positive: check moduli, clamped and sliding edges");
  if (status != ECHOSPLINE_OK) return refuse(made.message, status, "memory ran out while the tissue was factored");
  return ECHOSPLINE_OK;
}

void echospline_green_destroy(echospline_green* green) {
  if (!green) return;
  if (green->self) green->level->green->destroy(green->self);
  std::free(green);
}

const char* echospline_green_message(const echospline_green* green) {
  return green ? green->message.text : "the green is NULL";
}

echospline_status echospline_green_answer(echospline_green* g, const double* places, int64_t place_count,
                                          const double* forces, int64_t case_count, const double* points,
                                          int64_t point_count, double* mesh, int64_t mesh_count, double* at,
                                          int64_t at_count) {
  if (const echospline_status status = usable(g)) return status;
  if (const echospline_status status = check_points(*g, g->message, "places of forces", places, place_count))
    return status;
  if (const echospline_status status = check_points(*g, g->message, "points", points, point_count)) return status;
  if (!(case_count >= 0 && case_count <= MOST_CASES))
    return refuse(g->message, ECHOSPLINE_WRONG_SIZE, "case_count must be from 0 to %lld; got %lld", wide(MOST_CASES),
                  wide(case_count));
  const int64_t numbers = 2 * place_count * case_count;
  if (numbers && !forces) return refuse(g->message, ECHOSPLINE_NULL_POINTER, "forces must be given; got NULL");
  for (int64_t i = 0; i < numbers; ++i)
    if (!(std::fabs(forces[i]) <= LARGEST))
      return refuse(g->message, ECHOSPLINE_WRONG_VALUE,
                    "forces must be finite numbers in N, below 1e9; number %lld is not", wide(i));
  const int64_t needed[2] = {2 * g->nodes * case_count, 2 * point_count * case_count};
  if ((mesh && mesh_count < needed[0]) || (at && at_count < needed[1]))
    return refuse(g->message, ECHOSPLINE_WRONG_SIZE,
                  "mesh must have room for %lld numbers and at for %lld; got %lld and %lld", wide(needed[0]),
                  wide(needed[1]), wide(mesh_count), wide(at_count));
  if (!g->level->green->answer(g->self, places, place_count, forces, case_count, points, point_count, mesh, at))
    return refuse(g->message, ECHOSPLINE_OUT_OF_MEMORY, "memory ran out while forces were answered");
  return ECHOSPLINE_OK;
}

echospline_status echospline_forced_attach(echospline_forced* f, const echospline_green* g) {
  if (!f) return ECHOSPLINE_NULL_POINTER;
  if (!f->self) return ECHOSPLINE_FAILED_HANDLE;
  if (g && !g->self)
    return refuse(f->message, ECHOSPLINE_FAILED_HANDLE, "a green must be one whose create succeeded; it said: %.300s",
                  g->message.text);
  if (g) {
    bool same = g->nodes == f->nodes;
    for (int d = 0; d < 2; ++d) {
      const double slack = 1e-9 * (g->high[d] - g->low[d]);
      same = same && std::fabs(g->low[d] - f->low[d]) <= slack && std::fabs(g->high[d] - f->high[d]) <= slack;
    }
    if (!same)
      return refuse(
          f->message, ECHOSPLINE_WRONG_VALUE,
          "a green must have the node_count, low and high of the forced tissue; got %lld nodes in (%g, %g) to (%g, %g)",
          wide(g->nodes), g->low[0], g->low[1], g->high[0], g->high[1]);
    if (g->level != f->level)
      return refuse(f->message, ECHOSPLINE_WRONG_VALUE, "a green must have the level of the forced tissue, %s; got %s",
                    echospline_level_name(f->level->id), echospline_level_name(g->level->id));
  }
  if (!f->level->green->attach(f->self, g ? g->self : nullptr))
    return refuse(f->message, ECHOSPLINE_OUT_OF_MEMORY, "memory ran out; nothing is attached anew");
  f->attached = g != nullptr;
  return ECHOSPLINE_OK;
}

echospline_status echospline_forced_displacement_at(echospline_forced* f, const double* points, int64_t point_count,
                                                    double* displacement) {
  if (!f) return ECHOSPLINE_NULL_POINTER;
  if (!f->self) return ECHOSPLINE_FAILED_HANDLE;
  if (!f->attached)
    return refuse(f->message, ECHOSPLINE_WRONG_VALUE,
                  "displacement at points needs a green that answers the tissue: call echospline_forced_attach");
  echospline_green extent;
  for (int d = 0; d < 2; ++d) extent.low[d] = f->low[d], extent.high[d] = f->high[d];
  if (const echospline_status status = check_points(extent, f->message, "points", points, point_count)) return status;
  if (point_count && !displacement)
    return refuse(f->message, ECHOSPLINE_NULL_POINTER, "displacement must be given; got NULL");
  const echospline_status status = f->level->green->displacement_at(f->self, points, point_count, displacement);
  if (status != ECHOSPLINE_OK) return refuse(f->message, status, "memory ran out; the state has not changed");
  return ECHOSPLINE_OK;
}

}  // extern "C"
