// What a problem must keep to before it is solved: a number that is not finite makes comparisons, and with them sorting and descents,
// never come to an end. All throw std::invalid_argument.
#pragma once

#include "solver.h"

namespace cpdeform::transport {

// The least blur as a part of the box's diagonal around both clouds. Far below it, exponents of size diameter^p / blur^p have lost all
// digits after the point, and no descent ends.
constexpr double least_relative_blur = 1e-7;

void check_options(const Options& options);

// Points, weights, potentials to start from, and orders.
template <class Real>
void check_arrays(const Options& options, const Arrays<Real>& arrays);

extern template void check_arrays<float>(const Options&, const Arrays<float>&);
extern template void check_arrays<double>(const Options&, const Arrays<double>&);

}  // namespace cpdeform::transport
