// A point cloud in an order in which sixteen neighbours in memory are neighbours in space.
#pragma once

#include <cstdint>
#include <vector>

#include "pass.h"

namespace cpdeform::transport {

// Points sorted into compact blocks of `block_size`, coordinate by coordinate. The last block is filled up with copies of the last
// point; `weight` of such padding is zero.
// An order (count,) of the caller's points, and the blocks' size in it when it was made: mean sum of a box's sides, length units.
struct Order {
  int32_t* numbers;
  double extent;  // 0 where there is no order yet
};

template <class Real>
class Cloud {
 public:
  // `points` (count, 3) row by row and non-negative `weights` (count,), which are made to sum to one.
  Cloud(const Real* points, const Real* weights, int count);

  // The same in the order of an earlier cloud, as long as the points have not moved so far that its blocks have become loose, and
  // otherwise sorted again; `order` receives what is used.
  Cloud(const Real* points, const Real* weights, int count, Order& order);

  int count() const { return count_; }
  int padded() const { return static_cast<int>(order_.size()); }
  int blocks() const { return padded() / block_size; }

  const Real* axis(int axis) const { return axes_[axis].data(); }
  // Lower corners (0..2) and upper corners (3..5) of the blocks' boxes.
  const Real* box(int side) const { return boxes_[side].data(); }
  const std::vector<double>& weight() const { return weight_; }
  // Logarithm of the weights to base two; very negative where a weight is zero.
  const std::vector<Real>& log2_weight() const { return log2_weight_; }
  // Number, in the caller's order, of the point at a place; padding repeats the last point's.
  const std::vector<int32_t>& order() const { return order_; }

  // Values (count,) from the caller's order to this one (padded,), and back.
  void gather(const Real* values, std::vector<Real>& sorted) const;
  void scatter(const std::vector<Real>& sorted, Real* values) const;

 private:
  struct Point {
    Real position[3];
    int32_t number;
  };
  static void split(Point* first, Point* last);
  void sort(const Real* points);
  void place(const Real* points);
  void weigh(const Real* weights);
  double extent() const;

  int count_;
  std::vector<int32_t> order_;
  std::vector<Real> axes_[3], boxes_[6];
  std::vector<double> weight_;
  std::vector<Real> log2_weight_;
};

extern template class Cloud<float>;
extern template class Cloud<double>;

}  // namespace cpdeform::transport
