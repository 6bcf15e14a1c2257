#include "checks.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>
#include <vector>

namespace cpdeform::transport {

namespace {

void expect(bool holds, const char* name, const char* expected) {
  if (!holds) throw std::invalid_argument(std::string(name) + ": expected " + expected);
}

bool positive(double number) { return std::isfinite(number) && number > 0; }

template <class Real>
void expect_finite(const char* name, const Real* values, size_t count) {
  expect(std::all_of(values, values + count, [](Real value) { return std::isfinite(value); }), name, "finite numbers");
}

template <class Real>
void expect_weights(const char* name, const Real* weights, size_t count) {
  double total = 0.0;
  for (size_t i = 0; i < count; ++i) {
    expect(std::isfinite(weights[i]) && weights[i] >= 0, name, "finite weights, none negative");
    total += static_cast<double>(weights[i]);
  }
  expect(positive(total), name, "a positive sum");
}

// Numbers that are read come from outside, maybe from a file.
void expect_order(const char* name, const Order& order, size_t count) {
  if (!(order.extent > 0.0)) return;
  std::vector<bool> seen(count, false);
  for (size_t place = 0; place < count; ++place) {
    const int32_t number = order.numbers[place];
    expect(number >= 0 && static_cast<size_t>(number) < count && !seen[number], name, "each point's number once");
    seen[number] = true;
  }
}

template <class Real>
double diagonal(const Arrays<Real>& arrays) {
  double square = 0.0;
  for (int axis = 0; axis < 3; ++axis) {
    double low = arrays.source[axis], high = low;
    const auto include = [&](const Real* points, int count) {
      for (int i = 0; i < count; ++i) {
        low = std::min(low, static_cast<double>(points[3 * static_cast<size_t>(i) + axis]));
        high = std::max(high, static_cast<double>(points[3 * static_cast<size_t>(i) + axis]));
      }
    };
    include(arrays.source, arrays.source_count);
    include(arrays.target, arrays.target_count);
    square += (high - low) * (high - low);
  }
  return std::sqrt(square);
}

}  // namespace

void check_options(const Options& options) {
  expect(options.exponent == 1 || options.exponent == 2, "exponent", "1 or 2");
  expect(positive(options.blur), "blur", "a positive length");
  expect(options.scaling > 0 && options.scaling < 1, "scaling", "a number between 0 and 1");
  expect(positive(options.tolerance), "tolerance", "a positive number");
  expect(positive(options.warm_tolerance), "warm_tolerance", "a positive number");
  expect(options.iterations >= 1, "iterations", "at least 1");
  expect(options.warm_iterations >= 1, "warm_iterations", "at least 1");
}

template <class Real>
void check_arrays(const Options& options, const Arrays<Real>& arrays) {
  const size_t n = static_cast<size_t>(arrays.source_count), m = static_cast<size_t>(arrays.target_count);
  expect_finite("source", arrays.source, 3 * n);
  expect_finite("target", arrays.target, 3 * m);
  expect_weights("source_weights", arrays.source_weights, n);
  expect_weights("target_weights", arrays.target_weights, m);
  expect(options.blur >= least_relative_blur * diagonal(arrays), "blur", "at least 1e-7 of the diagonal of the box around the points");
  if (options.warm) {
    expect_finite("source_potential", arrays.source_potential, n);
    expect_finite("target_potential", arrays.target_potential, m);
    expect_finite("source_self", arrays.source_self, options.debias ? n : 0);
    expect_finite("target_self", arrays.target_self, options.debias ? m : 0);
  }
  expect_order("source_order", arrays.source_order, n);
  expect_order("target_order", arrays.target_order, m);
}

template void check_arrays<float>(const Options&, const Arrays<float>&);
template void check_arrays<double>(const Options&, const Arrays<double>&);

}  // namespace cpdeform::transport
