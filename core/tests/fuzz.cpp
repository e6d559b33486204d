// Misuse of the C interface by random bytes: wrong sizes, numbers that are not finite, NULL, calls in any order, damaged states.
//
// Whatever comes, a call returns a status that the header knows, a failed call leaves a message, and a displacement that is
// handed out is finite. Sanitizers see the rest. With clang it is a libFuzzer target; elsewhere `main` below draws the bytes:
//
//     fuzz SECONDS [SEED]
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <vector>

#include "echospline/space.h"

namespace {

void require(bool right, const char* what) {
  if (right) return;
  std::fprintf(stderr, "fuzz: %s\n", what);
  std::abort();
}

/// Choices made from the input; zeros when it has ended.
class Choices {
 public:
  Choices(const uint8_t* data, size_t size) : data_(data), size_(size) {}
  bool ended() const { return at_ >= size_; }
  uint8_t byte() { return at_ < size_ ? data_[at_++] : 0; }
  /// One of `count`.
  int below(int count) { return byte() % count; }
  bool rarely() { return byte() > 245; }
  /// A number in [low, high], or one that nobody should pass.
  double number(double low, double high) {
    static const double wrong[] = {std::nan(""), INFINITY, -INFINITY, 0.0, -1.0, 1e308, -1e308, 5e-324, 1e-30, 1e30};
    if (rarely()) return wrong[below(10)];
    return low + (high - low) * (byte() * 256 + byte()) / 65535.0;
  }
  int32_t whole(int32_t low, int32_t high) {
    static const int32_t wrong[] = {0, -1, 1, 2, 99, INT32_MAX, INT32_MIN};
    return rarely() ? wrong[below(7)] : low + below(high - low + 1);
  }
  int64_t size(int64_t right) {
    const int64_t wrong[] = {0, -1, right - 1, right + 1, INT64_MIN};
    return rarely() ? wrong[below(5)] : right;
  }

 private:
  const uint8_t* data_;
  size_t size_, at_ = 0;
};

/// One scene, its tissues' handles, and what was saved.
class Session {
 public:
  explicit Session(Choices& choices) : choices_(choices) {}
  ~Session() {
    leave();
    echospline_picture_destroy(picture_);
    echospline_forced_destroy(forced_);
    echospline_spatial_destroy(spatial_);
  }

  void act() {
    switch (choices_.below(64)) {
      case 0: open(); break;
      case 1: reset(); break;
      case 2:
      case 3: read(); break;
      case 4: read_at(); break;
      case 5: landmarks(); break;
      case 6: statistics(); break;
      case 7:
      case 8: save(); break;
      case 9:
      case 10: load(); break;
      case 11: getters(); break;
      case 12: follow(); break;
      case 13: nothing(); break;
      case 14:
      case 15: open_picture(); break;
      case 16:
      case 17: deform(); break;
      case 18: follow_tissue(); break;
      case 19:
      case 20:
      case 21: draw(); break;
      case 38:
      case 39: open_forced(); break;
      case 40: save_forced(); break;
      case 41:
      case 42: load_forced(); break;
      case 43: read_forced(); break;
      case 44: answer_forced(); break;
      case 45:
      case 46:
      case 47:
      case 48:
      case 49:
      case 50:
      case 51: advance_forced(); break;
      case 56: open_spatial(); break;
      case 57: save_spatial(); break;
      case 58: load_spatial(); break;
      case 59: read_spatial(); break;
      case 60:
      case 61:
      case 62:
      case 63: advance_spatial(); break;
      default: advance(); break;
    }
  }

 private:
  bool given() { return !choices_.rarely(); }
  echospline_tissue* tissue() { return given() ? tissue_ : nullptr; }

  void known(echospline_status status, const char* message, bool has_handle) {
    require(status >= ECHOSPLINE_OK && status <= ECHOSPLINE_NEEDS_STATION, "a status that the header does not know");
    require(std::strcmp(echospline_status_text(status), "unknown status") != 0, "a status without a name");
    if (status != ECHOSPLINE_OK && has_handle) require(message && *message, "a failure without a message");
  }
  echospline_status result_of(echospline_tissue* tissue, echospline_status status) {
    known(status, echospline_tissue_message(tissue), tissue != nullptr);
    if (!tissue) require(status != ECHOSPLINE_OK, "NULL was taken for a tissue");
    return status;
  }

  void open() {
    leave();
    echospline_scene_options o;
    std::memset(&o, 0, sizeof o);
    o.struct_size = static_cast<uint32_t>(choices_.size(sizeof o));
    if (choices_.rarely()) o.struct_size = choices_.byte();
    echospline_scene_defaults(&o);
    o.struct_size = choices_.rarely() ? choices_.byte() : sizeof o;
    o.dimension = choices_.whole(2, 3);
    o.kernel = choices_.whole(0, 1);
    o.precision = choices_.whole(0, 1);
    o.tip = choices_.whole(0, 1);
    o.loading = choices_.whole(0, 2);
    o.plane = choices_.whole(0, 1);
    if (choices_.below(4) == 0) o.clamped = choices_.byte();
    if (choices_.below(4) == 0) o.sliding = choices_.byte() & (choices_.below(4) ? ~o.clamped : ~0u);
    o.level = choices_.below(4) == 0 ? choices_.whole(0, 5) : ECHOSPLINE_LEVEL_BEST;
    const int32_t most = o.dimension == 3 ? 6 : 17;
    for (int k = 0; k < 3; ++k) {
      o.shape[k] = choices_.whole(2, most);
      o.spacing[k] = choices_.number(0.5, 3);
      if (choices_.below(4) == 0) o.origin[k] = choices_.number(-20, 20);
    }
    o.anchor_spacing = choices_.number(2, 9);
    double* numbers[] = {&o.sigma,  &o.delta, &o.alpha1,          &o.alpha2, &o.alpha3,
                         &o.length, &o.drag,  &o.contact_spacing, &o.radius, &o.friction_speed};
    for (double* number : numbers)
      if (choices_.below(8) == 0) *number = choices_.number(0, 2);
    if (choices_.below(8) == 0) o.poisson = choices_.number(0, 0.5);
    o.contact_room = choices_.below(8) == 0 ? choices_.whole(0, 8) : 0;
    double points[6], *stiffness = nullptr;
    if (choices_.below(4) == 0) {
      for (double& x : points) x = choices_.number(0, 20);
      o.clamped_points = given() ? points : nullptr;
      o.clamped_point_count = choices_.below(3);
    }
    int64_t nodes = 1;  // 0: a shape that has to be refused, or one too large to give every node a stiffness
    for (int k = 0; k < (o.dimension == 3 ? 3 : 2); ++k) nodes *= o.shape[k] > 1 && o.shape[k] < 100 ? o.shape[k] : 0;
    if (nodes && choices_.below(4) == 0) {
      stiffness = static_cast<double*>(std::malloc(nodes * sizeof(double)));
      for (int64_t i = 0; i < nodes; ++i) stiffness[i] = 0.5 + i % 3;
      stiffness[choices_.byte() % nodes] = choices_.number(0.1, 10);
      o.stiffness = stiffness;
      o.stiffness_count = nodes;
      if (choices_.rarely()) o.stiffness_count = choices_.below(2);  // never more than there are
    }
    echospline_scene** where = given() ? &scene_ : nullptr;
    const echospline_status status = echospline_scene_create(given() ? &o : nullptr, where);
    known(status, echospline_scene_message(scene_), scene_ != nullptr);
    std::free(stiffness);
    if (status == ECHOSPLINE_OK) {
      require(scene_ && where, "a scene was made of nothing");
      dimension_ = o.dimension, nodes_ = echospline_scene_node_count(scene_);
      require(nodes_ == nodes || nodes == 0, "the scene's nodes are not its shape's");
      for (int k = 0; k < 3; ++k)
        shape_[k] = o.shape[k], origin_[k] = o.origin[k], extent_[k] = o.spacing[k] * (o.shape[k] - 1.0);
    }
    const echospline_status made = echospline_tissue_create(given() ? scene_ : nullptr, given() ? &tissue_ : nullptr);
    known(made, echospline_tissue_message(tissue_), tissue_ != nullptr);
    if (status != ECHOSPLINE_OK) require(made != ECHOSPLINE_OK, "a tissue was made in a failed scene");
    good_ = made == ECHOSPLINE_OK;
  }

  void leave() {
    echospline_tissue_destroy(tissue_);
    echospline_scene_destroy(scene_);
    tissue_ = nullptr, scene_ = nullptr, good_ = false, nodes_ = 0;
  }

  double place(int k, double low, double high) { return origin_[k] + extent_[k] * choices_.number(low, high); }

  void advance() {
    if (choices_.below(4) == 0) entry_[0] = place(0, 0.2, 0.8), entry_[1] = origin_[1], entry_[2] = place(2, 0.3, 0.7);
    echospline_pose pose;
    for (int k = 0; k < 3; ++k) pose.entry[k] = entry_[k], pose.tip[k] = place(k, k == 1 ? -0.1 : 0.1, 0.9);
    pose.speed = choices_.number(-10, 10);
    pose.dt = choices_.number(0, 0.1);
    echospline_tissue* t = tissue();
    const echospline_status status = result_of(t, echospline_advance(t, given() ? &pose : nullptr));
    if (status != ECHOSPLINE_OK && good_) read();
  }

  void reset() {
    echospline_tissue* t = tissue();
    result_of(t, echospline_tissue_reset(t));
  }

  void read() {
    const int64_t right = nodes_ * dimension_, count = choices_.size(right);
    echospline_tissue* t = tissue();
    if (choices_.below(2)) {
      std::vector<float> field(right);
      if (result_of(t, echospline_displacement_single(t, given() ? field.data() : nullptr, count)) == ECHOSPLINE_OK)
        for (float u : field) require(std::isfinite(u), "a displacement that is not finite");
    } else {
      std::vector<double> field(right);
      if (result_of(t, echospline_displacement(t, given() ? field.data() : nullptr, count)) == ECHOSPLINE_OK)
        for (double u : field) require(std::isfinite(u), "a displacement that is not finite");
    }
  }

  void read_at() {
    double points[9], field[9];
    for (int i = 0; i < 9; ++i) points[i] = place(i % dimension_, -1, 2);
    const int64_t wrong[] = {-1, INT64_MIN, INT64_MAX},
                  count = choices_.rarely() ? wrong[choices_.below(2)] : choices_.below(4);
    echospline_tissue* t = tissue();
    if (result_of(t, echospline_displacement_at(t, given() ? points : nullptr, count, given() ? field : nullptr)) ==
        ECHOSPLINE_OK)
      for (int64_t i = 0; i < count * dimension_; ++i)
        require(std::isfinite(field[i]), "a displacement that is not finite");
  }

  void landmarks() {
    const int64_t room = choices_.below(40), given_room = choices_.rarely() ? -1 : room;
    std::vector<echospline_landmark> list(room);
    int64_t count = 0;
    echospline_tissue* t = tissue();
    result_of(t, echospline_landmarks(t, given() ? list.data() : nullptr, given_room, given() ? &count : nullptr));
    require(count >= 0, "a negative number of landmarks");
  }

  void statistics() {
    echospline_statistics s;
    std::memset(&s, 0, sizeof s);
    s.struct_size = static_cast<uint32_t>(choices_.size(sizeof s));
    if (choices_.rarely()) s.struct_size = choices_.byte() % (sizeof s + 1);
    if (s.struct_size > sizeof s + 8) s.struct_size = 0;
    echospline_tissue* t = tissue();
    result_of(t, echospline_tissue_statistics(t, given() ? &s : nullptr));
  }

  void save() {
    echospline_tissue* t = tissue();
    const int64_t size = echospline_state_size(t);
    require(size >= 0 && size < (1 << 24), "the size of a state");
    const int64_t room = choices_.size(size);
    std::vector<uint8_t> bytes(size);
    if (result_of(t, echospline_state_save(t, given() ? bytes.data() : nullptr, room)) == ECHOSPLINE_OK && size <= room)
      saved_ = bytes;
  }

  void load() {
    if (saved_.empty()) return;
    std::vector<uint8_t> bytes = saved_;
    for (int n = choices_.below(3); n > 0; --n)
      bytes[(choices_.byte() * 256 + choices_.byte()) % bytes.size()] ^= 1 << choices_.below(8);
    if (choices_.below(6) == 0) bytes.resize(bytes.size() * choices_.byte() / 256);
    if (choices_.rarely()) bytes.resize(bytes.size() + choices_.byte());
    echospline_tissue* t = tissue();
    result_of(
        t, echospline_state_load(t, given() ? bytes.data() : nullptr, choices_.rarely() ? -1 : int64_t(bytes.size())));
    if (good_) read();
  }

  void getters() {
    echospline_scene* scene = given() ? scene_ : nullptr;
    const int64_t anchors = echospline_scene_anchor_count(scene), sources = echospline_scene_source_count(scene);
    require(anchors >= 0 && sources >= 0 && echospline_scene_node_count(scene) >= 0, "a negative count");
    require(echospline_level_name(echospline_scene_level(scene)) != nullptr, "a level without a name");
    std::vector<double> places(anchors * 3);
    std::vector<int64_t> nodes(sources);
    known(echospline_scene_anchors(scene, given() ? places.data() : nullptr, choices_.size(anchors * dimension_)),
          echospline_scene_message(scene), scene != nullptr);
    known(echospline_scene_sources(scene, given() ? nodes.data() : nullptr, choices_.size(sources)),
          echospline_scene_message(scene), scene != nullptr);
  }

  void follow() {
    echospline_pose now, next;
    echospline_command command;
    for (int k = 0; k < 3; ++k) {
      now.entry[k] = choices_.number(0, 20), now.tip[k] = choices_.number(0, 20);
      command.entry[k] = choices_.number(0, 20), command.tip[k] = choices_.number(0, 20);
    }
    now.speed = 0, now.dt = 0;
    command.lag = choices_.number(0, 1), command.fastest = choices_.number(0, 50);
    next.dt = choices_.number(0, 0.1);
    known(echospline_follow(given() ? &now : nullptr, given() ? &command : nullptr, given() ? &next : nullptr), nullptr,
          false);
  }

  echospline_forced* forced() { return given() ? forced_ : nullptr; }
  echospline_status of_forced(echospline_forced* forced, echospline_status status) {
    known(status, echospline_forced_message(forced), forced != nullptr);
    if (!forced) require(status != ECHOSPLINE_OK, "NULL was taken for a forced tissue");
    return status;
  }

  void open_forced() {
    echospline_forced_destroy(forced_);
    forced_ = nullptr, forced_nodes_ = 0;
    echospline_forced_options o;
    std::memset(&o, 0, sizeof o);
    o.struct_size = sizeof o;
    echospline_forced_defaults(&o);
    if (choices_.rarely()) o.struct_size = choices_.byte();
    o.level = choices_.below(4) == 0 ? choices_.whole(0, 5) : ECHOSPLINE_LEVEL_BEST;
    o.node_count = choices_.size(choices_.whole(1, 30));
    for (int k = 0; k < 2; ++k) o.low[k] = choices_.number(-5, 5), o.high[k] = o.low[k] + choices_.number(5, 30);
    double* numbers[] = {&o.tip,       &o.friction_limit,  &o.bond,    &o.tip_stiffness, &o.side_stiffness,
                         &o.viscosity, &o.station_spacing, &o.substep, &o.dead_band};
    for (double* number : numbers)
      if (choices_.below(8) == 0) *number = choices_.number(0, 2);
    const echospline_status status = echospline_forced_create(given() ? &o : nullptr, given() ? &forced_ : nullptr);
    known(status, echospline_forced_message(forced_), forced_ != nullptr);
    if (status == ECHOSPLINE_OK) forced_nodes_ = o.node_count < 100 ? o.node_count : 0;
    for (int k = 0; k < 2; ++k) forced_low_[k] = o.low[k], forced_size_[k] = o.high[k] - o.low[k];
  }

  /// Answer what is wanted: mostly by a compliance, else by any numbers.
  bool answer_forced() {
    echospline_station station;
    std::memset(&station, 0, sizeof station);
    echospline_forced* f = forced();
    if (of_forced(f, echospline_forced_wanted(f, given() ? &station : nullptr)) != ECHOSPLINE_OK) return false;
    require(station.index >= 0 && station.index < 1000 && station.point_count >= 0 && station.point_count <= 4,
            "a wanted station that cannot be");
    const bool wild = choices_.rarely();
    std::vector<float> columns(4 * forced_nodes_);
    std::vector<double> rows(4 * (station.index + 1));
    for (float& u : columns) u = static_cast<float>(wild ? choices_.number(-5, 5) : 0.25);
    for (size_t i = 0; i < rows.size(); ++i) {
      const bool own = i + 4 >= rows.size();
      rows[i] = wild ? choices_.number(-5, 5) : i % 4 == 1 || i % 4 == 2 ? 0.0 : own ? 2.0 : 0.5;
    }
    return of_forced(f, echospline_forced_answer(
                            f, given() ? columns.data() : nullptr, choices_.size(int64_t(columns.size())),
                            given() ? rows.data() : nullptr, choices_.size(int64_t(rows.size())))) == ECHOSPLINE_OK;
  }

  void advance_forced() {
    if (choices_.below(4) == 0) forced_entry_ = forced_low_[0] + forced_size_[0] * choices_.number(0.2, 0.8);
    echospline_pose pose;
    std::memset(&pose, 0, sizeof pose);
    pose.entry[0] = forced_entry_, pose.entry[1] = forced_low_[1] - choices_.below(2);
    for (int k = 0; k < 2; ++k) pose.tip[k] = forced_low_[k] + forced_size_[k] * choices_.number(0.1, 1.1);
    pose.dt = choices_.number(0, 0.1);
    echospline_forced* f = forced();
    for (int i = 0; i < 60; ++i) {
      if (of_forced(f, echospline_forced_advance(f, given() ? &pose : nullptr)) != ECHOSPLINE_NEEDS_STATION) break;
      if (!answer_forced()) break;
    }
    read_forced();
  }

  void read_forced() {
    echospline_forced* f = forced();
    echospline_needle_load load;
    if (of_forced(f, echospline_forced_load(f, given() ? &load : nullptr)) == ECHOSPLINE_OK && f)
      require(std::isfinite(load.tip) && std::isfinite(load.torque) && load.tip >= 0, "a force that is not finite");
    std::vector<double> forces(2 * 40), field(2 * forced_nodes_);
    int64_t count = 0;
    of_forced(f, echospline_forced_forces(f, given() ? forces.data() : nullptr, choices_.below(41),
                                          given() ? &count : nullptr));
    require(count >= 0, "a negative number of forces");
    std::vector<echospline_station> stations(choices_.below(8));
    of_forced(f, echospline_forced_stations(f, given() ? stations.data() : nullptr, int64_t(stations.size()),
                                            given() ? &count : nullptr));
    if (of_forced(f, echospline_forced_displacement(f, given() ? field.data() : nullptr,
                                                    choices_.size(int64_t(field.size())))) == ECHOSPLINE_OK)
      for (double u : field) require(std::isfinite(u), "a displacement that is not finite");
    if (choices_.rarely()) of_forced(f, echospline_forced_reset(f));
  }

  void save_forced() {
    echospline_forced* f = forced();
    const int64_t size = echospline_forced_state_size(f);
    require(size >= 0 && size < (1 << 24), "the size of a state");
    std::vector<uint8_t> bytes(size);
    const int64_t room = choices_.size(size);
    if (of_forced(f, echospline_forced_state_save(f, given() ? bytes.data() : nullptr, room)) == ECHOSPLINE_OK &&
        size <= room)
      forced_saved_ = bytes;
  }

  void load_forced() {
    if (forced_saved_.empty()) return;
    std::vector<uint8_t> bytes = forced_saved_;
    for (int n = choices_.below(3); n > 0; --n)
      bytes[(choices_.byte() * 256 + choices_.byte()) % bytes.size()] ^= 1 << choices_.below(8);
    if (choices_.below(6) == 0) bytes.resize(bytes.size() * choices_.byte() / 256);
    echospline_forced* f = forced();
    of_forced(f, echospline_forced_state_load(f, given() ? bytes.data() : nullptr,
                                              choices_.rarely() ? -1 : int64_t(bytes.size())));
    read_forced();
  }

  echospline_spatial* spatial() { return given() ? spatial_ : nullptr; }
  echospline_status of_spatial(echospline_spatial* spatial, echospline_status status) {
    known(status, echospline_spatial_message(spatial), spatial != nullptr);
    if (!spatial) require(status != ECHOSPLINE_OK, "NULL was taken for a tissue in space");
    return status;
  }

  /// Half space whose faces answer weakly, or at random; without sources the host answers.
  void open_spatial() {
    constexpr int sources = 2, conditions = 3, most = (3 * sources + 6) * 3 * conditions;
    static const double places[3 * sources] = {-20, 5, 0, 20, 5, 0};
    double points[3 * conditions] = {-10, 5, 0, 10, 5, 0, 0, 15, 0}, answers[most];
    uint32_t faces[conditions] = {ECHOSPLINE_LEFT, ECHOSPLINE_RIGHT, ECHOSPLINE_BOTTOM};
    echospline_spatial_destroy(spatial_);
    spatial_ = nullptr;
    echospline_spatial_options o;
    std::memset(&o, 0, sizeof o);
    o.struct_size = sizeof o;
    echospline_spatial_defaults(&o);
    if (choices_.rarely()) o.struct_size = choices_.byte();
    o.level = choices_.below(4) == 0 ? choices_.whole(0, 5) : ECHOSPLINE_LEVEL_BEST;
    for (int k = 0; k < 3; ++k) {
      o.low[k] = k == 1 ? 0 : choices_.number(-12, -8), o.high[k] = choices_.number(10, 16);
      o.lattice_shape[k] = choices_.whole(4, 6), o.lattice_spacing[k] = choices_.number(5, 8);
      o.lattice_origin[k] = choices_.number(-14, -10);
    }
    double* numbers[] = {&o.tip,           &o.friction_limit,  &o.bond,          &o.tip_stiffness,  &o.side_stiffness,
                         &o.viscosity,     &o.station_spacing, &o.substep,       &o.dead_band,      &o.poisson,
                         &o.shear_modulus, &o.radius,          &o.source_radius, &o.traction_length};
    for (double* number : numbers)
      if (choices_.below(16) == 0) *number = choices_.number(0, 2);
    const double wild = choices_.rarely() ? 10 : 0;
    for (double& answer : answers) answer = wild > 0 ? choices_.number(-wild, wild) : 0;
    for (double& point : points)
      if (choices_.rarely()) point = choices_.number(-20, 20);
    if (choices_.rarely()) faces[choices_.below(conditions)] = static_cast<uint32_t>(choices_.whole(0, 64));
    o.top = choices_.whole(0, 2);
    o.clamped = choices_.rarely() ? choices_.byte() : 33u, o.sliding = choices_.rarely() ? choices_.byte() : 2u;
    o.sources = given() ? places : nullptr, o.source_count = choices_.below(3) ? sources : 0;
    o.conditions = given() ? points : nullptr, o.condition_faces = given() ? faces : nullptr;
    o.condition_count = conditions, o.answers = given() ? answers : nullptr;
    o.answer_count = choices_.size((3 * sources + (o.top == ECHOSPLINE_TOP_SLIDING ? 3 : 6)) * 3 * conditions);
    const echospline_status status = echospline_spatial_create(given() ? &o : nullptr, given() ? &spatial_ : nullptr);
    known(status, echospline_spatial_message(spatial_), spatial_ != nullptr);
  }

  bool answer_spatial() {
    echospline_spatial_station station;
    std::memset(&station, 0, sizeof station);
    echospline_spatial* s = spatial();
    if (of_spatial(s, echospline_spatial_wanted(s, given() ? &station : nullptr)) != ECHOSPLINE_OK) return false;
    require(station.index >= 0 && station.index < 1000 && station.point_count >= 0 && station.point_count <= 4,
            "a wanted station that cannot be");
    const bool wild = choices_.rarely();
    std::vector<double> rows(9 * (station.index + 1));
    for (size_t i = 0; i < rows.size(); ++i) {
      const bool own = i + 9 >= rows.size();
      rows[i] = wild ? choices_.number(-5, 5) : i % 9 % 4 != 0 ? 0.0 : own ? 2.0 : 0.5;
    }
    return of_spatial(s, echospline_spatial_answer(s, given() ? rows.data() : nullptr,
                                                   choices_.size(int64_t(rows.size())))) == ECHOSPLINE_OK;
  }

  void advance_spatial() {
    if (!spatial_) open_spatial();
    if (choices_.below(4) == 0) spatial_entry_ = choices_.number(-6, 6);
    echospline_pose pose;
    std::memset(&pose, 0, sizeof pose);
    pose.entry[0] = spatial_entry_, pose.entry[1] = -choices_.below(2), pose.entry[2] = 1;
    for (int k = 0; k < 3; ++k) pose.tip[k] = choices_.number(k == 1 ? -2 : -8, 12);
    pose.dt = choices_.number(0, 0.1);
    echospline_spatial* s = spatial();
    for (int i = 0; i < 60; ++i) {
      if (of_spatial(s, echospline_spatial_advance(s, given() ? &pose : nullptr)) != ECHOSPLINE_NEEDS_STATION) break;
      if (!answer_spatial()) break;
    }
    read_spatial();
  }

  void read_spatial() {
    echospline_spatial* s = spatial();
    echospline_spatial_load load;
    if (of_spatial(s, echospline_spatial_needle(s, given() ? &load : nullptr)) == ECHOSPLINE_OK && s)
      require(std::isfinite(load.tip) && std::isfinite(load.torque[2]) && load.tip >= 0, "a force that is not finite");
    std::vector<double> forces(3 * 40);
    int64_t count = 0;
    of_spatial(s, echospline_spatial_forces(s, given() ? forces.data() : nullptr, choices_.below(41),
                                            given() ? &count : nullptr));
    require(count >= 0, "a negative number of forces");
    std::vector<echospline_spatial_station> stations(choices_.below(8));
    of_spatial(s, echospline_spatial_stations(s, given() ? stations.data() : nullptr, int64_t(stations.size()),
                                              given() ? &count : nullptr));
    echospline_force_field field;
    std::memset(&field, 0, sizeof field);
    field.struct_size = choices_.rarely() ? choices_.byte() : sizeof field;
    const double at[6] = {1, 2, 3, choices_.number(-9, 9), choices_.number(0, 15), choices_.number(-9, 9)};
    double u[6] = {};
    if (of_spatial(s, echospline_spatial_field(s, given() ? &field : nullptr)) == ECHOSPLINE_OK &&
        echospline_force_field_at(&field, at, 2, u) == ECHOSPLINE_OK)
      for (double v : u) require(std::isfinite(v), "a displacement that is not finite");
    if (choices_.rarely()) of_spatial(s, echospline_spatial_reset(s));
  }

  void save_spatial() {
    echospline_spatial* s = spatial();
    const int64_t size = echospline_spatial_state_size(s);
    require(size >= 0 && size < (1 << 24), "the size of a state");
    std::vector<uint8_t> bytes(size);
    const int64_t room = choices_.size(size);
    if (of_spatial(s, echospline_spatial_state_save(s, given() ? bytes.data() : nullptr, room)) == ECHOSPLINE_OK &&
        size <= room)
      spatial_saved_ = bytes;
  }

  void load_spatial() {
    if (spatial_saved_.empty()) return;
    std::vector<uint8_t> bytes = spatial_saved_;
    for (int n = choices_.below(3); n > 0; --n)
      bytes[(choices_.byte() * 256 + choices_.byte()) % bytes.size()] ^= 1 << choices_.below(8);
    if (choices_.below(6) == 0) bytes.resize(bytes.size() * choices_.byte() / 256);
    echospline_spatial* s = spatial();
    of_spatial(s, echospline_spatial_state_load(s, given() ? bytes.data() : nullptr,
                                                choices_.rarely() ? -1 : int64_t(bytes.size())));
    read_spatial();
  }

  echospline_picture* picture() { return given() ? picture_ : nullptr; }
  echospline_status drawn(echospline_picture* picture, echospline_status status) {
    known(status, echospline_picture_message(picture), picture != nullptr);
    if (!picture) require(status != ECHOSPLINE_OK, "NULL was taken for a picture");
    return status;
  }

  void open_picture() {
    echospline_picture_destroy(picture_);
    picture_ = nullptr, mesh_nodes_ = 0, pixels_ = 0;
    echospline_picture_options o;
    std::memset(&o, 0, sizeof o);
    o.struct_size = sizeof o;
    echospline_picture_defaults(&o);
    if (choices_.rarely()) o.struct_size = choices_.byte();
    o.pixel_type = choices_.whole(0, 3);
    o.channels = choices_.below(2) ? choices_.whole(1, 3) : 1;
    o.interpolation = choices_.whole(0, 1);
    o.border = choices_.whole(0, 1);
    o.method = choices_.whole(0, 2);
    o.level = choices_.below(4) == 0 ? choices_.whole(0, 5) : ECHOSPLINE_LEVEL_BEST;
    o.columns = choices_.whole(1, 70);
    o.rows = choices_.whole(1, 70);
    for (int k = 0; k < 2; ++k) {
      o.mesh_shape[k] = choices_.whole(2, 12);
      o.spacing[k] = choices_.number(0.1, 0.5);
      o.mesh_spacing[k] = choices_.number(0.5, 3);
      if (choices_.below(4) == 0) o.origin[k] = choices_.number(-5, 5), o.mesh_origin[k] = choices_.number(-5, 5);
    }
    if (choices_.below(2))  // the mesh of the scene, so that the picture can follow its tissue
      for (int k = 0; k < 2; ++k)
        o.mesh_shape[k] = shape_[k], o.mesh_spacing[k] = extent_[k] / (shape_[k] - 1.0), o.mesh_origin[k] = origin_[k];
    if (choices_.below(4) == 0) o.border_value = choices_.number(0, 300);
    if (choices_.below(4) == 0) o.white = choices_.number(0, 300);
    const bool small =
        o.columns > 0 && o.columns < 100 && o.rows > 0 && o.rows < 100 && o.channels > 0 && o.channels < 4;
    static const int sizes[] = {1, 2, 2, 4};
    const int64_t bytes = small ? int64_t(o.columns) * o.rows * o.channels * sizes[o.pixel_type & 3] : 0;
    std::vector<uint8_t> pixels(bytes);
    for (uint8_t& byte : pixels) byte = choices_.byte();
    // what is larger than `pixels` must be refused before it is read, so it is not handed over
    const echospline_status status = echospline_picture_create(
        given() ? &o : nullptr, given() && bytes ? pixels.data() : nullptr, given() ? &picture_ : nullptr);
    known(status, echospline_picture_message(picture_), picture_ != nullptr);
    if (status == ECHOSPLINE_OK)
      mesh_nodes_ = int64_t(o.mesh_shape[0]) * o.mesh_shape[1], pixels_ = int64_t(o.columns) * o.rows, bytes_ = bytes;
  }

  void deform() {
    echospline_picture* p = picture();
    const int64_t count = choices_.size(2 * mesh_nodes_);
    std::vector<float> single(2 * mesh_nodes_);
    for (float& u : single) u = static_cast<float>(choices_.number(-1, 1));
    const std::vector<double> field(single.begin(), single.end());
    if (choices_.below(2))
      drawn(p, echospline_picture_deform(p, given() ? field.data() : nullptr, count));
    else
      drawn(p, echospline_picture_deform_single(p, given() ? single.data() : nullptr, count));
  }

  void follow_tissue() {
    echospline_picture* p = picture();
    echospline_tissue* t = tissue();
    const echospline_status status = drawn(p, echospline_picture_follow(p, t));
    if (!t || dimension_ != 2) require(status != ECHOSPLINE_OK, "a picture followed no tissue of the plane");
  }

  void draw() {
    echospline_picture* p = picture();
    echospline_needle needle;
    std::memset(&needle, 0, sizeof needle);
    needle.struct_size = sizeof needle;
    echospline_needle_defaults(&needle);
    if (choices_.rarely()) needle.struct_size = choices_.byte();
    if (choices_.below(4) == 0) needle.parts = choices_.byte() & (choices_.rarely() ? 255 : 15);
    needle.seed = choices_.byte();
    needle.curved = choices_.below(4) == 0 ? choices_.whole(0, 1) : 0;
    for (int k = 0; k < 3; ++k) needle.entry[k] = choices_.number(-2, 12), needle.tip[k] = choices_.number(-2, 12);
    for (double& x : needle.apex) x = choices_.number(-30, 30);
    double* numbers[] = {&needle.diameter,        &needle.lateral,        &needle.axial,          &needle.elevation,
                         &needle.elevation_depth, &needle.element_height, &needle.f_number,       &needle.dynamic_range,
                         &needle.specular,        &needle.lobe,           &needle.lobe_elevation, &needle.steering,
                         &needle.roughness,       &needle.rolloff,        &needle.wobble,         &needle.patches,
                         &needle.bevel,           &needle.ring_down,      &needle.ring_down_loss, &needle.opacity};
    for (double* number : numbers)
      if (choices_.rarely()) *number = choices_.number(-10, 40);
    const echospline_needle* seen = choices_.below(8) ? &needle : nullptr;
    const int what = choices_.below(6);
    if (what == 0) {
      std::vector<float> x(pixels_), y(pixels_);
      drawn(p, echospline_picture_inverse(p, given() ? x.data() : nullptr, given() ? y.data() : nullptr,
                                          choices_.size(pixels_)));
    } else if (what == 1) {
      echospline_picture_report report;
      std::memset(&report, 0, sizeof report);
      report.struct_size = choices_.rarely() ? choices_.byte() % sizeof report : sizeof report;
      drawn(p, echospline_picture_check(p, given() ? &report : nullptr));
    } else if (what == 2) {
      double points[8], power[4], transmission[4];
      for (double& x : points) x = choices_.number(-5, 20);
      const int64_t count = choices_.rarely() ? -1 : choices_.below(5);
      if (drawn(p, echospline_picture_echo(p, seen, given() ? points : nullptr, count, given() ? power : nullptr,
                                           transmission)) == ECHOSPLINE_OK)
        for (int64_t i = 0; i < count; ++i)
          require(std::isfinite(power[i]) && power[i] >= 0 && transmission[i] >= 0 && transmission[i] <= 1.0001,
                  "an echo that is none");
    } else if (what == 3) {
      std::vector<uint8_t> pixels(bytes_, choices_.byte());
      drawn(p, echospline_picture_reference(p, given() ? pixels.data() : nullptr, choices_.size(bytes_)));
    } else {
      const int64_t size = echospline_picture_size(p);
      require(size >= 0 && size < (1 << 26), "the size of a picture");
      std::vector<uint8_t> out(size);
      drawn(p, echospline_picture_draw(p, seen, given() ? out.data() : nullptr, choices_.size(size)));
    }
    require(echospline_level_name(echospline_picture_level(p)) != nullptr, "a level without a name");
  }

  void nothing() {
    echospline_picture_destroy(nullptr);
    echospline_picture_defaults(nullptr);
    echospline_needle_defaults(nullptr);
    echospline_picture_message(nullptr);
    echospline_tissue_destroy(nullptr);
    echospline_scene_destroy(nullptr);
    echospline_scene_defaults(nullptr);
    echospline_scene_message(nullptr);
    echospline_tissue_message(nullptr);
    const int32_t any = choices_.whole(-3, 9);
    require(echospline_status_text(any) && echospline_level_name(any), "a text that is NULL");
    require(echospline_level_available(any) == 0 || (any >= 0 && any <= 5), "a level that the header does not know");
    require(echospline_level_available(echospline_level_best()) == 1, "the best level is not available");
  }

  Choices& choices_;
  echospline_scene* scene_ = nullptr;
  echospline_tissue* tissue_ = nullptr;
  echospline_forced* forced_ = nullptr;
  int64_t forced_nodes_ = 0;
  double forced_low_[2] = {}, forced_size_[2] = {20, 20}, forced_entry_ = 5;
  std::vector<uint8_t> forced_saved_;
  echospline_spatial* spatial_ = nullptr;
  double spatial_entry_ = 0;
  std::vector<uint8_t> spatial_saved_;
  echospline_picture* picture_ = nullptr;
  int64_t mesh_nodes_ = 0, pixels_ = 0, bytes_ = 0;
  bool good_ = false;
  int64_t nodes_ = 0;
  int dimension_ = 2;
  int32_t shape_[3] = {2, 2, 2};
  double origin_[3] = {0, 0, 0}, extent_[3] = {10, 10, 10}, entry_[3] = {5, 0, 5};
  std::vector<uint8_t> saved_;  // lives longer than its scene: a state of another scene has to be refused
};

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  Choices choices(data, size);
  Session session(choices);
  while (!choices.ended()) session.act();
  return 0;
}

#ifndef ECHOSPLINE_LIBFUZZER
int main(int count, char** arguments) {
  const double seconds = count > 1 ? std::atof(arguments[1]) : 10;
  const uint64_t first = count > 2 ? std::strtoull(arguments[2], nullptr, 10) : 1;
  uint64_t seed = first;
  const auto begin = std::chrono::steady_clock::now();
  std::vector<uint8_t> bytes;
  while (std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count() < seconds) {
    uint64_t state = seed * 0x9e3779b97f4a7c15u + 1;
    bytes.resize(64 + seed % 4032);
    for (uint8_t& byte : bytes) {  // xorshift
      state ^= state << 13, state ^= state >> 7, state ^= state << 17;
      byte = static_cast<uint8_t>(state >> 32);
    }
    bytes[0] = 0;  // begin with a scene
    std::fprintf(stderr, "\rseed %llu",
                 static_cast<unsigned long long>(seed));  // the last one seen is the one that failed
    LLVMFuzzerTestOneInput(bytes.data(), bytes.size());
    ++seed;
  }
  std::fprintf(stderr, "\n");
  std::printf("fuzz: %llu sessions from seed %llu in %.0f s, nothing found\n",
              static_cast<unsigned long long>(seed - first), static_cast<unsigned long long>(first), seconds);
  return 0;
}
#endif
