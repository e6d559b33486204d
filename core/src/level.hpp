// The processor levels that the core is compiled for, and what each of them offers.
//
// `level.cpp` is compiled once per level, with its own flags and its own namespace, because inline functions of the same name
// would be merged by the linker and code for a better processor would run on a worse one. What crosses the border
// are the three tables here. A handle keeps the table of its level, so nothing global is needed.
#pragma once
#include <cstdint>

#include "../include/echospline/echospline.h"

namespace echospline {

/// What went wrong, in one sentence.
struct Message {
  char text[400] = "";
};

struct TissueEntries;   // scenes and tissues: tissue_entries.hpp
struct PictureEntries;  // pictures: picture_entries.hpp
struct ForceEntries;    // tissue under a needle's forces: force_entries.hpp
struct GreenEntries;    // Green's function of tissue: green_entries.hpp
struct SpaceEntries;    // volumes and fields of forces: space_entries.hpp
struct SpatialEntries;  // tissue in space under a needle's forces: spatial_entries.hpp

/// One level of the processor.
struct Level {
  int32_t id;
  const TissueEntries* tissue;
  const PictureEntries* picture;
  const ForceEntries* force;
  const SpaceEntries* space;
  const GreenEntries* green;
  const SpatialEntries* spatial;
};

/// Table of a level, or nullptr where the library does not hold it or the processor cannot run it. `ECHOSPLINE_LEVEL_BEST` is the best one.
const Level* find_level(int32_t id);

}  // namespace echospline
