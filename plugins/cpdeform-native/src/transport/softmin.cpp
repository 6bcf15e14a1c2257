#include "softmin.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <limits>
#include <stdexcept>

namespace cpdeform::transport {

namespace {

// What a guess may be off, upwards, before a block is computed again.
constexpr int slack = 3;
// Sums so far from one that terms may have been clamped.
constexpr int far_off = 100;
// Guesses at a block: the second or third is good, and rounding alone can keep them from settling.
constexpr int most_guesses = 100;
// No list.
constexpr int none = -1;
// Passes that made lists, before all are forgotten: what each list was made for has to be compared with the present.
constexpr size_t most_snapshots = 6;

// Largest of now[i] - before[i], for a whole number of blocks. Sixteen maxima at once, which compilers turn into registers.
template <class Real>
Real growth(const Real* now, const Real* before, int count) {
  Real most[block_size];
  std::fill_n(most, block_size, -std::numeric_limits<Real>::infinity());
  for (int first = 0; first < count; first += block_size) {
    for (int i = 0; i < block_size; ++i) {
      const Real change = now[first + i] - before[first + i];
      most[i] = most[i] < change ? change : most[i];
    }
  }
  return *std::max_element(most, most + block_size);
}

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
      lists_(rows.blocks()),
      snapshot_(rows.blocks(), none),
      listed_t_(rows.padded()),
      reach_(rows.blocks()) {
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
  forget();
}

template <class Real>
void SoftMinimum<Real>::set_cut(int cut, int margin) {
  cut_ = static_cast<Real>(cut);
  margin_ = static_cast<Real>(margin);
  forget();
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
    for (int number = next.fetch_add(1); number < rows_.blocks(); number = next.fetch_add(1)) {
      if (team_.interrupted(thread)) throw_interrupted();
      work(number, thread);
    }
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
void SoftMinimum<Real>::forget() {
  std::fill(snapshot_.begin(), snapshot_.end(), none);
  listed_h_.clear();
}

// Find out how far each list still reaches, and drop those that may miss pairs which matter.
template <class Real>
void SoftMinimum<Real>::check_lists(const std::vector<Real>& t) {
  std::vector<Real> column_growth;
  for (const std::vector<Real>& before : listed_h_) column_growth.push_back(growth(h_.data(), before.data(), columns_.padded()));
  for (int number = 0; number < rows_.blocks(); ++number) {
    if (snapshot_[number] == none) continue;
    const int first = number * block_size;
    const Real grown = column_growth[snapshot_[number]] + growth(t.data() + first, listed_t_.data() + first, block_size);
    reach_[number] = cut_ + margin_ - grown;
    if (!(grown <= margin_)) snapshot_[number] = none;
  }
}

template <class Real>
const std::vector<Real>& SoftMinimum<Real>::pass(std::vector<Real>& t, std::vector<Real> (*gradient)[3], bool keep_lists) {
  check_lists(t);
  int present = none;
  if (keep_lists && std::find(snapshot_.begin(), snapshot_.end(), none) != snapshot_.end()) {
    if (listed_h_.size() == most_snapshots) forget();
    present = static_cast<int>(listed_h_.size());
    listed_h_.push_back(h_);
  }
  std::atomic<int64_t> pairs{0};
  for_blocks([&](int number, int thread) {
    const int first = number * block_size;
    Real guess[block_size];
    std::copy_n(t.data() + first, block_size, guess);
    Rows<Real> rows = block(number, guess);
    rows.log2_sum = log2_sum_.data() + first;
    for (int axis = 0; axis < 3 && gradient != nullptr; ++axis) rows.gradient[axis] = (*gradient)[axis].data() + first;
    const int evaluated = solve_block(rows, guess, number, scratch_[thread], gradient != nullptr, present);
    for (int i = 0; i < block_size; ++i) {
      const Real updated = guess[i] - rows.log2_sum[i];
      rows.log2_sum[i] = t[first + i] - updated;
      t[first + i] = updated;
    }
    pairs.fetch_add(static_cast<int64_t>(evaluated) * block_size, std::memory_order_relaxed);
  });
  pairs_ += pairs;
  return log2_sum_;
}

// The soft minima of one block, for `guess`, which is improved where it is too far off to tell. A new list is kept where `present`
// is a snapshot of the columns' potentials. Returns the columns evaluated.
template <class Real>
int SoftMinimum<Real>::solve_block(Rows<Real>& rows, Real* guess, int number, std::vector<int32_t>& scratch, bool with_gradient,
                                   int present) {
  std::vector<int32_t>& list = lists_[number];
  int evaluated = 0;
  for (int guesses = 0; guesses < most_guesses; ++guesses) {
    const int32_t* columns = list.data();
    int count = static_cast<int>(list.size());
    Real reach = reach_[number];
    if (snapshot_[number] == none) {
      reach = cut_ + (present != none ? margin_ : static_cast<Real>(slack));
      scratch.resize(columns_.padded() + block_size);
      columns = scratch.data();
      count = kernels_.candidates(view_, rows, exponent_, scale_, reach, scratch.data());
      if (present != none) {
        count = kernels_.select(view_, rows, exponent_, scale_, reach, scratch.data(), count);
        list.assign(scratch.data(), scratch.data() + count);
        std::copy_n(guess, block_size, listed_t_.data() + number * block_size);
        snapshot_[number] = present;
        reach_[number] = reach;
      }
    }
    evaluated += count;
    (with_gradient ? kernels_.evaluate_gradient : kernels_.evaluate)(view_, rows, exponent_, scale_, columns, count);

    const auto [lowest, highest] = std::minmax_element(rows.log2_sum, rows.log2_sum + block_size);
    if (*lowest >= cut_ - reach && *highest < far_off) return evaluated;
    snapshot_[number] = none;
    if (*lowest < -far_off || *highest >= far_off) kernels_.largest(view_, rows, exponent_, scale_);
    for (int i = 0; i < block_size; ++i) guess[i] -= rows.log2_sum[i];
    rows.t_largest = *std::max_element(guess, guess + block_size);
  }
  throw std::runtime_error("The potentials do not settle: costs are too large, against the blur, for the precision.");
}

template class SoftMinimum<float>;
template class SoftMinimum<double>;

}  // namespace cpdeform::transport
