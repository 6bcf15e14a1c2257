// What the bindings ask of NumPy arrays before their memory is touched.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstdint>
#include <initializer_list>
#include <stdexcept>
#include <string>

namespace cpdeform {

inline std::string shape_text(const int64_t* first, size_t count) {
  std::string text = "(";
  for (size_t i = 0; i < count; ++i) text += (i ? ", " : "") + std::to_string(first[i]);
  return text + (count == 1 ? ",)" : ")");
}

// That an array has exactly this shape and its numbers lie where the processor may read them. Type, C order and writability are
// part of the array's C++ type, and arguments that are marked `noconvert` come as they are, not as a copy.
template <class Array>
void expect_shape(const char* name, const Array& array, std::initializer_list<int64_t> shape) {
  bool equal = array.ndim() == shape.size();
  std::string came = "(";
  size_t axis = 0;
  for (const int64_t expected : shape) {
    equal = equal && static_cast<int64_t>(array.shape(axis)) == expected;
    ++axis;
  }
  if (!equal) {
    for (size_t i = 0; i < array.ndim(); ++i) came += (i ? ", " : "") + std::to_string(array.shape(i));
    throw std::invalid_argument(std::string(name) + ": got shape " + came + "), expected " + shape_text(shape.begin(), shape.size()));
  }
  if (reinterpret_cast<uintptr_t>(array.data()) % sizeof(typename Array::Scalar) != 0)
    throw std::invalid_argument(std::string(name) + ": got an array that is not aligned, expected one aligned to its type");
}

// A whole number between bounds.
inline void expect_between(const char* name, int64_t came, int64_t least, int64_t most) {
  if (came < least || came > most)
    throw std::invalid_argument(std::string(name) + ": got " + std::to_string(came) + ", expected " + std::to_string(least) + " to " +
                                std::to_string(most));
}

// More threads than any machine has cores are a mistake, and each costs memory.
constexpr int most_threads = 4096;

}  // namespace cpdeform
