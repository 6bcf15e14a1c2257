#include "cloud.h"

#include <algorithm>
#include <cmath>

namespace cpdeform::transport {

template <class Real>
Cloud<Real>::Cloud(const Real* points, const Real* weights, int count) : count_(count) {
  const int padded = (count + block_size - 1) / block_size * block_size;
  std::vector<Point> sorted(count);
  for (int i = 0; i < count; ++i) sorted[i] = {{points[3 * i], points[3 * i + 1], points[3 * i + 2]}, i};
  split(sorted.data(), sorted.data() + count);
  order_.resize(padded);
  for (int place = 0; place < padded; ++place) order_[place] = sorted[std::min(place, count - 1)].number;

  double total = 0.0;
  for (int i = 0; i < count; ++i) total += static_cast<double>(weights[i]);
  weight_.assign(padded, 0.0);
  log2_weight_.assign(padded, static_cast<Real>(no_weight));
  for (int axis = 0; axis < 3; ++axis) axes_[axis].resize(padded);
  for (int place = 0; place < padded; ++place) {
    const int32_t i = order_[place];
    for (int axis = 0; axis < 3; ++axis) axes_[axis][place] = points[3 * i + axis];
    if (place < count && weights[i] > 0) {
      weight_[place] = static_cast<double>(weights[i]) / total;
      log2_weight_[place] = static_cast<Real>(std::log2(weight_[place]));
    }
  }
  for (int axis = 0; axis < 3; ++axis) {
    boxes_[axis].resize(blocks() + block_size);  // kernels read whole registers
    boxes_[axis + 3].resize(blocks() + block_size);
    for (int block = 0; block < blocks(); ++block) {
      const Real* values = axes_[axis].data() + block * block_size;
      const auto [low, high] = std::minmax_element(values, values + block_size);
      boxes_[axis][block] = *low;
      boxes_[axis + 3][block] = *high;
    }
  }
}

// Halve along the longest side, at a whole number of blocks, until one block is left.
template <class Real>
void Cloud<Real>::split(Point* first, Point* last) {
  const int size = static_cast<int>(last - first);
  if (size <= block_size) return;
  Real low[3], high[3];
  for (int axis = 0; axis < 3; ++axis) low[axis] = high[axis] = first->position[axis];
  for (const Point* point = first; point != last; ++point) {
    for (int axis = 0; axis < 3; ++axis) {
      low[axis] = std::min(low[axis], point->position[axis]);
      high[axis] = std::max(high[axis], point->position[axis]);
    }
  }
  int longest = 0;
  for (int axis = 1; axis < 3; ++axis)
    if (high[axis] - low[axis] > high[longest] - low[longest]) longest = axis;
  const int blocks = (size + block_size - 1) / block_size;
  Point* middle = first + blocks / 2 * block_size;
  // ties are broken by number: one cloud has one order
  std::nth_element(first, middle, last, [longest](const Point& a, const Point& b) {
    return a.position[longest] < b.position[longest] || (a.position[longest] == b.position[longest] && a.number < b.number);
  });
  split(first, middle);
  split(middle, last);
}

template <class Real>
void Cloud<Real>::gather(const Real* values, std::vector<Real>& sorted) const {
  sorted.resize(order_.size());
  for (size_t place = 0; place < order_.size(); ++place) sorted[place] = values[order_[place]];
}

template <class Real>
void Cloud<Real>::scatter(const std::vector<Real>& sorted, Real* values) const {
  for (int place = 0; place < count_; ++place) values[order_[place]] = sorted[place];
}

template class Cloud<float>;
template class Cloud<double>;

}  // namespace cpdeform::transport
