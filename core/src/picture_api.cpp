// C interface of pictures: arguments are checked here, and the rest is done by the functions of the handle's processor
// level.
#include <cmath>
#include <cstdarg>
#include <cstdint>
#include <cstdio>
#include <cstdlib>

#include "../include/echospline/echospline.h"
#include "picture_entries.hpp"
#include "tissue_entries.hpp"

struct echospline_picture {
  const echospline::Level* level;
  void* picture;  // nullptr after a create that failed
  echospline_picture_options options;
  double* field;  // displacement of a tissue in double precision; nullptr before one is followed
  echospline::Message message;
};

namespace {

using echospline::Message;

constexpr int32_t MOST_PIXELS_ALONG = 16384;      // columns or rows: single precision places them to 0.002 px
constexpr int64_t MOST_NODES = int64_t(1) << 28;  // of the mesh: indices fit 32 bits
constexpr double FURTHEST = 1e6;                  // mm: greater lengths are mistakes, and their squares overflow

__attribute__((format(printf, 3, 4))) echospline_status refuse(Message& message, echospline_status status,
                                                               const char* format, ...) {
  va_list arguments;
  va_start(arguments, format);
  std::vsnprintf(message.text, sizeof message.text, format, arguments);
  va_end(arguments);
  return status;
}

bool near_enough(double x) { return x >= -FURTHEST && x <= FURTHEST; }  // no where x is not a number
bool positive(double x) { return x >= 1e-6 && x <= FURTHEST; }

echospline_status check_options(const echospline_picture_options& o, Message& message) {
  const struct {
    const char* name;
    int32_t value, choices;
  } words[] = {{"pixel_type", o.pixel_type, 4},
               {"interpolation", o.interpolation, 2},
               {"border", o.border, 2},
               {"method", o.method, 3}};
  for (const auto& word : words)
    if (word.value < 0 || word.value >= word.choices)
      return refuse(message, ECHOSPLINE_WRONG_VALUE, "%s must be one of the header's values 0 to %d; got %d", word.name,
                    word.choices - 1, word.value);
  if (o.channels != 1 && o.channels != 3)
    return refuse(message, ECHOSPLINE_WRONG_SIZE, "channels must be 1 (grey) or 3 (red, green, blue); got %d",
                  o.channels);
  if (o.columns < 1 || o.rows < 1 || o.columns > MOST_PIXELS_ALONG || o.rows > MOST_PIXELS_ALONG)
    return refuse(message, ECHOSPLINE_WRONG_SIZE, "columns and rows must be from 1 to %d; got %d x %d",
                  MOST_PIXELS_ALONG, o.columns, o.rows);
  const int32_t nx = o.mesh_shape[0], ny = o.mesh_shape[1];
  if (nx < 2 || ny < 2 || int64_t(nx) * ny > MOST_NODES)
    return refuse(message, ECHOSPLINE_WRONG_SIZE,
                  "mesh_shape must be 2 x 2 nodes or more, and at most %lld in all; got %d x %d",
                  static_cast<long long>(MOST_NODES), nx, ny);
  const struct {
    const char* name;
    const double* value;
    bool size;
  } pairs[] = {{"spacing", o.spacing, true},
               {"mesh_spacing", o.mesh_spacing, true},
               {"origin", o.origin, false},
               {"mesh_origin", o.mesh_origin, false}};
  for (const auto& pair : pairs)
    for (int k = 0; k < 2; ++k)
      if (!(pair.size ? positive(pair.value[k]) : near_enough(pair.value[k])))
        return refuse(message, ECHOSPLINE_WRONG_VALUE, "%s must be two %s in mm; got (%g, %g)", pair.name,
                      pair.size ? "positive numbers" : "numbers", pair.value[0], pair.value[1]);
  for (int k = 0; k < 2; ++k)
    if (!(o.mesh_spacing[k] / o.spacing[k] >= 1e-3))
      return refuse(message, ECHOSPLINE_WRONG_VALUE,
                    "mesh_spacing must be at least a thousandth of a pixel; got %g mm with pixels of %g mm",
                    o.mesh_spacing[k], o.spacing[k]);
  if (!near_enough(o.border_value))
    return refuse(message, ECHOSPLINE_WRONG_VALUE, "border_value must be a number; got %g", o.border_value);
  if (!(o.white >= 0 && o.white <= FURTHEST))
    return refuse(message, ECHOSPLINE_WRONG_VALUE,
                  "white must be a positive grey level, or 0 for the type's own; got %g", o.white);
  return ECHOSPLINE_OK;
}

echospline_status check_needle(const echospline_needle& n, Message& message) {
  if (n.struct_size != sizeof n)
    return refuse(message, ECHOSPLINE_WRONG_SIZE,
                  "struct_size of the needle must be %zu; got %u: set it and call echospline_needle_defaults", sizeof n,
                  n.struct_size);
  if (n.parts > 15u)
    return refuse(message, ECHOSPLINE_WRONG_VALUE, "parts must be a sum of the header's bits, 0 to 15; got %u",
                  n.parts);
  if (n.curved != 0 && n.curved != 1)
    return refuse(message, ECHOSPLINE_WRONG_VALUE, "curved must be 0 or 1; got %d", n.curved);
  for (int k = 0; k < 3; ++k)
    if (!near_enough(n.entry[k]) || !near_enough(n.tip[k]))
      return refuse(message, ECHOSPLINE_WRONG_VALUE,
                    "entry and tip must be numbers in mm; got (%g, %g, %g) and (%g, %g, %g)", n.entry[0], n.entry[1],
                    n.entry[2], n.tip[0], n.tip[1], n.tip[2]);
  if (!near_enough(n.apex[0]) || !near_enough(n.apex[1]))
    return refuse(message, ECHOSPLINE_WRONG_VALUE, "apex must be two numbers in mm; got (%g, %g)", n.apex[0],
                  n.apex[1]);
  const struct {
    const char *name, *unit;
    double value, low, high;
  } ranges[] = {
      {"diameter", "mm", n.diameter, 0.01, 100},
      {"lateral", "mm", n.lateral, 0.01, 100},
      {"axial", "mm", n.axial, 0.01, 100},
      {"elevation", "mm", n.elevation, 0.01, 1000},
      {"elevation_depth", "mm", n.elevation_depth, 0.1, 10000},
      {"element_height", "mm", n.element_height, 0, 1000},
      {"f_number", "", n.f_number, 0.1, 100},
      {"dynamic_range", "dB", n.dynamic_range, 1, 300},
      {"specular", "dB", n.specular, -300, 60},
      {"lobe", "degrees", n.lobe, 0.1, 90},
      {"lobe_elevation", "degrees", n.lobe_elevation, 0.1, 90},
      {"steering", "degrees", n.steering, 0, 60},
      {"roughness", "dB", n.roughness, -300, 60},
      {"rolloff", "dB", n.rolloff, 0, 100},
      {"wobble", "dB", n.wobble, 0, 20},
      {"patches", "dB", n.patches, 0, 20},
      {"bevel", "dB", n.bevel, -300, 60},
      {"ring_down", "dB", n.ring_down, -300, 0},
      {"ring_down_loss", "dB/mm", n.ring_down_loss, 0.1, 1000},
      {"opacity", "", n.opacity, 0, 1},
  };
  for (const auto& range : ranges)
    if (!(range.value >= range.low && range.value <= range.high))
      return refuse(message, ECHOSPLINE_WRONG_VALUE, "%s of a needle must be from %g to %g%s%s; got %g", range.name,
                    range.low, range.high, *range.unit ? " " : "", range.unit, range.value);
  return ECHOSPLINE_OK;
}

/// Is this a handle that can work?
echospline_status check_handle(const echospline_picture* picture) {
  if (!picture) return ECHOSPLINE_NULL_POINTER;
  return picture->picture ? ECHOSPLINE_OK : ECHOSPLINE_FAILED_HANDLE;
}

echospline_status null_argument(echospline_picture* picture, const char* name) {
  return refuse(picture->message, ECHOSPLINE_NULL_POINTER, "%s must not be NULL", name);
}

/// Does the picture have a tissue's mesh?
echospline_status check_mesh(echospline_picture* picture, const echospline::SceneCounts& tissue) {
  if (tissue.dimension != 2)
    return refuse(picture->message, ECHOSPLINE_WRONG_VALUE,
                  "the tissue must be of dimension 2; got %d: give the plane's displacement to deform",
                  tissue.dimension);
  const echospline_picture_options& o = picture->options;
  for (int d = 0; d < 2; ++d) {
    const double rounding = 1e-6 * tissue.spacing[d];
    if (o.mesh_shape[d] != tissue.shape[d] || !(std::fabs(o.mesh_spacing[d] - tissue.spacing[d]) <= rounding) ||
        !(std::fabs(o.mesh_origin[d] - tissue.origin[d]) <= rounding))
      return refuse(
          picture->message, ECHOSPLINE_WRONG_SIZE,
          "the picture's mesh must be the tissue's, %d x %d nodes of %g x %g mm from (%g, %g); got %d x %d of %g x %g "
          "from (%g, %g)",
          tissue.shape[0], tissue.shape[1], tissue.spacing[0], tissue.spacing[1], tissue.origin[0], tissue.origin[1],
          o.mesh_shape[0], o.mesh_shape[1], o.mesh_spacing[0], o.mesh_spacing[1], o.mesh_origin[0], o.mesh_origin[1]);
  }
  return ECHOSPLINE_OK;
}

/// Is a tissue's displacement near enough to be drawn? Node n has (x[n * step], y[n * step]).
template <class Real>
echospline_status check_field(echospline_picture* picture, const Real* x, const Real* y, int64_t step, int64_t nodes) {
  for (int64_t k = 0; k < nodes; ++k)
    if (!near_enough(x[k * step]) || !near_enough(y[k * step]))
      return refuse(picture->message, ECHOSPLINE_WRONG_VALUE,
                    "the tissue's displacement must be below %g mm to be drawn; node %lld has (%g, %g)", FURTHEST,
                    static_cast<long long>(k), static_cast<double>(x[k * step]), static_cast<double>(y[k * step]));
  return ECHOSPLINE_OK;
}

echospline_status field_failed(echospline_picture* picture, echospline_status status) {
  return refuse(picture->message, status, "the tissue's displacement cannot be evaluated: %s",
                echospline_status_text(status));
}

template <class Real>
echospline_status check_displacement(echospline_picture* picture, const Real* displacement, int64_t count) {
  if (const echospline_status status = check_handle(picture)) return status;
  if (!displacement) return null_argument(picture, "displacement");
  const int32_t *shape = picture->options.mesh_shape, nx = shape[0], ny = shape[1];
  const int64_t expected = int64_t(nx) * ny * 2;
  if (count != expected)
    return refuse(picture->message, ECHOSPLINE_WRONG_SIZE,
                  "displacement must hold %lld numbers, 2 for each of %d x %d nodes; got %lld",
                  static_cast<long long>(expected), nx, ny, static_cast<long long>(count));
  for (int64_t k = 0; k < count; ++k)
    if (!near_enough(displacement[k]))
      return refuse(picture->message, ECHOSPLINE_WRONG_VALUE,
                    "displacement must be finite numbers in mm; node %lld has %g", static_cast<long long>(k / 2),
                    static_cast<double>(displacement[k]));
  return ECHOSPLINE_OK;
}

}  // namespace

extern "C" {

void echospline_picture_defaults(echospline_picture_options* options) {
  if (!options || options->struct_size != sizeof *options) return;
  *options = {};
  options->struct_size = sizeof *options;
  options->channels = 1;
}

void echospline_needle_defaults(echospline_needle* needle) {
  if (!needle || needle->struct_size != sizeof *needle) return;
  *needle = {};
  needle->struct_size = sizeof *needle;
  needle->parts = ECHOSPLINE_SHAFT | ECHOSPLINE_BEVEL | ECHOSPLINE_TAIL | ECHOSPLINE_SHADOW;
  needle->seed = 3;
  needle->diameter = 1.27;
  needle->lateral = 0.28;  // chosen for 7.5 MHz
  needle->axial = 0.13;
  needle->elevation = 0.75;
  needle->elevation_depth = 18;
  needle->element_height = 5;
  needle->f_number = 1.6;  // penumbra of 5 to 6 mm at 15 to 27 mm in a recorded picture
  needle->dynamic_range = 60;
  needle->specular = 5;  // white at right angles once three angles are compounded
  needle->lobe = 5;      // measured: half level at 10 to 11 degrees
  needle->lobe_elevation = 3.5;
  needle->steering = 12;
  needle->roughness = -25;  // with the roll-off: contrast measured in gel at 35 to 60 and at 60 to 90 degrees
  needle->rolloff = 9;
  needle->wobble = 2.5;
  needle->patches = 5;
  needle->bevel = -3;
  needle->ring_down = -36;
  needle->ring_down_loss = 7;
  needle->opacity = 0.75;
}

echospline_status echospline_picture_create(const echospline_picture_options* options, const void* pixels,
                                            echospline_picture** picture) {
  if (!picture) return ECHOSPLINE_NULL_POINTER;
  *picture = static_cast<echospline_picture*>(std::calloc(1, sizeof **picture));
  if (!*picture) return ECHOSPLINE_OUT_OF_MEMORY;
  echospline_picture& p = **picture;
  if (!options) return null_argument(&p, "options");
  if (options->struct_size != sizeof *options)
    return refuse(p.message, ECHOSPLINE_WRONG_SIZE,
                  "struct_size of the options must be %zu; got %u: set it and call echospline_picture_defaults",
                  sizeof *options, options->struct_size);
  if (const echospline_status status = check_options(*options, p.message)) return status;
  if (!pixels) return null_argument(&p, "pixels");
  p.level = echospline::find_level(options->level);
  if (!p.level)
    return refuse(p.message, ECHOSPLINE_WRONG_VALUE,
                  "level must be one that this library and processor have; got %d: use ECHOSPLINE_LEVEL_BEST",
                  options->level);
  p.options = *options;
  p.picture = p.level->picture->create(*options, pixels);
  if (!p.picture)
    return refuse(p.message, ECHOSPLINE_OUT_OF_MEMORY, "memory for a picture of %d x %d pixels ran out",
                  options->columns, options->rows);
  return ECHOSPLINE_OK;
}

void echospline_picture_destroy(echospline_picture* picture) {
  if (!picture) return;
  if (picture->picture) picture->level->picture->destroy(picture->picture);
  std::free(picture->field);
  std::free(picture);
}

const char* echospline_picture_message(const echospline_picture* picture) {
  return picture ? picture->message.text : "picture must not be NULL";
}

int32_t echospline_picture_level(const echospline_picture* picture) {
  return check_handle(picture) ? ECHOSPLINE_LEVEL_BEST : picture->level->id;
}

int64_t echospline_picture_size(const echospline_picture* picture) {
  return check_handle(picture) ? 0 : picture->level->picture->size(picture->picture);
}

echospline_status echospline_picture_reference(echospline_picture* picture, const void* pixels, int64_t bytes) {
  if (const echospline_status status = check_handle(picture)) return status;
  if (!pixels) return null_argument(picture, "pixels");
  const echospline_picture_options& o = picture->options;
  const int64_t each = o.pixel_type == ECHOSPLINE_UINT8 ? 1 : o.pixel_type == ECHOSPLINE_FLOAT32 ? 4 : 2;
  const int64_t expected = int64_t(o.columns) * o.rows * o.channels * each;
  if (bytes != expected)
    return refuse(picture->message, ECHOSPLINE_WRONG_SIZE,
                  "pixels must be %lld bytes, of the layout given to create; got %lld",
                  static_cast<long long>(expected), static_cast<long long>(bytes));
  picture->level->picture->reference(picture->picture, pixels);
  return ECHOSPLINE_OK;
}

echospline_status echospline_picture_deform(echospline_picture* picture, const double* displacement, int64_t count) {
  if (const echospline_status status = check_displacement(picture, displacement, count)) return status;
  picture->level->picture->deform(picture->picture, displacement);
  return ECHOSPLINE_OK;
}

echospline_status echospline_picture_deform_single(echospline_picture* picture, const float* displacement,
                                                   int64_t count) {
  if (const echospline_status status = check_displacement(picture, displacement, count)) return status;
  picture->level->picture->deform_single(picture->picture, displacement);
  return ECHOSPLINE_OK;
}

echospline_status echospline_picture_follow(echospline_picture* picture, echospline_tissue* tissue) {
  if (const echospline_status status = check_handle(picture)) return status;
  echospline::TissueView from;
  if (const echospline_status status = echospline::view_of(tissue, from, picture->message)) return status;
  if (const echospline_status status = check_mesh(picture, *from.counts)) return status;
  const int64_t nodes = from.counts->nodes;
  const float *x, *y;
  if (const echospline_status status = from.functions->planes(from.self, &x, &y)) return field_failed(picture, status);
  if (x) {
    if (const echospline_status status = check_field(picture, x, y, 1, nodes)) return status;
    picture->level->picture->deform_planes(picture->picture, x, y);
    return ECHOSPLINE_OK;
  }
  // a field in double precision: converted through memory that is reserved at the first call
  if (!picture->field) picture->field = static_cast<double*>(std::malloc(sizeof(double) * 2 * nodes));
  double* field = picture->field;
  if (!field) return refuse(picture->message, ECHOSPLINE_OUT_OF_MEMORY, "memory for the tissue's displacement ran out");
  if (const echospline_status status = from.functions->displacement(from.self, field))
    return field_failed(picture, status);
  if (const echospline_status status = check_field(picture, field, field + 1, 2, nodes)) return status;
  picture->level->picture->deform(picture->picture, field);
  return ECHOSPLINE_OK;
}

echospline_status echospline_picture_draw(echospline_picture* picture, const echospline_needle* needle, void* out,
                                          int64_t bytes) {
  if (const echospline_status status = check_handle(picture)) return status;
  if (!out) return null_argument(picture, "out");
  const int64_t expected = picture->level->picture->size(picture->picture);
  if (bytes != expected)
    return refuse(picture->message, ECHOSPLINE_WRONG_SIZE, "a drawn picture takes %lld bytes; got room for %lld",
                  static_cast<long long>(expected), static_cast<long long>(bytes));
  if (needle)
    if (const echospline_status status = check_needle(*needle, picture->message)) return status;
  picture->level->picture->draw(picture->picture, needle, out);
  return ECHOSPLINE_OK;
}

echospline_status echospline_picture_inverse(echospline_picture* picture, float* x, float* y, int64_t count) {
  if (const echospline_status status = check_handle(picture)) return status;
  if (!x || !y) return null_argument(picture, "x and y");
  const int64_t expected = int64_t(picture->options.columns) * picture->options.rows;
  if (count != expected)
    return refuse(picture->message, ECHOSPLINE_WRONG_SIZE,
                  "x and y must hold %lld numbers each, one per pixel; got %lld", static_cast<long long>(expected),
                  static_cast<long long>(count));
  picture->level->picture->inverse(picture->picture, x, y);
  return ECHOSPLINE_OK;
}

echospline_status echospline_picture_check(echospline_picture* picture, echospline_picture_report* report) {
  if (const echospline_status status = check_handle(picture)) return status;
  if (!report) return null_argument(picture, "report");
  if (report->struct_size != sizeof *report)
    return refuse(picture->message, ECHOSPLINE_WRONG_SIZE, "struct_size of the report must be %zu; got %u",
                  sizeof *report, report->struct_size);
  picture->level->picture->check(picture->picture, *report);
  return ECHOSPLINE_OK;
}

echospline_status echospline_picture_echo(echospline_picture* picture, const echospline_needle* needle,
                                          const double* points, int64_t point_count, double* power,
                                          double* transmission) {
  if (const echospline_status status = check_handle(picture)) return status;
  if (!needle) return null_argument(picture, "needle");
  if (point_count < 0)
    return refuse(picture->message, ECHOSPLINE_WRONG_SIZE, "point_count must be 0 or more; got %lld",
                  static_cast<long long>(point_count));
  if (point_count && (!points || !power || !transmission))
    return null_argument(picture, "points, power and transmission");
  if (const echospline_status status = check_needle(*needle, picture->message)) return status;
  for (int64_t k = 0; k < 2 * point_count; ++k)
    if (!near_enough(points[k]))
      return refuse(picture->message, ECHOSPLINE_WRONG_VALUE, "points must be numbers in mm; point %lld has %g",
                    static_cast<long long>(k / 2), points[k]);
  if (point_count) picture->level->picture->echo(picture->picture, *needle, points, point_count, power, transmission);
  return ECHOSPLINE_OK;
}

}  // extern "C"
