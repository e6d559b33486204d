// Memory of the core: arrays of plain numbers, aligned to cache lines, allocated when something is built and not while it runs.
#pragma once
#include <cstdint>
#include <cstdlib>
#include <cstring>

#include "level_begin.hpp"

namespace echospline::ECHOSPLINE_CORE {

constexpr size_t LINE = 64;  // bytes in a cache line; rows begin on one

/// Count n rounded up to a multiple of m.
constexpr int64_t rounded_up(int64_t n, int64_t m) { return (n + m - 1) / m * m; }

/// A fixed number of plain values, zero at first. `reserve` says whether the memory was there: nothing throws.
template <class T>
class Array {
 public:
  Array() = default;
  Array(const Array&) = delete;
  Array& operator=(const Array&) = delete;
  ~Array() { std::free(memory_); }

  /// Replace the contents by `count` zeros; false when memory runs out (the old contents stay).
  bool reserve(int64_t count) {
    if (count < 0 || static_cast<uint64_t>(count) > (SIZE_MAX / 2) / sizeof(T)) return false;
    void* memory = std::calloc(1, static_cast<size_t>(count) * sizeof(T) + LINE);
    if (!memory) return false;
    std::free(memory_);
    memory_ = memory;
    data_ = reinterpret_cast<T*>((reinterpret_cast<uintptr_t>(memory) + LINE - 1) / LINE * LINE);
    count_ = count;
    return true;
  }
  void swap(Array& other) {
    void* memory = memory_;
    T* data = data_;
    const int64_t count = count_;
    memory_ = other.memory_, data_ = other.data_, count_ = other.count_;
    other.memory_ = memory, other.data_ = data, other.count_ = count;
  }

  T* data() { return data_; }
  const T* data() const { return data_; }
  int64_t size() const { return count_; }
  T& operator[](int64_t i) { return data_[i]; }
  const T& operator[](int64_t i) const { return data_[i]; }

 private:
  void* memory_ = nullptr;
  T* data_ = nullptr;
  int64_t count_ = 0;
};

}  // namespace echospline::ECHOSPLINE_CORE
