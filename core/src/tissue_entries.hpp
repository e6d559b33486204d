// What a level offers for scenes and tissues. Arguments have been checked: pointers, sizes and finite numbers.
#pragma once
#include "level.hpp"

namespace echospline {

struct SceneCounts {
  int32_t dimension;
  int64_t nodes, anchors, sources;
};

/// Displacement of a plane mesh as a tissue keeps it, mm: one plane of numbers per component, in one of two precisions.
struct FieldPlanes {
  const float* single[2];
  const double* exact[2];  // nullptr where the field is in single precision
  int32_t shape[2];
  double spacing[2], origin[2];
};

/// Functions of one kind of tissue: dimension, kernel and precision.
struct TissueFunctions {
  void (*destroy)(void* tissue);
  void (*reset)(void* tissue);
  echospline_status (*advance)(void* tissue, const echospline_pose& pose);
  echospline_status (*displacement)(void* tissue, double* out);
  echospline_status (*displacement_single)(void* tissue, float* out);
  echospline_status (*displacement_at)(void* tissue, const double* points, int64_t count, double* out);
  echospline_status (*planes)(void* tissue, FieldPlanes& out);  // of a tissue in the plane
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
  echospline_status (*create_scene)(const echospline_scene_options& options, void** scene, const SceneFunctions** functions,
                                    Message& message);
  echospline_status (*follow)(const echospline_pose& now, const echospline_command& command, echospline_pose& next);
};

/// Field of a tissue for a picture; `message` says why there is none.
echospline_status planes_of(echospline_tissue* tissue, FieldPlanes& planes, Message& message);

}  // namespace echospline
