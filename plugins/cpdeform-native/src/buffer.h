// Aligned memory for kernels. In the namespace of the instruction set, see CMakeLists.txt.
#pragma once

#include <cstddef>
#include <cstdlib>
#include <new>

namespace CPDEFORM_ISA {

// Uninitialised array that only grows; 64-byte aligned.
template <class T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  ~Buffer() { std::free(data_); }

  // Room for `size` items; what was inside is lost where it grows.
  T* reserve(size_t size) {
    if (size > capacity_) {
      std::free(data_);
      data_ = nullptr;
      capacity_ = 0;
      const size_t wanted = size + size / 4;
      void* memory = nullptr;
      if (posix_memalign(&memory, 64, wanted * sizeof(T) + 64) != 0) throw std::bad_alloc();
      data_ = static_cast<T*>(memory);
      capacity_ = wanted;
    }
    return data_;
  }
  T* get() const { return data_; }
  T& operator[](size_t i) const { return data_[i]; }

 private:
  T* data_ = nullptr;
  size_t capacity_ = 0;
};

}  // namespace CPDEFORM_ISA
