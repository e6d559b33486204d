// The C interface of scenes and tissues: checks what comes from outside, then calls the level of the handle.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>

#include "tissue_entries.hpp"

using echospline::Level;
using echospline::Message;

struct echospline_scene {
  const Level* level = nullptr;
  const echospline::SceneFunctions* functions = nullptr;
  void* self = nullptr;
  echospline::SceneCounts counts = {};
  Message message;
};

struct echospline_tissue {
  const echospline_scene* scene = nullptr;
  const echospline::TissueFunctions* functions = nullptr;
  void* self = nullptr;
  Message message;
};

namespace {

constexpr int64_t MOST_NODES = int64_t{1}
                               << 27;   // of a mesh: 134 million, beyond which indices and memory make no sense
constexpr int64_t MOST_ANCHORS = 4000;  // their system is a full matrix: 128 MB of it

template <class... Numbers>
echospline_status refuse(Message& message, echospline_status status, const char* format, Numbers... numbers) {
  std::snprintf(message.text, sizeof message.text, format, numbers...);
  return status;
}

struct Range {
  const char* name;
  double value, low, high;
  const char* unit;
};

echospline_status check_shape(const echospline_scene_options& o, Message& m) {
  static const char axes[] = "xyz";
  int64_t nodes = 1;
  for (int d = 0; d < o.dimension; ++d) {
    if (o.shape[d] < 2)
      return refuse(m, ECHOSPLINE_WRONG_VALUE, "a mesh must have 2 nodes or more along %c; got %d: set shape", axes[d],
                    o.shape[d]);
    if (!(o.spacing[d] >= 1e-6 &&
          o.spacing[d] <= 1e6))  // squares of lengths have to be numbers in single precision, too
      return refuse(m, ECHOSPLINE_WRONG_VALUE, "spacing along %c must be a number from 1e-06 to 1e+06 mm; got %g",
                    axes[d], o.spacing[d]);
    if (!(std::fabs(o.origin[d]) < 1e9))
      return refuse(m, ECHOSPLINE_WRONG_VALUE, "origin along %c must be a finite number in mm, below 1e9; got %g",
                    axes[d], o.origin[d]);
    nodes *= o.shape[d];
    if (nodes > MOST_NODES)
      return refuse(m, ECHOSPLINE_WRONG_SIZE, "a mesh may have %lld nodes; got more: use a coarser one",
                    static_cast<long long>(MOST_NODES));
  }
  if (o.stiffness_count != (o.stiffness ? nodes : 0))
    return refuse(m, ECHOSPLINE_WRONG_SIZE, "stiffness needs one number per mesh node, %lld; got %lld",
                  static_cast<long long>(nodes), static_cast<long long>(o.stiffness_count));
  for (int64_t i = 0; i < o.stiffness_count; ++i)
    if (!(o.stiffness[i] > 0))
      return refuse(m, ECHOSPLINE_WRONG_VALUE, "every stiffness must be positive (or infinite); got %g",
                    o.stiffness[i]);
  return ECHOSPLINE_OK;
}

echospline_status check_choices(const echospline_scene_options& o, Message& m) {
  const struct {
    const char* name;
    int32_t value, last;
  } choices[] = {{"kernel", o.kernel, ECHOSPLINE_ELASTIC},
                 {"precision", o.precision, ECHOSPLINE_DOUBLE},
                 {"tip", o.tip, ECHOSPLINE_TIP_NODE},
                 {"loading", o.loading, ECHOSPLINE_STICK},
                 {"plane", o.plane, ECHOSPLINE_PLANE_STRAIN}};
  for (const auto& choice : choices)
    if (choice.value < 0 || choice.value > choice.last)
      return refuse(m, ECHOSPLINE_WRONG_VALUE, "%s must be a choice from 0 to %d; got %d", choice.name, choice.last,
                    choice.value);
  const uint32_t edges = o.dimension == 2 ? 15 : 63;
  if (o.clamped & ~edges)
    return refuse(m, ECHOSPLINE_WRONG_VALUE, "clamped must be bits of ECHOSPLINE_LEFT ... in %d dimensions; got %u",
                  o.dimension, o.clamped);
  if (o.sliding & ~edges)
    return refuse(m, ECHOSPLINE_WRONG_VALUE, "sliding must be bits of ECHOSPLINE_LEFT ... in %d dimensions; got %u",
                  o.dimension, o.sliding);
  if (o.clamped & o.sliding)
    return refuse(m, ECHOSPLINE_WRONG_VALUE,
                  "an edge is clamped, sliding or free; got clamped %u and sliding %u, which share an edge", o.clamped,
                  o.sliding);
  return ECHOSPLINE_OK;
}

echospline_status check_numbers(const echospline_scene_options& o, Message& m) {
  const double huge = 1e9;
  const bool stress = o.dimension == 2 && o.plane == ECHOSPLINE_PLANE_STRESS;
  const Range ranges[] = {{"sigma", o.sigma, 0, huge, "mm"},
                          {"delta", o.delta, 0, huge, "mm"},
                          {"alpha1", o.alpha1, -huge, huge, "s"},
                          {"alpha2", o.alpha2, -huge, huge, "s"},
                          {"alpha3", o.alpha3, 0, huge, "1/s"},
                          {"length", o.length, 1e-9, huge, "mm"},
                          {"drag", o.drag, 0, 1, "(no unit)"},
                          {"friction_speed", o.friction_speed, 0, huge, "mm/s"},
                          {"contact_spacing", o.contact_spacing, 0, huge, "mm"},
                          {"anchor_spacing", o.anchor_spacing, 1e-3, huge, "mm"},
                          {"poisson", o.poisson, 0, stress ? 0.5 : 0.4999999, "(no unit)"},
                          {"radius", o.radius, 1e-9, huge, "mm"}};
  for (const Range& r : ranges)
    if (!(r.value >= r.low && r.value <= r.high))
      return refuse(m, ECHOSPLINE_WRONG_VALUE, "%s must be a number from %g to %g %s; got %g", r.name, r.low, r.high,
                    r.unit, r.value);
  return ECHOSPLINE_OK;
}

echospline_status check_clamped(const echospline_scene_options& o, Message& m) {
  if (o.clamped_point_count < 0 || o.clamped_point_count > MOST_ANCHORS ||
      (o.clamped_point_count > 0 && !o.clamped_points))
    return refuse(m, ECHOSPLINE_WRONG_SIZE, "clamped_points must be 0 to %lld points; got %lld%s",
                  static_cast<long long>(MOST_ANCHORS), static_cast<long long>(o.clamped_point_count),
                  o.clamped_points ? "" : " and no pointer");
  for (int64_t i = 0; i < o.clamped_point_count; ++i)
    for (int d = 0; d < o.dimension; ++d) {
      const double x = o.clamped_points[i * o.dimension + d], last = o.origin[d] + (o.shape[d] - 1) * o.spacing[d];
      if (!(x >= o.origin[d] && x <= last))
        return refuse(m, ECHOSPLINE_WRONG_VALUE, "every clamped point must lie inside the mesh; point %lld does not",
                      static_cast<long long>(i));
    }
  const double per = o.kernel == ECHOSPLINE_ELASTIC ? o.dimension : 1;
  double anchors = static_cast<double>(o.clamped_point_count) * per;
  for (int edge = 0; edge < 2 * o.dimension; ++edge) {
    if (!((o.clamped | o.sliding) >> edge & 1)) continue;
    double on_edge = o.clamped >> edge & 1 ? per : 1;
    // where no other edge holds a component, a thin plate has a second row
    if (o.kernel == ECHOSPLINE_THIN_PLATE && !(o.clamped & ~(1u << edge))) on_edge *= 2;
    for (int d = 0; d < o.dimension; ++d)
      if (d != edge / 2) on_edge *= std::ceil((o.shape[d] - 1) * o.spacing[d] / o.anchor_spacing) + 1;
    anchors += on_edge;
  }
  if (anchors > static_cast<double>(MOST_ANCHORS))
    return refuse(m, ECHOSPLINE_WRONG_SIZE,
                  "what is held may have %lld anchors (elastic: components); got %.0f: raise anchor_spacing",
                  static_cast<long long>(MOST_ANCHORS), anchors);
  if (o.contact_room < 0 || o.contact_room > 1 << 20)
    return refuse(m, ECHOSPLINE_WRONG_SIZE, "contact_room must be 0 to %d; got %lld", 1 << 20,
                  static_cast<long long>(o.contact_room));
  return ECHOSPLINE_OK;
}

echospline_status check(const echospline_scene_options& o, Message& m) {
  if (o.dimension != 2 && o.dimension != 3)
    return refuse(m, ECHOSPLINE_WRONG_VALUE, "dimension must be 2 or 3; got %d", o.dimension);
  echospline_status status = check_choices(o, m);
  if (status == ECHOSPLINE_OK) status = check_numbers(o, m);
  if (status == ECHOSPLINE_OK) status = check_shape(o, m);
  if (status == ECHOSPLINE_OK) status = check_clamped(o, m);
  return status;
}

bool finite(const double* v, int dimension) {
  for (int d = 0; d < dimension; ++d)
    if (!(std::fabs(v[d]) <= 1e9)) return false;
  return true;
}

echospline_status check_pose(const echospline_pose& pose, int dimension, Message& m) {
  if (!finite(pose.entry, dimension) || !finite(pose.tip, dimension))
    return refuse(m, ECHOSPLINE_WRONG_VALUE,
                  "entry and tip of a pose must be finite numbers in mm, below 1e9; got tip (%g, %g)", pose.tip[0],
                  pose.tip[1]);
  if (!(std::fabs(pose.speed) <= 1e9))
    return refuse(m, ECHOSPLINE_WRONG_VALUE, "speed of a pose must be a finite number in mm/s; got %g", pose.speed);
  if (!(pose.dt >= 0 && pose.dt <= 1e9))
    return refuse(m, ECHOSPLINE_WRONG_VALUE, "dt must be zero or a positive number of seconds; got %g", pose.dt);
  return ECHOSPLINE_OK;
}

/// Status of a call, with a message where the level has written none.
echospline_status say(Message& message, echospline_status status) {
  if (status == ECHOSPLINE_OUT_OF_MEMORY) return refuse(message, status, "memory ran out; the state has not changed");
  if (status == ECHOSPLINE_NOT_SOLVED)
    return refuse(message, status,
                  "two landmarks lie too close together to be told apart; the state has not changed: thin them out");
  return status;
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

template <class Handle>
Handle* new_handle() {
  void* memory = std::malloc(sizeof(Handle));
  if (!memory) return nullptr;
  Handle* handle = static_cast<Handle*>(memory);
  const Handle fresh;
  std::memcpy(static_cast<void*>(handle), &fresh, sizeof fresh);
  return handle;
}

constexpr const char* FAILED = "this handle's create had failed";

/// Status that ends a call on a tissue before it begins, or OK.
echospline_status usable(echospline_tissue* t) {
  if (!t) return ECHOSPLINE_NULL_POINTER;
  return t->self ? ECHOSPLINE_OK : ECHOSPLINE_FAILED_HANDLE;
}

}  // namespace

echospline_status echospline::view_of(echospline_tissue* t, TissueView& view, Message& message) {
  if (!t) return refuse(message, ECHOSPLINE_NULL_POINTER, "a tissue must be given; got NULL");
  if (!t->self)
    return refuse(message, ECHOSPLINE_FAILED_HANDLE, "a tissue that works must be given; its create had failed");
  view = {t->self, t->functions, &t->scene->counts};
  return ECHOSPLINE_OK;
}

extern "C" {

void echospline_scene_defaults(echospline_scene_options* o) {
  if (!o || o->struct_size != sizeof *o) return;
  const uint32_t size = o->struct_size;
  const int32_t dimension = o->dimension == 3 ? 3 : 2;
  std::memset(o, 0, sizeof *o);
  o->struct_size = size, o->dimension = dimension;
  o->clamped = ECHOSPLINE_LEFT | ECHOSPLINE_RIGHT | ECHOSPLINE_BOTTOM;
  if (dimension == 3) o->clamped |= ECHOSPLINE_FRONT | ECHOSPLINE_BACK;
  o->sigma = 1, o->delta = 1.5, o->alpha1 = 0.08, o->alpha2 = 0.04, o->alpha3 = 1, o->length = 1, o->drag = 1;
  o->loading = ECHOSPLINE_STICK, o->friction_speed = 10;
  o->contact_spacing = 1.25, o->anchor_spacing = dimension == 2 ? 1.5 : 5;
  o->poisson = 0.45, o->radius = 1;
}

echospline_status echospline_scene_create(const echospline_scene_options* options, echospline_scene** scene) {
  if (!scene) return ECHOSPLINE_NULL_POINTER;
  *scene = new_handle<echospline_scene>();
  if (!*scene) return ECHOSPLINE_OUT_OF_MEMORY;
  echospline_scene& made = **scene;
  Message& message = made.message;
  if (!options) return refuse(message, ECHOSPLINE_NULL_POINTER, "options must be given; got NULL");
  if (options->struct_size != sizeof *options)
    return refuse(message, ECHOSPLINE_WRONG_SIZE, "struct_size must be %u, sizeof(echospline_scene_options); got %u",
                  static_cast<unsigned>(sizeof *options), options->struct_size);
  echospline_status status = check(*options, message);
  if (status != ECHOSPLINE_OK) return status;
  made.level = echospline::find_level(options->level);
  if (!made.level)
    return refuse(message, ECHOSPLINE_WRONG_VALUE, "level must be one that this processor has, at most %s; got %d (%s)",
                  echospline_level_name(echospline_level_best()), options->level,
                  echospline_level_name(options->level));
  status = made.level->tissue->create_scene(*options, &made.self, &made.functions, message);
  if (status == ECHOSPLINE_OUT_OF_MEMORY) return refuse(message, status, "memory ran out while the scene was built");
  if (status == ECHOSPLINE_OK) made.counts = made.functions->counts(made.self);
  return status;
}

void echospline_scene_destroy(echospline_scene* scene) {
  if (!scene) return;
  if (scene->self) scene->functions->destroy(scene->self);
  std::free(scene);
}

const char* echospline_scene_message(const echospline_scene* scene) {
  return scene ? scene->message.text : "the scene is NULL";
}
int32_t echospline_scene_level(const echospline_scene* scene) { return scene && scene->self ? scene->level->id : 0; }
int64_t echospline_scene_node_count(const echospline_scene* scene) { return scene ? scene->counts.nodes : 0; }
int64_t echospline_scene_anchor_count(const echospline_scene* scene) { return scene ? scene->counts.anchors : 0; }
int64_t echospline_scene_source_count(const echospline_scene* scene) { return scene ? scene->counts.sources : 0; }

echospline_status echospline_scene_anchors(echospline_scene* scene, double* anchors, int64_t count) {
  if (!scene) return ECHOSPLINE_NULL_POINTER;
  if (!scene->self) return ECHOSPLINE_FAILED_HANDLE;
  const echospline_status status =
      room_for(scene->message, anchors, count, scene->counts.anchors * scene->counts.dimension);
  if (status == ECHOSPLINE_OK) scene->functions->anchors(scene->self, anchors);
  return status;
}
echospline_status echospline_scene_sources(echospline_scene* scene, int64_t* nodes, int64_t count) {
  if (!scene) return ECHOSPLINE_NULL_POINTER;
  if (!scene->self) return ECHOSPLINE_FAILED_HANDLE;
  const echospline_status status = room_for(scene->message, nodes, count, scene->counts.sources);
  if (status == ECHOSPLINE_OK) scene->functions->sources(scene->self, nodes);
  return status;
}

echospline_status echospline_follow(const echospline_pose* now, const echospline_command* command,
                                    echospline_pose* next) {
  if (!now || !command || !next) return ECHOSPLINE_NULL_POINTER;
  if (!finite(now->entry, 3) || !finite(now->tip, 3) || !finite(command->entry, 3) || !finite(command->tip, 3) ||
      !(command->lag >= 0) || !(command->fastest > 0) || !(next->dt > 0 && next->dt <= 1e9))
    return ECHOSPLINE_WRONG_VALUE;
  return echospline::find_level(ECHOSPLINE_LEVEL_BEST)->tissue->follow(*now, *command, *next);
}

echospline_status echospline_tissue_create(const echospline_scene* scene, echospline_tissue** tissue) {
  if (!tissue) return ECHOSPLINE_NULL_POINTER;
  *tissue = new_handle<echospline_tissue>();
  if (!*tissue) return ECHOSPLINE_OUT_OF_MEMORY;
  echospline_tissue& made = **tissue;
  if (!scene) return refuse(made.message, ECHOSPLINE_NULL_POINTER, "a scene must be given; got NULL");
  if (!scene->self)
    return refuse(made.message, ECHOSPLINE_FAILED_HANDLE, "the scene's create had failed: %.300s", scene->message.text);
  made.scene = scene, made.functions = scene->functions->tissue;
  made.self = scene->functions->create_tissue(scene->self);
  return made.self ? ECHOSPLINE_OK
                   : refuse(made.message, ECHOSPLINE_OUT_OF_MEMORY, "memory ran out while the tissue was built");
}

void echospline_tissue_destroy(echospline_tissue* tissue) {
  if (!tissue) return;
  if (tissue->self) tissue->functions->destroy(tissue->self);
  std::free(tissue);
}

const char* echospline_tissue_message(const echospline_tissue* tissue) {
  if (!tissue) return "the tissue is NULL";
  return tissue->self || tissue->message.text[0] ? tissue->message.text : FAILED;
}

echospline_status echospline_tissue_reset(echospline_tissue* t) {
  const echospline_status status = usable(t);
  if (status == ECHOSPLINE_OK) t->functions->reset(t->self);
  return status;
}

echospline_status echospline_advance(echospline_tissue* t, const echospline_pose* pose) {
  echospline_status status = usable(t);
  if (status != ECHOSPLINE_OK) return status;
  if (!pose) return refuse(t->message, ECHOSPLINE_NULL_POINTER, "a pose must be given; got NULL");
  status = check_pose(*pose, t->scene->counts.dimension, t->message);
  return status == ECHOSPLINE_OK ? say(t->message, t->functions->advance(t->self, *pose)) : status;
}

echospline_status echospline_displacement(echospline_tissue* t, double* out, int64_t count) {
  echospline_status status = usable(t);
  if (status == ECHOSPLINE_OK)
    status = room_for(t->message, out, count, t->scene->counts.nodes * t->scene->counts.dimension);
  return status == ECHOSPLINE_OK ? say(t->message, t->functions->displacement(t->self, out)) : status;
}
echospline_status echospline_displacement_single(echospline_tissue* t, float* out, int64_t count) {
  echospline_status status = usable(t);
  if (status == ECHOSPLINE_OK)
    status = room_for(t->message, out, count, t->scene->counts.nodes * t->scene->counts.dimension);
  return status == ECHOSPLINE_OK ? say(t->message, t->functions->displacement_single(t->self, out)) : status;
}

echospline_status echospline_displacement_at(echospline_tissue* t, const double* points, int64_t count, double* out) {
  const echospline_status status = usable(t);
  if (status != ECHOSPLINE_OK) return status;
  const int dimension = t->scene->counts.dimension;
  if (count < 0 || count > INT64_MAX / 64)
    return refuse(t->message, ECHOSPLINE_WRONG_SIZE, "point_count must be zero or positive; got %lld",
                  static_cast<long long>(count));
  if (count > 0 && (!points || !out))
    return refuse(t->message, ECHOSPLINE_NULL_POINTER, "points and displacement must be given; got NULL");
  for (int64_t i = 0; i < count; ++i)
    if (!finite(points + i * dimension, dimension))
      return refuse(t->message, ECHOSPLINE_WRONG_VALUE,
                    "points must be finite numbers in mm, below 1e9; point %lld is not", static_cast<long long>(i));
  return count ? say(t->message, t->functions->displacement_at(t->self, points, count, out)) : ECHOSPLINE_OK;
}

echospline_status echospline_landmarks(echospline_tissue* t, echospline_landmark* landmarks, int64_t room,
                                       int64_t* count) {
  const echospline_status status = usable(t);
  if (status != ECHOSPLINE_OK) return status;
  if (!count) return refuse(t->message, ECHOSPLINE_NULL_POINTER, "count must be given; got NULL");
  if (room < 0 || (room > 0 && !landmarks))
    return refuse(t->message, ECHOSPLINE_WRONG_SIZE,
                  "room must be the number of landmarks that the array holds; got %lld%s", static_cast<long long>(room),
                  landmarks ? "" : " and no pointer");
  *count = t->functions->landmarks(t->self, landmarks, room);
  return ECHOSPLINE_OK;
}

echospline_status echospline_tissue_statistics(echospline_tissue* t, echospline_statistics* statistics) {
  const echospline_status status = usable(t);
  if (status != ECHOSPLINE_OK) return status;
  if (!statistics) return refuse(t->message, ECHOSPLINE_NULL_POINTER, "statistics must be given; got NULL");
  if (statistics->struct_size != sizeof *statistics)
    return refuse(t->message, ECHOSPLINE_WRONG_SIZE, "struct_size must be %u, sizeof(echospline_statistics); got %u",
                  static_cast<unsigned>(sizeof *statistics), statistics->struct_size);
  t->functions->statistics(t->self, *statistics);
  return ECHOSPLINE_OK;
}

int64_t echospline_state_size(const echospline_tissue* t) {
  return t && t->self ? t->functions->state_size(t->self) : 0;
}

echospline_status echospline_state_save(echospline_tissue* t, void* bytes, int64_t size) {
  echospline_status status = usable(t);
  if (status != ECHOSPLINE_OK) return status;
  const int64_t needed = t->functions->state_size(t->self);
  if (!bytes || size < needed)
    return refuse(t->message, bytes ? ECHOSPLINE_WRONG_SIZE : ECHOSPLINE_NULL_POINTER,
                  "bytes must have room for the state, %lld; got room for %lld", static_cast<long long>(needed),
                  static_cast<long long>(bytes ? size : 0));
  t->functions->state_save(t->self, bytes);
  return ECHOSPLINE_OK;
}

echospline_status echospline_state_load(echospline_tissue* t, const void* bytes, int64_t size) {
  const echospline_status status = usable(t);
  if (status != ECHOSPLINE_OK) return status;
  if (!bytes) return refuse(t->message, ECHOSPLINE_NULL_POINTER, "bytes must be given; got NULL");
  return say(t->message, t->functions->state_load(t->self, bytes, size, t->message));
}

}  // extern "C"
