#include "cloud.h"

#include <algorithm>
#include <cmath>

namespace cpdeform::transport {

namespace {

// What blocks may grow before the points are sorted again: looser ones have more neighbours.
constexpr double most_growth = 1.2;

}  // namespace

template <class Real>
Cloud<Real>::Cloud(const Real* points, const Real* weights, int count) : count_(count) {
  sort(points);
  place(points);
  weigh(weights);
}

template <class Real>
Cloud<Real>::Cloud(const Real* points, const Real* weights, int count, Order& order) : count_(count) {
  if (order.extent > 0.0) {
    order_.assign(order.numbers, order.numbers + count);
    order_.resize((count + block_size - 1) / block_size * block_size, order_.back());
    place(points);
  }
  if (!(order.extent > 0.0) || extent() > most_growth * order.extent) {
    sort(points);
    place(points);
    std::copy_n(order_.data(), count, order.numbers);
    order.extent = extent();
  }
  weigh(weights);
}

template <class Real>
void Cloud<Real>::sort(const Real* points) {
  std::vector<Point> sorted(count_);
  for (int i = 0; i < count_; ++i) sorted[i] = {{points[3 * i], points[3 * i + 1], points[3 * i + 2]}, i};
  split(sorted.data(), sorted.data() + count_);
  order_.resize((count_ + block_size - 1) / block_size * block_size);
  for (int place = 0; place < padded(); ++place) order_[place] = sorted[std::min(place, count_ - 1)].number;
}

// Coordinates and boxes, in the order that is set.
template <class Real>
void Cloud<Real>::place(const Real* points) {
  for (int axis = 0; axis < 3; ++axis) {
    axes_[axis].resize(padded());
    for (int place = 0; place < padded(); ++place) axes_[axis][place] = points[3 * order_[place] + axis];
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

template <class Real>
void Cloud<Real>::weigh(const Real* weights) {
  double total = 0.0;
  for (int i = 0; i < count_; ++i) total += static_cast<double>(weights[i]);
  weight_.assign(padded(), 0.0);
  log2_weight_.assign(padded(), static_cast<Real>(no_weight));
  for (int place = 0; place < count_; ++place) {
    const Real weight = weights[order_[place]];
    if (!(weight > 0)) continue;
    weight_[place] = static_cast<double>(weight) / total;
    log2_weight_[place] = static_cast<Real>(std::log2(weight_[place]));
  }
}

template <class Real>
double Cloud<Real>::extent() const {
  double sum = 0.0;
  for (int axis = 0; axis < 3; ++axis)
    for (int block = 0; block < blocks(); ++block) sum += static_cast<double>(boxes_[axis + 3][block]) - boxes_[axis][block];
  return sum / blocks();
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
