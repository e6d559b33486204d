// What a level offers for scenes and tissues. Arguments have been checked: pointers, sizes and finite numbers.
#pragma once
#include "level.hpp"

namespace echospline {

struct SceneCounts {
  int32_t dimension;
  int64_t nodes, anchors, sources;
  int32_t shape[3];  // of the mesh
  double spacing[3], origin[3];
};

/// Functions of one kind of tissue: dimension, kernel and precision.
struct TissueFunctions {
  void (*destroy)(void* tissue);
  void (*reset)(void* tissue);
  echospline_status (*advance)(void* tissue, const echospline_pose& pose);
  echospline_status (*displacement)(void* tissue, double* out);
  echospline_status (*displacement_single)(void* tissue, float* out);
  echospline_status (*displacement_at)(void* tissue, const double* points, int64_t count, double* out);
  /// Displacement of a plane mesh in planes of single precision, valid until the next step; nullptr where the field has none.
  echospline_status (*planes)(void* tissue, const float** x, const float** y);
  int64_t (*landmarks)(void* tissue, echospline_landmark* out, int64_t room);
  void (*statistics)(void* tissue, echospline_statistics& out);
  int64_t (*state_size)(const void* tissue);
  void (*state_save)(void* tissue, void* bytes);
  echospline_status (*state_load)(void* tissue, const void* bytes, int64_t size, Message& message);
};

/// Functions of one kind of scene.
struct SceneFunctions {
  void (*destroy)(void* scene);
  SceneCounts (*counts)(const void* scene);
  void (*anchors)(const void* scene, double* out);
  void (*sources)(const void* scene, int64_t* out);
  void* (*create_tissue)(const void* scene);  // nullptr when memory runs out
  const TissueFunctions* tissue;
};

struct TissueEntries {
  echospline_status (*create_scene)(const echospline_scene_options& options, void** scene,
                                    const SceneFunctions** functions, Message& message);
  echospline_status (*follow)(const echospline_pose& now, const echospline_command& command, echospline_pose& next);
};

/// A tissue for other parts of the interface.
struct TissueView {
  void* self;
  const TissueFunctions* functions;
  const SceneCounts* counts;
};
/// A status and a message where the handle is no tissue that works, else OK.
echospline_status view_of(echospline_tissue* tissue, TissueView& view, Message& message);

}  // namespace echospline
