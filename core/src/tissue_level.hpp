// Scenes and tissues at one processor level: the choice of dimension, kernel and precision, and states as bytes.
#pragma once
#include <cstdio>
#include <new>

#include "../include/echospline/field.hpp"
#include "../include/echospline/tissue.hpp"
#include "tissue_entries.hpp"

namespace echospline::ECHOSPLINE_CORE {
namespace {

// ---- States as bytes ------------------------------------------------------------------------------------------------------------------

constexpr char STATE_MAGIC[8] = {'e', 'c', 'h', 'o', 's', 't', 'a', 't'};
constexpr uint32_t STATE_VERSION = 1;

/// Checksum of bytes (Fowler, Noll and Vo, 64 bits, eight bytes at a time), to be continued from another.
inline uint64_t checksum(const void* bytes, int64_t size, uint64_t sum = 14695981039346656037ull) {
  const unsigned char* p = static_cast<const unsigned char*>(bytes);
  for (int64_t i = 0; i < size; i += 8) {
    uint64_t word = 0;
    std::memcpy(&word, p + i, static_cast<size_t>(smaller<int64_t>(8, size - i)));
    sum = (sum ^ word) * 1099511628211ull;
  }
  return sum ^ sum >> 32;  // the highest bits of a word reach only the highest of the product
}

/// Fixed part of a state's bytes; contacts follow, then the checksum of both.
struct StateHeader {
  char magic[8];
  uint32_t version, dimension;
  uint64_t fingerprint;
  int64_t count, held_back;
  int32_t posed, tip;  ///< tip: 0 none, 1 pushes, 2 left
  double place[3], q[3], entry[3], tip_at[3];
};
struct StateContact {
  int32_t source, touching;
  double q[3], along, grip[3];
};
static_assert(sizeof(StateHeader) == 144 && sizeof(StateContact) == 64);

template <int D>
void put(double (&out)[3], const Vec<D>& v) {
  for (int d = 0; d < 3; ++d) out[d] = d < D ? v[d < D ? d : 0] : 0;
}

// ---- Kinds of tissue ------------------------------------------------------------------------------------------------------------------

template <class Number>
void destroy(Number* p) {
  p->~Number();
  std::free(p);
}
template <class Number, class... Given>
Number* create(Given&&... given) {
  void* memory = std::malloc(sizeof(Number));
  return memory ? new (memory) Number(static_cast<Given&&>(given)...) : nullptr;
}

template <int D>
struct Kind {
  typedef Scene<D> SceneOf;
  typedef Tissue<D> TissueOf;

  static TissueOf& tissue(void* t) { return *static_cast<TissueOf*>(t); }
  static const TissueOf& tissue(const void* t) { return *static_cast<const TissueOf*>(t); }
  static const SceneOf& scene(const void* s) { return *static_cast<const SceneOf*>(s); }
  static echospline_status status_of(typename TissueOf::Outcome outcome) {
    return outcome == TissueOf::done        ? ECHOSPLINE_OK
           : outcome == TissueOf::no_memory ? ECHOSPLINE_OUT_OF_MEMORY
                                            : ECHOSPLINE_NOT_SOLVED;
  }

  // -- tissue

  static void destroy_tissue(void* t) { destroy(&tissue(t)); }
  static void reset(void* t) { tissue(t).rest(); }
  static echospline_status advance(void* t, const echospline_pose& pose) { return status_of(tissue(t).advance(pose)); }

  template <class Number>
  static echospline_status displacement(void* t, Number* out) {
    return status_of(tissue(t).mesh(out));
  }
  static echospline_status displacement_at(void* t, const double* points, int64_t count, double* out) {
    return status_of(tissue(t).evaluate(points, count, out));
  }
  static echospline_status planes(void* t, const float** x, const float** y) {
    *x = *y = nullptr;
    return status_of(tissue(t).planes(*x, *y));
  }

  static int64_t landmarks(void* t, echospline_landmark* out, int64_t room) {
    const TissueOf& own = tissue(t);
    const State<D>& state = own.state;
    const int64_t total = state.count + (state.tip.present ? 1 : 0);
    for (int64_t j = 0; j < smaller(total, room); ++j) {
      echospline_landmark& mark = out[j];
      std::memset(&mark, 0, sizeof mark);
      if (j == state.count) {
        put(mark.place, state.tip.place), put(mark.displacement, state.tip.q);
        mark.node = -1, mark.kind = state.tip.pushed ? ECHOSPLINE_TIP : ECHOSPLINE_TIP_LEFT;
        continue;
      }
      const Contact<D>& contact = state.contacts[j];
      put(mark.place, own.scene.source[contact.source]), put(mark.displacement, contact.q),
          put(mark.grip, contact.grip);
      mark.along = contact.along, mark.node = own.scene.lattice.node[contact.source];
      mark.kind = contact.touching ? ECHOSPLINE_CONTACT : ECHOSPLINE_LEAVING;
    }
    return total;
  }
  static void statistics(void* t, echospline_statistics& out) {
    const TissueOf& own = tissue(t);
    out.steps = own.steps, out.joined = own.joined, out.left = own.left, out.rebuilt = own.rebuilt();
    out.held_back = own.state.held_back, out.allocations = own.allocations, out.residual = own.residual();
  }

  // -- states

  static int64_t state_size(const void* t) {
    return static_cast<int64_t>(sizeof(StateHeader) + sizeof(uint64_t)) +
           tissue(t).state.count * static_cast<int64_t>(sizeof(StateContact));
  }
  static void state_save(void* t, void* bytes) {
    const TissueOf& own = tissue(t);
    const State<D>& state = own.state;
    StateHeader header;
    std::memset(&header, 0, sizeof header);
    std::memcpy(header.magic, STATE_MAGIC, sizeof header.magic);
    header.version = STATE_VERSION, header.dimension = D, header.fingerprint = own.scene.fingerprint;
    header.count = state.count, header.held_back = state.held_back, header.posed = state.posed;
    header.tip = state.tip.present ? state.tip.pushed ? 1 : 2 : 0;
    put(header.place, state.tip.place), put(header.q, state.tip.q);
    put(header.entry, state.before.entry), put(header.tip_at, state.before.tip);
    unsigned char* p = static_cast<unsigned char*>(bytes);
    std::memcpy(p, &header, sizeof header);
    p += sizeof header;
    for (int64_t j = 0; j < state.count; ++j, p += sizeof(StateContact)) {
      const Contact<D>& contact = state.contacts[j];
      StateContact saved;
      std::memset(&saved, 0, sizeof saved);
      saved.source = contact.source, saved.touching = contact.touching, saved.along = contact.along;
      put(saved.q, contact.q), put(saved.grip, contact.grip);
      std::memcpy(p, &saved, sizeof saved);
    }
    const uint64_t sum = checksum(bytes, p - static_cast<unsigned char*>(bytes));
    std::memcpy(p, &sum, sizeof sum);
  }

  static echospline_status refuse(Message& message, const char* why) {
    std::snprintf(message.text, sizeof message.text,
                  "a state must be bytes that echospline_state_save wrote for this scene; %s", why);
    return ECHOSPLINE_WRONG_STATE;
  }
  static bool finite(const double (&v)[3]) { return std::isfinite(v[0]) && std::isfinite(v[1]) && std::isfinite(v[2]); }

  static echospline_status state_load(void* t, const void* bytes, int64_t size, Message& message) {
    TissueOf& own = tissue(t);
    const unsigned char* p = static_cast<const unsigned char*>(bytes);
    StateHeader header;
    if (size < static_cast<int64_t>(sizeof header + sizeof(uint64_t))) return refuse(message, "these are too few");
    std::memcpy(&header, p, sizeof header);
    if (std::memcmp(header.magic, STATE_MAGIC, sizeof header.magic) != 0)
      return refuse(message, "these begin differently");
    if (header.version != STATE_VERSION) return refuse(message, "these are of another version: save the state again");
    const int64_t K = own.scene.sources(), count = header.count;
    if (count < 0 || count > K ||
        size !=
            static_cast<int64_t>(sizeof header + sizeof(uint64_t)) + count * static_cast<int64_t>(sizeof(StateContact)))
      return refuse(message, "their number does not fit the contacts that they announce");
    uint64_t sum;
    std::memcpy(&sum, p + size - sizeof sum, sizeof sum);
    if (sum != checksum(bytes, size - static_cast<int64_t>(sizeof sum))) return refuse(message, "these are damaged");
    if (header.dimension != D || header.fingerprint != own.scene.fingerprint)
      return refuse(message, "these belong to a scene with another mesh, clamped or sliding edges, or parameters");
    if (!finite(header.place) || !finite(header.q) || !finite(header.entry) || !finite(header.tip_at) ||
        header.tip < 0 || header.tip > 2)
      return refuse(message, "a number in these is out of its range");
    int32_t last = -1;
    for (int64_t j = 0; j < count; ++j) {
      StateContact saved;
      std::memcpy(&saved, p + sizeof header + j * sizeof saved, sizeof saved);
      if (saved.source <= last || saved.source >= K || !finite(saved.q) || !finite(saved.grip) ||
          !std::isfinite(saved.along))
        return refuse(message, "a contact in these is out of its range");
      last = saved.source;
    }
    return status_of(own.restore(count, [&](Array<Contact<D>>& contacts, State<D>& state) {
      for (int64_t j = 0; j < count; ++j) {
        StateContact saved;
        std::memcpy(&saved, p + sizeof header + j * sizeof saved, sizeof saved);
        contacts[j] = {saved.source, saved.touching != 0, point_of<D>(saved.q), saved.along, point_of<D>(saved.grip)};
      }
      state.tip.present = header.tip != 0, state.tip.pushed = header.tip == 1;
      state.tip.place = point_of<D>(header.place), state.tip.q = point_of<D>(header.q);
      state.posed = header.posed != 0, state.before = {point_of<D>(header.entry), point_of<D>(header.tip_at)};
      state.held_back = header.held_back;
    }));
  }

  static constexpr TissueFunctions tissue_functions = {
      destroy_tissue, reset,     advance,    displacement<double>, displacement<float>, displacement_at,
      planes,         landmarks, statistics, state_size,           state_save,          state_load};

  // -- scene

  static void destroy_scene(void* s) { destroy(static_cast<SceneOf*>(s)); }
  static SceneCounts counts(const void* s) {
    const Grid<D>& grid = scene(s).grid;
    SceneCounts out = {D, grid.size(), scene(s).anchored.anchors, scene(s).sources(), {}, {}, {}};
    for (int d = 0; d < D; ++d)
      out.shape[d] = grid.shape[d], out.spacing[d] = grid.spacing[d], out.origin[d] = grid.origin[d];
    return out;
  }
  static void anchors(const void* s, double* out) {
    const SceneOf& own = scene(s);
    for (int64_t i = 0; i < own.anchored.anchors; ++i)
      for (int d = 0; d < D; ++d)
        out[i * D + d] = own.anchored.place[d][i] * own.anchored.scale + own.anchored.centre[d];
  }
  static void sources(const void* s, int64_t* out) {
    for (int64_t i = 0; i < scene(s).sources(); ++i) out[i] = scene(s).lattice.node[i];
  }
  static void* create_tissue(const void* s) {
    TissueOf* made = create<TissueOf>(scene(s));
    if (made && !made->build()) {
      destroy(made);
      made = nullptr;
    }
    return made;
  }
  static constexpr SceneFunctions scene_functions = {destroy_scene, counts,        anchors,
                                                     sources,       create_tissue, &tissue_functions};

  template <class Kernel>
  static KernelOf<D> kernel_for(const echospline_scene_options& o, double scale) {
    const double nu = D == 2 && o.plane == ECHOSPLINE_PLANE_STRESS ? o.poisson / (1 + o.poisson) : o.poisson;
    const double radius = o.radius / scale;
    return kernel_of<D, Kernel>(D == 2 ? 1 / (2 * (1 - nu)) : 1 / (1 - nu), radius * radius);
  }
  template <class Real>
  static typename SceneOf::FieldFor field_for(const echospline_scene_options& o) {
    return o.kernel == ECHOSPLINE_ELASTIC ? create_field<D, Elastic<D>, Real>
           : o.sliding                    ? create_field<D, PlatesApart<D>, Real>
                                          : create_field<D, ThinPlate<D>, Real>;
  }

  static echospline_status create_scene(const echospline_scene_options& o, void** out, const SceneFunctions** functions,
                                        Message& message) {
    typename SceneOf::FieldFor make_field =
        o.precision == ECHOSPLINE_SINGLE ? field_for<float>(o) : field_for<double>(o);
    SceneOf* made = create<SceneOf>();
    if (!made) return ECHOSPLINE_OUT_OF_MEMORY;
    for (int d = 0; d < D; ++d) {
      made->grid.shape[d] = o.shape[d], made->grid.spacing[d] = o.spacing[d], made->grid.origin[d] = o.origin[d];
      for (int side = 0; side < 2; ++side) {
        const int bit = 2 * d + side;
        made->clamps.edge[d][side] = o.clamped >> bit & 1   ? Edge::clamped
                                     : o.sliding >> bit & 1 ? Edge::sliding
                                                            : Edge::free;
      }
    }
    bool there = made->clamps.points.reserve(o.clamped_point_count) &&
                 made->stiffness.reserve(o.stiffness ? made->grid.size() : 0);
    for (int64_t i = 0; there && i < o.clamped_point_count; ++i)
      made->clamps.points[i] = point_of<D>(o.clamped_points + i * D);
    for (int64_t i = 0; there && i < made->stiffness.size(); ++i) made->stiffness[i] = o.stiffness[i];
    made->interaction = {o.sigma,
                         o.delta,
                         o.alpha1,
                         o.alpha2,
                         o.alpha3,
                         o.length,
                         o.drag,
                         o.friction_speed,
                         o.loading == ECHOSPLINE_IMMEDIATE,
                         o.loading == ECHOSPLINE_STICK,
                         o.tip == ECHOSPLINE_TIP_NODE};
    made->contact_room = o.contact_room > 0 ? o.contact_room : FIRST_ROOM;
    made->fingerprint = fingerprint(o);
    const auto kernel = [&](double scale) {
      return o.kernel == ECHOSPLINE_ELASTIC ? kernel_for<Elastic<D>>(o, scale)
             : o.sliding                    ? kernel_for<PlatesApart<D>>(o, scale)
                                            : kernel_for<ThinPlate<D>>(o, scale);
    };
    const typename SceneOf::Outcome outcome =
        there ? made->build(o.contact_spacing, o.anchor_spacing, kernel, make_field) : SceneOf::no_memory;
    if (outcome == SceneOf::ready) {
      *out = made, *functions = &scene_functions;
      return ECHOSPLINE_OK;
    }
    const AnchoredKernel<D>& anchored = made->anchored;
    const int64_t count = outcome == SceneOf::not_held ? anchored.held_by(anchored.loose) : 0;
    const char* flat = D == 2 ? "line" : "plane";
    if (anchored.systems > 1)
      std::snprintf(
          message.text, sizeof message.text,
          "what is held must determine the field; along %c the %lld anchors lie on one %s or are too few: clamp "
          "an edge, or let one that is normal to %c slide",
          "xyz"[anchored.loose], static_cast<long long>(count), flat, "xyz"[anchored.loose]);
    else
      std::snprintf(message.text, sizeof message.text,
                    "the %lld anchors along what is held must determine the field; they lie on one %s or are too few: "
                    "clamp another edge",
                    static_cast<long long>(anchored.anchors), flat);
    destroy(made);
    return outcome == SceneOf::no_memory ? ECHOSPLINE_OUT_OF_MEMORY : ECHOSPLINE_NOT_HELD;
  }
  /// Of everything that a state depends on.
  static uint64_t fingerprint(const echospline_scene_options& o) {
    const int32_t choices[] = {o.dimension, o.kernel, o.tip, o.loading, o.plane, static_cast<int32_t>(o.clamped)};
    const double numbers[] = {o.sigma, o.delta,           o.alpha1,         o.alpha2,  o.alpha3, o.length,
                              o.drag,  o.contact_spacing, o.anchor_spacing, o.poisson, o.radius, o.friction_speed};
    uint64_t sum = checksum(choices, sizeof choices);
    sum = checksum(numbers, sizeof numbers, sum);
    sum = checksum(o.shape, D * static_cast<int64_t>(sizeof *o.shape), sum);
    sum = checksum(o.spacing, D * static_cast<int64_t>(sizeof *o.spacing), sum);
    sum = checksum(o.origin, D * static_cast<int64_t>(sizeof *o.origin), sum);
    if (o.sliding) sum = checksum(&o.sliding, sizeof o.sliding, sum);
    sum = checksum(o.clamped_points, o.clamped_point_count * D * static_cast<int64_t>(sizeof(double)), sum);
    return checksum(o.stiffness, o.stiffness_count * static_cast<int64_t>(sizeof(double)), sum);
  }
};

echospline_status create_scene(const echospline_scene_options& o, void** scene, const SceneFunctions** functions,
                               Message& message) {
  return o.dimension == 2 ? Kind<2>::create_scene(o, scene, functions, message)
                          : Kind<3>::create_scene(o, scene, functions, message);
}

echospline_status follow_command(const echospline_pose& now, const echospline_command& command, echospline_pose& next) {
  follow<3>(now, command, next);
  return ECHOSPLINE_OK;
}

const TissueEntries tissue_entries = {create_scene, follow_command};

}  // namespace
}  // namespace echospline::ECHOSPLINE_CORE
