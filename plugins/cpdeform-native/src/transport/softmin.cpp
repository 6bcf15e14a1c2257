#include "softmin.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <limits>

namespace cpdeform::transport {

namespace {

// What a guess may be off, upwards, before a block is computed again.
constexpr int slack = 3;
// Sums so far from one that terms may have been clamped.
constexpr int far_off = 100;

}  // namespace

template <class Real>
SoftMinimum<Real>::SoftMinimum(Team& team, const Kernels<Real>& kernels, const Cloud<Real>& rows, const Cloud<Real>& columns,
                               int exponent)
    : team_(team),
      kernels_(kernels),
      rows_(rows),
      columns_(columns),
      exponent_(exponent),
      h_(columns.padded()),
      h_largest_(columns.blocks() + block_size, static_cast<Real>(no_weight)),
      packed_(4 * static_cast<size_t>(columns.padded())),
      log2_sum_(rows.padded()),
      scratch_(team.size()),
      lists_(rows.blocks()) {
  for (int axis = 0; axis < 3; ++axis) {
    for (int j = 0; j < columns.padded(); ++j) packed_[4 * static_cast<size_t>(j) + axis] = columns.axis(axis)[j];
    view_.axis[axis] = columns.axis(axis);
    view_.box[axis] = columns.box(axis);
    view_.box[axis + 3] = columns.box(axis + 3);
  }
  view_.count = columns.padded();
  view_.h = h_.data();
  view_.packed = packed_.data();
  view_.h_largest = h_largest_.data();
}

template <class Real>
void SoftMinimum<Real>::set_temperature(double epsilon) {
  scale_ = static_cast<Real>(1.0 / (epsilon * 0.69314718055994530942));
  listed_ = false;
}

template <class Real>
void SoftMinimum<Real>::set_cut(int cut, int margin) {
  cut_ = static_cast<Real>(cut);
  margin_ = static_cast<Real>(margin);
  listed_ = false;
}

template <class Real>
void SoftMinimum<Real>::prepare(const std::vector<Real>& other) {
  const std::vector<Real>& log2_weight = columns_.log2_weight();
  for (int block = 0; block < columns_.blocks(); ++block) {
    Real most = static_cast<Real>(no_weight);
    for (int j = block * block_size; j < (block + 1) * block_size; ++j) {
      h_[j] = other[j] + log2_weight[j];
      packed_[4 * static_cast<size_t>(j) + 3] = h_[j];
      most = std::max(most, h_[j]);
    }
    h_largest_[block] = most;
  }
}

template <class Real>
Rows<Real> SoftMinimum<Real>::block(int number, Real* t) const {
  const int first = number * block_size;
  Rows<Real> rows{};
  for (int axis = 0; axis < 3; ++axis) {
    rows.axis[axis] = rows_.axis(axis) + first;
    rows.box[axis] = rows_.box(axis)[number];
    rows.box[axis + 3] = rows_.box(axis + 3)[number];
  }
  rows.t = t;
  rows.t_largest = *std::max_element(t, t + block_size);
  return rows;
}

// Blocks in order of their number, each thread taking the next.
template <class Real>
template <class Work>
void SoftMinimum<Real>::for_blocks(Work&& work) {
  std::atomic<int> next{0};
  team_.run([&](int thread) {
    for (int number = next.fetch_add(1); number < rows_.blocks(); number = next.fetch_add(1)) work(number, thread);
  });
}

template <class Real>
void SoftMinimum<Real>::start(const std::vector<Real>& other, std::vector<Real>& t) {
  prepare(other);
  for_blocks([&](int number, int) {
    Rows<Real> rows = block(number, t.data() + number * block_size);
    Real largest[block_size];
    rows.log2_sum = largest;
    kernels_.largest(view_, rows, exponent_, scale_);
    for (int i = 0; i < block_size; ++i) t[number * block_size + i] -= largest[i];
  });
}

template <class Real>
const std::vector<Real>& SoftMinimum<Real>::update(const std::vector<Real>& other, std::vector<Real>& t, bool keep_lists) {
  prepare(other);
  return pass(t, nullptr, keep_lists);
}

template <class Real>
const std::vector<Real>& SoftMinimum<Real>::update(const std::vector<Real>& other, std::vector<Real>& t,
                                                   std::vector<Real> (&gradient)[3]) {
  prepare(other);
  for (std::vector<Real>& axis : gradient) axis.resize(rows_.padded());
  return pass(t, &gradient, false);
}

template <class Real>
const std::vector<Real>& SoftMinimum<Real>::pass(std::vector<Real>& t, std::vector<Real> (*gradient)[3], bool keep_lists) {
  // how much the exponent of a pair outside the lists may have grown through its column
  Real growth = 0;
  if (listed_) {
    growth = -std::numeric_limits<Real>::infinity();
    for (int j = 0; j < columns_.padded(); ++j) growth = std::max(growth, h_[j] - listed_h_[j]);
    for (int i = 0; i < rows_.padded() && listed_; ++i) listed_ = growth + t[i] - listed_t_[i] <= margin_;
  }
  const bool reuse = listed_, make = keep_lists && !listed_;
  if (make) {
    listed_t_ = t;
    listed_h_ = h_;
    listed_ = true;
  }
  std::atomic<bool> stale{false};
  std::atomic<int64_t> pairs{0};
  for_blocks([&](int number, int thread) {
    const int first = number * block_size;
    std::vector<int32_t>& scratch = scratch_[thread];
    scratch.resize(columns_.padded() + block_size);
    Real guess[block_size];
    std::copy_n(t.data() + first, block_size, guess);
    Rows<Real> rows = block(number, guess);
    rows.log2_sum = log2_sum_.data() + first;
    for (int axis = 0; axis < 3 && gradient != nullptr; ++axis) rows.gradient[axis] = (*gradient)[axis].data() + first;

    std::vector<int32_t>& list = lists_[number];
    int64_t evaluated = 0;
    for (int attempt = 0;; ++attempt) {
      // exponents below -reach may be missing
      Real reach;
      const int32_t* columns;
      int count;
      if (reuse && attempt == 0) {
        Real row_growth = -std::numeric_limits<Real>::infinity();
        for (int i = 0; i < block_size; ++i) row_growth = std::max(row_growth, guess[i] - listed_t_[first + i]);
        reach = cut_ + margin_ - (growth + row_growth);
        columns = list.data();
        count = static_cast<int>(list.size());
      } else {
        reach = cut_ + (make && attempt == 0 ? margin_ : slack);
        count = kernels_.candidates(view_, rows, exponent_, scale_, reach, scratch.data());
        columns = scratch.data();
      }
      evaluated += count;
      int kept = 0;
      const bool collect = make && attempt == 0;
      if (gradient != nullptr) {
        kernels_.evaluate_gradient(view_, rows, exponent_, scale_, columns, count);
      } else {
        kept = kernels_.evaluate(view_, rows, exponent_, scale_, columns, count, reach, collect ? scratch.data() : nullptr);
      }
      if (collect) list.assign(scratch.data(), scratch.data() + kept);

      const auto [lowest, highest] = std::minmax_element(rows.log2_sum, rows.log2_sum + block_size);
      if (*lowest >= cut_ - reach && *highest < far_off) break;
      stale = true;
      if (*lowest < -far_off || *highest >= far_off) kernels_.largest(view_, rows, exponent_, scale_);
      for (int i = 0; i < block_size; ++i) guess[i] -= rows.log2_sum[i];
      rows.t_largest = *std::max_element(guess, guess + block_size);
    }
    for (int i = 0; i < block_size; ++i) {
      const Real updated = guess[i] - rows.log2_sum[i];
      rows.log2_sum[i] = t[first + i] - updated;
      t[first + i] = updated;
    }
    pairs.fetch_add(evaluated * block_size, std::memory_order_relaxed);
  });
  if (stale) listed_ = false;
  pairs_ += pairs;
  return log2_sum_;
}

template class SoftMinimum<float>;
template class SoftMinimum<double>;

}  // namespace cpdeform::transport
