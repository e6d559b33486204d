// Pictures at one processor level.
#pragma once
#include <new>

#include "../include/echospline/picture.hpp"
#include "../include/echospline/shading.hpp"
#include "picture_entries.hpp"

namespace echospline::ECHOSPLINE_CORE {
namespace {

Picture& picture_of(void* picture) { return *static_cast<Picture*>(picture); }

void destroy_picture(void* picture) {
  picture_of(picture).~Picture();
  std::free(picture);
}

void* create_picture(const echospline_picture_options& options, const void* pixels) {
  void* memory = std::malloc(sizeof(Picture));
  if (!memory) return nullptr;
  Picture* picture = new (memory) Picture;
  if (picture->prepare(options, pixels)) return picture;
  destroy_picture(picture);
  return nullptr;
}

const PictureEntries picture_entries = {
    create_picture,
    destroy_picture,
    [](const void* picture) { return static_cast<const Picture*>(picture)->size(); },
    [](void* picture, const void* pixels) { picture_of(picture).set_reference(pixels); },
    [](void* picture, const double* u) { picture_of(picture).deform(u, u + 1, 2); },
    [](void* picture, const float* u) { picture_of(picture).deform(u, u + 1, 2); },
    [](void* picture, const float* x, const float* y) { picture_of(picture).deform(x, y, 1); },
    [](void* picture, const echospline_needle* needle, void* out) { picture_of(picture).draw(needle, out); },
    [](void* picture, float* x, float* y) { picture_of(picture).inverse(x, y); },
    [](void* picture, echospline_picture_report& report) { picture_of(picture).check(report); },
    [](void* picture, const echospline_needle& needle, const double* points, int64_t count, double* power,
       double* transmission) { picture_of(picture).echo_at(needle, points, count, power, transmission); },
    shade,
};

}  // namespace
}  // namespace echospline::ECHOSPLINE_CORE
