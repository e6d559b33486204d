// What a level offers for pictures. Arguments have been checked: pointers, sizes and finite numbers.
#pragma once
#include "level.hpp"

namespace echospline {

/// Functions over one picture, which is opaque outside its level.
struct PictureEntries {
  void* (*create)(const echospline_picture_options& options, const void* pixels);  // nullptr when memory runs out
  void (*destroy)(void* picture);
  int64_t (*size)(const void* picture);
  void (*reference)(void* picture, const void* pixels);
  void (*deform)(void* picture, const double* displacement);
  void (*deform_single)(void* picture, const float* displacement);
  void (*deform_planes)(void* picture, const float* x,
                        const float* y);  // mm, a plane per direction: as a tissue of this level keeps them
  void (*draw)(void* picture, const echospline_needle* needle, void* out);
  void (*inverse)(void* picture, float* x, float* y);
  void (*check)(void* picture, echospline_picture_report& report);
  void (*echo)(void* picture, const echospline_needle& needle, const double* points, int64_t count, double* power,
               double* transmission);
  void (*shade)(const echospline_look& look, const uint8_t* grey, int columns, int rows, uint8_t* rgba);
};

}  // namespace echospline
