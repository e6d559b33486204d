// The handle of a forced tissue, for the two files of the C interface that take one.
#pragma once
#include "force_entries.hpp"

struct echospline_forced {
  const echospline::Level* level = nullptr;
  void* self = nullptr;
  int64_t nodes = 0;
  double low[2] = {}, high[2] = {};
  bool attached = false;  // to a green
  echospline::Message message;
};
