// The C interface of tissue under a needle's forces: checks what comes from outside, then calls the level of the handle.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>

#include "force_handle.hpp"

using echospline::Level;
using echospline::Message;

namespace {

constexpr int64_t MOST_NODES = int64_t{1} << 27;
constexpr double MOST_SPACINGS = 500;  // of the tissue's diagonal: a track has 512 stations at most

template <class... Numbers>
echospline_status refuse(Message& message, echospline_status status, const char* format, Numbers... numbers) {
  std::snprintf(message.text, sizeof message.text, format, numbers...);
  return status;
}

echospline_status check(const echospline_forced_options& o, Message& m) {
  if (!(o.node_count >= 1 && o.node_count <= MOST_NODES))
    return refuse(m, ECHOSPLINE_WRONG_SIZE, "node_count must be from 1 to %lld; got %lld",
                  static_cast<long long>(MOST_NODES), static_cast<long long>(o.node_count));
  for (int d = 0; d < 2; ++d)
    if (!(std::fabs(o.low[d]) <= 1e9 && std::fabs(o.high[d]) <= 1e9 && o.low[d] < o.high[d]))
      return refuse(m, ECHOSPLINE_WRONG_VALUE, "low must be below high along %c, both in mm, below 1e9; got %g and %g",
                    "xy"[d], o.low[d], o.high[d]);
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
  const double diagonal = std::hypot(o.high[0] - o.low[0], o.high[1] - o.low[1]);
  if (diagonal > MOST_SPACINGS * o.station_spacing)
    return refuse(m, ECHOSPLINE_WRONG_VALUE,
                  "station_spacing must be %g mm or more, a %g-th of the tissue's diagonal of %g mm; got %g",
                  diagonal / MOST_SPACINGS, MOST_SPACINGS, diagonal, o.station_spacing);
  return ECHOSPLINE_OK;
}

bool finite(const double* v, int64_t count) {
  for (int64_t i = 0; i < count; ++i)
    if (!(std::fabs(v[i]) <= 1e9)) return false;
  return true;
}

echospline_status say(Message& message, echospline_status status) {
  if (status == ECHOSPLINE_OUT_OF_MEMORY) return refuse(message, status, "memory ran out; the state has not changed");
  if (status == ECHOSPLINE_NOT_SOLVED)
    return refuse(message, status,
                  "the needle's forces could not be solved, and the state has not changed: the rows of the answers "
                  "must be a symmetric "
                  "positive compliance in mm/N");
  if (status == ECHOSPLINE_NEEDS_STATION)
    return refuse(message, status, "the answer to a station is needed: ask echospline_forced_wanted which");
  return status;
}

echospline_status usable(echospline_forced* f) {
  if (!f) return ECHOSPLINE_NULL_POINTER;
  return f->self ? ECHOSPLINE_OK : ECHOSPLINE_FAILED_HANDLE;
}

echospline_status room_for(Message& message, const void* out, int64_t room, int64_t needed) {
  if (!out)
    return refuse(message, ECHOSPLINE_NULL_POINTER, "an array for %lld numbers must be given; got NULL",
                  static_cast<long long>(needed));
  if (room < needed)
    return refuse(message, ECHOSPLINE_WRONG_SIZE, "the array must have room for %lld numbers; got room for %lld",
                  static_cast<long long>(needed), static_cast<long long>(room));
  return ECHOSPLINE_OK;
}

}  // namespace

extern "C" {

void echospline_forced_defaults(echospline_forced_options* o) {
  if (!o || o->struct_size != sizeof *o) return;
  const uint32_t size = o->struct_size;
  std::memset(o, 0, sizeof *o);
  o->struct_size = size;
  o->tip = 0.4, o->friction_limit = 0.01, o->bond = 0.1, o->tip_stiffness = 2, o->side_stiffness = 1;
  o->station_spacing = 1.25, o->substep = 0.25;
}

echospline_status echospline_forced_create(const echospline_forced_options* options, echospline_forced** forced) {
  if (!forced) return ECHOSPLINE_NULL_POINTER;
  *forced = static_cast<echospline_forced*>(std::malloc(sizeof(echospline_forced)));
  if (!*forced) return ECHOSPLINE_OUT_OF_MEMORY;
  const echospline_forced fresh;
  std::memcpy(static_cast<void*>(*forced), &fresh, sizeof fresh);
  echospline_forced& made = **forced;
  if (!options) return refuse(made.message, ECHOSPLINE_NULL_POINTER, "options must be given; got NULL");
  if (options->struct_size != sizeof *options)
    return refuse(made.message, ECHOSPLINE_WRONG_SIZE,
                  "struct_size must be %u, sizeof(echospline_forced_options); got %u",
                  static_cast<unsigned>(sizeof *options), options->struct_size);
  const echospline_status status = check(*options, made.message);
  if (status != ECHOSPLINE_OK) return status;
  made.level = echospline::find_level(options->level);
  if (!made.level)
    return refuse(
        made.message, ECHOSPLINE_WRONG_VALUE, "level must be one that this processor has, at most %s; got %d (%s)",
        echospline_level_name(echospline_level_best()), options->level, echospline_level_name(options->level));
  made.nodes = options->node_count;
  for (int d = 0; d < 2; ++d) made.low[d] = options->low[d], made.high[d] = options->high[d];
  made.self = made.level->force->create(*options);
  if (!made.self) return refuse(made.message, ECHOSPLINE_OUT_OF_MEMORY, "memory ran out while the tissue was built");
  return ECHOSPLINE_OK;
}

void echospline_forced_destroy(echospline_forced* forced) {
  if (!forced) return;
  if (forced->self) forced->level->force->destroy(forced->self);
  std::free(forced);
}

const char* echospline_forced_message(const echospline_forced* forced) {
  return forced ? forced->message.text : "the forced tissue is NULL";
}

echospline_status echospline_forced_reset(echospline_forced* f) {
  const echospline_status status = usable(f);
  if (status == ECHOSPLINE_OK) f->level->force->reset(f->self);
  return status;
}

echospline_status echospline_forced_advance(echospline_forced* f, const echospline_pose* pose) {
  const echospline_status status = usable(f);
  if (status != ECHOSPLINE_OK) return status;
  if (!pose) return refuse(f->message, ECHOSPLINE_NULL_POINTER, "a pose must be given; got NULL");
  if (!finite(pose->entry, 2) || !finite(pose->tip, 2))
    return refuse(f->message, ECHOSPLINE_WRONG_VALUE,
                  "entry and tip of a pose must be finite numbers in mm, below 1e9; got tip (%g, %g)", pose->tip[0],
                  pose->tip[1]);
  if (!(pose->dt >= 0 && pose->dt <= 1e9))
    return refuse(f->message, ECHOSPLINE_WRONG_VALUE, "dt must be zero or a positive number of seconds; got %g",
                  pose->dt);
  return say(f->message, f->level->force->advance(f->self, *pose));
}

echospline_status echospline_forced_wanted(echospline_forced* f, echospline_station* station) {
  const echospline_status status = usable(f);
  if (status != ECHOSPLINE_OK) return status;
  if (!station) return refuse(f->message, ECHOSPLINE_NULL_POINTER, "a station must be given; got NULL");
  if (f->level->force->wanted(f->self, station) < 0)
    return refuse(f->message, ECHOSPLINE_WRONG_VALUE,
                  "a station is wanted after a call has returned ECHOSPLINE_NEEDS_STATION; none is now");
  return ECHOSPLINE_OK;
}

echospline_status echospline_forced_stations(echospline_forced* f, echospline_station* stations, int64_t room,
                                             int64_t* count) {
  const echospline_status status = usable(f);
  if (status != ECHOSPLINE_OK) return status;
  if (!count || (room > 0 && !stations))
    return refuse(f->message, ECHOSPLINE_NULL_POINTER,
                  "count, and stations where there is room, must be given; got NULL");
  *count = f->level->force->stations(f->self, stations, room);
  return ECHOSPLINE_OK;
}

echospline_status echospline_forced_answer(echospline_forced* f, const float* columns, int64_t count,
                                           const double* rows, int64_t row_count) {
  echospline_status status = usable(f);
  if (status != ECHOSPLINE_OK) return status;
  const int64_t index = f->level->force->wanted(f->self, nullptr);
  if (index < 0)
    return refuse(f->message, ECHOSPLINE_WRONG_VALUE,
                  "an answer is taken after a call has returned ECHOSPLINE_NEEDS_STATION; none is wanted now");
  const bool outside = f->level->force->wanted_points(f->self) == 0 && count == 0;
  if (!outside) {
    status = room_for(f->message, columns, count, 4 * f->nodes);
    if (status != ECHOSPLINE_OK) return status;
    for (int64_t i = 0; i < 4 * f->nodes; ++i)
      if (!(std::fabs(columns[i]) <= 1e9f))
        return refuse(f->message, ECHOSPLINE_WRONG_VALUE,
                      "columns must be finite numbers in mm/N, below 1e9; number %lld is not",
                      static_cast<long long>(i));
  }
  status = room_for(f->message, rows, row_count, 4 * (index + 1));
  if (status != ECHOSPLINE_OK) return status;
  if (!finite(rows, 4 * (index + 1)))
    return refuse(f->message, ECHOSPLINE_WRONG_VALUE, "rows must be finite numbers in mm/N, below 1e9");
  return say(f->message, f->level->force->answer(f->self, outside ? nullptr : columns, rows));
}

echospline_status echospline_forced_load(echospline_forced* f, echospline_needle_load* load) {
  const echospline_status status = usable(f);
  if (status != ECHOSPLINE_OK) return status;
  if (!load) return refuse(f->message, ECHOSPLINE_NULL_POINTER, "a load must be given; got NULL");
  f->level->force->load(f->self, *load);
  return ECHOSPLINE_OK;
}

echospline_status echospline_forced_forces(echospline_forced* f, double* forces, int64_t room, int64_t* count) {
  const echospline_status status = usable(f);
  if (status != ECHOSPLINE_OK) return status;
  if (!count || (room > 0 && !forces))
    return refuse(f->message, ECHOSPLINE_NULL_POINTER,
                  "count, and forces where there is room, must be given; got NULL");
  *count = f->level->force->forces(f->self, forces, forces ? room : -1);
  return ECHOSPLINE_OK;
}

echospline_status echospline_forced_displacement(echospline_forced* f, double* displacement, int64_t count) {
  echospline_status status = usable(f);
  if (status != ECHOSPLINE_OK) return status;
  status = room_for(f->message, displacement, count, 2 * f->nodes);
  return status == ECHOSPLINE_OK ? say(f->message, f->level->force->displacement(f->self, displacement)) : status;
}

echospline_status echospline_forced_displacement_single(echospline_forced* f, float* displacement, int64_t count) {
  echospline_status status = usable(f);
  if (status != ECHOSPLINE_OK) return status;
  status = room_for(f->message, displacement, count, 2 * f->nodes);
  return status == ECHOSPLINE_OK ? say(f->message, f->level->force->displacement_single(f->self, displacement))
                                 : status;
}

int64_t echospline_forced_state_size(const echospline_forced* f) {
  return f && f->self ? f->level->force->state_size(f->self) : 0;
}

echospline_status echospline_forced_state_save(echospline_forced* f, void* bytes, int64_t size) {
  const echospline_status status = usable(f);
  if (status != ECHOSPLINE_OK) return status;
  const int64_t needed = f->level->force->state_size(f->self);
  if (!bytes || size < needed)
    return refuse(f->message, bytes ? ECHOSPLINE_WRONG_SIZE : ECHOSPLINE_NULL_POINTER,
                  "bytes must have room for the state, %lld; got room for %lld", static_cast<long long>(needed),
                  static_cast<long long>(bytes ? size : 0));
  f->level->force->state_save(f->self, bytes);
  return ECHOSPLINE_OK;
}

echospline_status echospline_forced_state_load(echospline_forced* f, const void* bytes, int64_t size) {
  const echospline_status status = usable(f);
  if (status != ECHOSPLINE_OK) return status;
  if (!bytes) return refuse(f->message, ECHOSPLINE_NULL_POINTER, "bytes must be given; got NULL");
  return say(f->message, f->level->force->state_load(f->self, bytes, size, f->message));
}

}  // extern "C"
