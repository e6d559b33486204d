// The C interface of tissue in space under a needle's forces: checks what comes from outside, then calls the level of the handle.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>

#include "spatial_entries.hpp"

using echospline::Level;
using echospline::Message;

struct echospline_spatial {
  const Level* level = nullptr;
  void* self = nullptr;
  bool own_answers = false;
  Message message;
};

namespace {

constexpr double MOST_SPACINGS = 500;  // of the tissue's diagonal: a track has 512 stations at most
constexpr int64_t MOST_SOURCES = 8192, MOST_CONDITIONS = 1 << 16;
constexpr int32_t MOST_ALONG = 1024;               // points of the lattice
constexpr int64_t MOST_POINTS = int64_t{1} << 24;  // of the lattice
constexpr uint32_t FACES = 63;

template <class... Numbers>
echospline_status refuse(Message& message, echospline_status status, const char* format, Numbers... numbers) {
  std::snprintf(message.text, sizeof message.text, format, numbers...);
  return status;
}
long long wide(int64_t n) { return static_cast<long long>(n); }

bool finite(const double* v, int64_t count, double most = 1e9) {
  for (int64_t i = 0; i < count; ++i)
    if (!(std::fabs(v[i]) <= most)) return false;
  return true;
}

echospline_status check_law(const echospline_spatial_options& o, Message& m) {
  double square = 0;
  for (int d = 0; d < 3; ++d) {
    if (!(std::fabs(o.low[d]) <= 1e6 && std::fabs(o.high[d]) <= 1e6 && o.low[d] < o.high[d]))
      return refuse(m, ECHOSPLINE_WRONG_VALUE, "low must be below high along %c, both in mm, below 1e6; got %g and %g",
                    "xyz"[d], o.low[d], o.high[d]);
    square += (o.high[d] - o.low[d]) * (o.high[d] - o.low[d]);
  }
  const struct {
    const char* name;
    double value, low;
    const char* unit;
  } ranges[] = {{"tip", o.tip, 0, "N"},
                {"friction_limit", o.friction_limit, 0, "N/mm"},
                {"bond", o.bond, 1e-9, "N/mm^2"},
                {"tip_stiffness", o.tip_stiffness, 1e-9, "N/mm"},
                {"side_stiffness", o.side_stiffness, 1e-9, "N/mm^2"},
                {"viscosity", o.viscosity, 0, "N s/mm^2"},
                {"station_spacing", o.station_spacing, 1e-6, "mm"},
                {"substep", o.substep, 1e-6, "mm"},
                {"dead_band", o.dead_band, 0, "mm"}};
  for (const auto& r : ranges)
    if (!(r.value >= r.low && r.value <= 1e9))
      return refuse(m, ECHOSPLINE_WRONG_VALUE, "%s must be a number from %g to 1e+09 %s; got %g", r.name, r.low, r.unit,
                    r.value);
  const double diagonal = std::sqrt(square);
  if (diagonal > MOST_SPACINGS * o.station_spacing)
    return refuse(m, ECHOSPLINE_WRONG_VALUE,
                  "station_spacing must be %g mm or more, a %g-th of the tissue's diagonal of %g mm; got %g",
                  diagonal / MOST_SPACINGS, MOST_SPACINGS, diagonal, o.station_spacing);
  return ECHOSPLINE_OK;
}

echospline_status check_tables(const echospline_spatial_options& o, Message& m) {
  if (o.source_count < 0 || o.source_count > MOST_SOURCES)
    return refuse(m, ECHOSPLINE_WRONG_SIZE, "source_count must be from 0 to %lld; got %lld", wide(MOST_SOURCES),
                  wide(o.source_count));
  if (o.source_count == 0) return ECHOSPLINE_OK;
  if (o.condition_count < 1 || o.condition_count > MOST_CONDITIONS)
    return refuse(m, ECHOSPLINE_WRONG_SIZE, "condition_count must be from 1 to %lld; got %lld", wide(MOST_CONDITIONS),
                  wide(o.condition_count));
  if (!o.sources || !o.conditions || !o.condition_faces || !o.answers)
    return refuse(m, ECHOSPLINE_NULL_POINTER,
                  "sources, conditions, condition_faces and answers must be given; got NULL");
  if (o.top < ECHOSPLINE_TOP_NONE || o.top > ECHOSPLINE_TOP_SLIDING)
    return refuse(m, ECHOSPLINE_WRONG_VALUE, "top must be one of ECHOSPLINE_TOP_NONE (0), _FREE, _SLIDING (2); got %d",
                  o.top);
  if (o.top != ECHOSPLINE_TOP_NONE && !(std::fabs(o.low[1]) <= 1e-6))
    return refuse(m, ECHOSPLINE_WRONG_VALUE, "tissue with a surface must begin at y = 0; got %g", o.low[1]);
  if ((o.clamped | o.sliding) & ~FACES || o.clamped & o.sliding)
    return refuse(m, ECHOSPLINE_WRONG_VALUE,
                  "clamped and sliding must be bits of the six faces, none in both; got %u and %u", o.clamped,
                  o.sliding);
  if (!(o.poisson > -1 && o.poisson < 0.5))
    return refuse(m, ECHOSPLINE_WRONG_VALUE, "poisson must lie above -1 and below 0.5; got %g", o.poisson);
  const struct {
    const char* name;
    double value;
    const char* unit;
  } positive[] = {{"shear_modulus", o.shear_modulus, "N/mm^2"},
                  {"radius", o.radius, "mm"},
                  {"source_radius", o.source_radius, "mm"},
                  {"traction_length", o.traction_length, "mm"}};
  for (const auto& p : positive)
    if (!(p.value >= 1e-9 && p.value <= 1e6))
      return refuse(m, ECHOSPLINE_WRONG_VALUE, "%s must be a number from 1e-9 to 1e6 %s; got %g", p.name, p.unit,
                    p.value);
  const int64_t unknowns = 3 * o.source_count + (o.top == ECHOSPLINE_TOP_SLIDING ? 3 : 6);
  if (o.answer_count != unknowns * 3 * o.condition_count)
    return refuse(m, ECHOSPLINE_WRONG_SIZE, "answers must hold %lld x %lld numbers; got %lld", wide(unknowns),
                  wide(3 * o.condition_count), wide(o.answer_count));
  if (!finite(o.sources, 3 * o.source_count, 1e6) || !finite(o.conditions, 3 * o.condition_count, 1e6) ||
      !finite(o.answers, o.answer_count, 1e12))
    return refuse(m, ECHOSPLINE_WRONG_VALUE, "sources, conditions and answers must be finite numbers");
  for (int64_t i = 0; o.top != ECHOSPLINE_TOP_NONE && i < o.source_count; ++i)
    if (!(o.sources[3 * i + 1] > 0))
      return refuse(m, ECHOSPLINE_WRONG_VALUE, "sources must lie below the surface; number %lld is at y = %g", wide(i),
                    o.sources[3 * i + 1]);
  for (int64_t i = 0; i < o.condition_count; ++i) {
    const uint32_t face = o.condition_faces[i];
    if (face == 0 || face & ~FACES || face & (face - 1) || (face == ECHOSPLINE_TOP && o.top != ECHOSPLINE_TOP_NONE))
      return refuse(m, ECHOSPLINE_WRONG_VALUE,
                    "condition_faces must be one bit each, and no top where the closed form has a surface; number %lld "
                    "is %u",
                    wide(i), face);
  }
  int64_t points = 1;
  for (int d = 0; d < 3; ++d) {
    if (o.lattice_shape[d] < 4 || o.lattice_shape[d] > MOST_ALONG)
      return refuse(m, ECHOSPLINE_WRONG_SIZE, "lattice_shape must be from 4 to %d along %c; got %d", MOST_ALONG,
                    "xyz"[d], o.lattice_shape[d]);
    if (!(o.lattice_spacing[d] >= 1e-4 && o.lattice_spacing[d] <= 1e6 && std::fabs(o.lattice_origin[d]) <= 1e6))
      return refuse(m, ECHOSPLINE_WRONG_VALUE,
                    "lattice_spacing must be from 1e-4 to 1e6 mm and lattice_origin within 1e6 mm along %c; got %g and "
                    "%g",
                    "xyz"[d], o.lattice_spacing[d], o.lattice_origin[d]);
    points *= o.lattice_shape[d];
  }
  if (points > MOST_POINTS)
    return refuse(m, ECHOSPLINE_WRONG_SIZE, "a lattice must have %lld points at most; got %lld", wide(MOST_POINTS),
                  wide(points));
  return ECHOSPLINE_OK;
}

echospline_status say(Message& message, echospline_status status) {
  if (status == ECHOSPLINE_OUT_OF_MEMORY) return refuse(message, status, "memory ran out; the state has not changed");
  if (status == ECHOSPLINE_NOT_SOLVED)
    return refuse(message, status,
                  "the needle's forces could not be solved, and the state has not changed: the rows of the answers "
                  "must be a symmetric positive compliance in mm/N");
  if (status == ECHOSPLINE_NEEDS_STATION)
    return refuse(message, status, "the answer to a station is needed: ask echospline_spatial_wanted which");
  return status;
}

echospline_status usable(echospline_spatial* s) {
  if (!s) return ECHOSPLINE_NULL_POINTER;
  return s->self ? ECHOSPLINE_OK : ECHOSPLINE_FAILED_HANDLE;
}

}  // namespace

extern "C" {

void echospline_spatial_defaults(echospline_spatial_options* o) {
  if (!o || o->struct_size != sizeof *o) return;
  const uint32_t size = o->struct_size;
  std::memset(o, 0, sizeof *o);
  o->struct_size = size;
  o->tip = 0.4, o->friction_limit = 0.01, o->bond = 0.1, o->tip_stiffness = 2, o->side_stiffness = 1;
  o->station_spacing = 1.25, o->substep = 0.25;
  o->poisson = 0.45, o->shear_modulus = 1e-2 / 2.9, o->radius = 0.7, o->source_radius = 1e-3, o->traction_length = 10;
}

echospline_status echospline_spatial_create(const echospline_spatial_options* options, echospline_spatial** spatial) {
  if (!spatial) return ECHOSPLINE_NULL_POINTER;
  *spatial = static_cast<echospline_spatial*>(std::malloc(sizeof(echospline_spatial)));
  if (!*spatial) return ECHOSPLINE_OUT_OF_MEMORY;
  const echospline_spatial fresh;
  std::memcpy(static_cast<void*>(*spatial), &fresh, sizeof fresh);
  echospline_spatial& made = **spatial;
  if (!options) return refuse(made.message, ECHOSPLINE_NULL_POINTER, "options must be given; got NULL");
  if (options->struct_size != sizeof *options)
    return refuse(made.message, ECHOSPLINE_WRONG_SIZE,
                  "struct_size must be %u, sizeof(echospline_spatial_options); got %u",
                  static_cast<unsigned>(sizeof *options), options->struct_size);
  if (const echospline_status status = check_law(*options, made.message)) return status;
  if (const echospline_status status = check_tables(*options, made.message)) return status;
  made.level = echospline::find_level(options->level);
  if (!made.level)
    return refuse(
        made.message, ECHOSPLINE_WRONG_VALUE, "level must be one that this processor has, at most %s; got %d (%s)",
        echospline_level_name(echospline_level_best()), options->level, echospline_level_name(options->level));
  made.own_answers = options->source_count > 0;
  made.self = made.level->spatial->create(*options);
  if (!made.self) return refuse(made.message, ECHOSPLINE_OUT_OF_MEMORY, "memory ran out while the tissue was built");
  return ECHOSPLINE_OK;
}

void echospline_spatial_destroy(echospline_spatial* spatial) {
  if (!spatial) return;
  if (spatial->self) spatial->level->spatial->destroy(spatial->self);
  std::free(spatial);
}

const char* echospline_spatial_message(const echospline_spatial* spatial) {
  return spatial ? spatial->message.text : "the tissue is NULL";
}

echospline_status echospline_spatial_reset(echospline_spatial* s) {
  const echospline_status status = usable(s);
  if (status == ECHOSPLINE_OK) s->level->spatial->reset(s->self);
  return status;
}

echospline_status echospline_spatial_advance(echospline_spatial* s, const echospline_pose* pose) {
  if (const echospline_status status = usable(s)) return status;
  if (!pose) return refuse(s->message, ECHOSPLINE_NULL_POINTER, "a pose must be given; got NULL");
  if (!finite(pose->entry, 3, 1e6) || !finite(pose->tip, 3, 1e6))
    return refuse(s->message, ECHOSPLINE_WRONG_VALUE,
                  "entry and tip of a pose must be finite numbers in mm, below 1e6; got tip (%g, %g, %g)", pose->tip[0],
                  pose->tip[1], pose->tip[2]);
  if (!(pose->dt >= 0 && pose->dt <= 1e9))
    return refuse(s->message, ECHOSPLINE_WRONG_VALUE, "dt must be zero or a positive number of seconds; got %g",
                  pose->dt);
  return say(s->message, s->level->spatial->advance(s->self, *pose));
}

echospline_status echospline_spatial_wanted(echospline_spatial* s, echospline_spatial_station* station) {
  if (const echospline_status status = usable(s)) return status;
  if (!station) return refuse(s->message, ECHOSPLINE_NULL_POINTER, "a station must be given; got NULL");
  if (s->level->spatial->wanted(s->self, station) < 0)
    return refuse(s->message, ECHOSPLINE_WRONG_VALUE,
                  "a station is wanted after a call has returned ECHOSPLINE_NEEDS_STATION; none is now");
  return ECHOSPLINE_OK;
}

echospline_status echospline_spatial_answer(echospline_spatial* s, const double* rows, int64_t count) {
  if (const echospline_status status = usable(s)) return status;
  const int64_t index = s->level->spatial->wanted(s->self, nullptr);
  if (index < 0)
    return refuse(s->message, ECHOSPLINE_WRONG_VALUE,
                  "an answer is taken after a call has returned ECHOSPLINE_NEEDS_STATION; none is wanted now");
  if (!rows) return refuse(s->message, ECHOSPLINE_NULL_POINTER, "rows must be given; got NULL");
  if (count != 9 * (index + 1))
    return refuse(s->message, ECHOSPLINE_WRONG_SIZE, "rows must hold %lld numbers; got %lld", wide(9 * (index + 1)),
                  wide(count));
  if (!finite(rows, count))
    return refuse(s->message, ECHOSPLINE_WRONG_VALUE, "rows must be finite numbers in mm/N, below 1e9");
  return say(s->message, s->level->spatial->answer(s->self, rows));
}

echospline_status echospline_spatial_needle(echospline_spatial* s, echospline_spatial_load* load) {
  if (const echospline_status status = usable(s)) return status;
  if (!load) return refuse(s->message, ECHOSPLINE_NULL_POINTER, "a load must be given; got NULL");
  s->level->spatial->load(s->self, *load);
  return ECHOSPLINE_OK;
}

echospline_status echospline_spatial_forces(echospline_spatial* s, double* forces, int64_t room, int64_t* count) {
  if (const echospline_status status = usable(s)) return status;
  if (!count || (room > 0 && !forces))
    return refuse(s->message, ECHOSPLINE_NULL_POINTER,
                  "count, and forces where there is room, must be given; got NULL");
  *count = s->level->spatial->forces(s->self, forces, forces ? room : -1);
  return ECHOSPLINE_OK;
}

echospline_status echospline_spatial_stations(echospline_spatial* s, echospline_spatial_station* stations, int64_t room,
                                              int64_t* count) {
  if (const echospline_status status = usable(s)) return status;
  if (!count || (room > 0 && !stations))
    return refuse(s->message, ECHOSPLINE_NULL_POINTER,
                  "count, and stations where there is room, must be given; got NULL");
  *count = s->level->spatial->stations(s->self, stations, room);
  return ECHOSPLINE_OK;
}

echospline_status echospline_spatial_field(echospline_spatial* s, echospline_force_field* field) {
  if (const echospline_status status = usable(s)) return status;
  if (!field) return refuse(s->message, ECHOSPLINE_NULL_POINTER, "a field must be given; got NULL");
  if (field->struct_size != sizeof *field)
    return refuse(s->message, ECHOSPLINE_WRONG_SIZE, "struct_size of the field must be %u; got %u",
                  static_cast<unsigned>(sizeof *field), field->struct_size);
  if (!s->own_answers)
    return refuse(s->message, ECHOSPLINE_WRONG_VALUE,
                  "a field is known where the core answers; this tissue was created without sources");
  return say(s->message, s->level->spatial->field(s->self, *field));
}

int64_t echospline_spatial_state_size(const echospline_spatial* s) {
  return s && s->self ? s->level->spatial->state_size(s->self) : 0;
}

echospline_status echospline_spatial_state_save(echospline_spatial* s, void* bytes, int64_t size) {
  if (const echospline_status status = usable(s)) return status;
  const int64_t needed = s->level->spatial->state_size(s->self);
  if (!bytes || size < needed)
    return refuse(s->message, bytes ? ECHOSPLINE_WRONG_SIZE : ECHOSPLINE_NULL_POINTER,
                  "bytes must have room for the state, %lld; got room for %lld", wide(needed), wide(bytes ? size : 0));
  s->level->spatial->state_save(s->self, bytes);
  return ECHOSPLINE_OK;
}

echospline_status echospline_spatial_state_load(echospline_spatial* s, const void* bytes, int64_t size) {
  if (const echospline_status status = usable(s)) return status;
  if (!bytes) return refuse(s->message, ECHOSPLINE_NULL_POINTER, "bytes must be given; got NULL");
  return say(s->message, s->level->spatial->state_load(s->self, bytes, size, s->message));
}

}  // extern "C"
