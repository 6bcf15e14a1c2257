// Half a Sinkhorn iteration: the soft minima at all points of one cloud, over the pairs that matter.
#pragma once

#include <cstdint>
#include <vector>

#include "cloud.h"
#include "pass.h"
#include "threads.h"

namespace cpdeform::transport {

// Computes t_i <- t_i - log2 sum_j 2^e_ij, see pass.h, for potentials in the clouds' order.
//
// Pairs with e_ij < -cut are left out. What e_ij is measured against, the current t_i, is only a guess of the result, so every block
// checks afterwards: the sum S over some of the pairs is a lower bound of the whole, and every pair left out is below 2^-cut of it,
// or the block is computed again with t_i - log2 S. The result is that of all pairs for any guess; a good guess makes it fast.
//
// Lists of pairs may be kept from one update to the next. They were selected with a margin; once the potentials have grown by more
// than that, they are made anew, for those blocks of rows alone that need it: after a few iterations the potentials of a handful of
// points are the only ones that still move much.
template <class Real>
class SoftMinimum {
 public:
  SoftMinimum(Team& team, const Kernels<Real>& kernels, const Cloud<Real>& rows, const Cloud<Real>& columns, int exponent);

  // Temperature in units of the cost; forgets lists.
  void set_temperature(double epsilon);

  // Terms below 2^-cut of their row's sum are left out. What potentials may grow, to base two, before lists are made anew.
  void set_cut(int cut, int margin);

  // Update `t` (rows.padded(),) for the columns' potential `other` (columns.padded(),), both to base two in units of the
  // temperature. Returns the logarithms to base two of the sums, zero where `t` was the soft minimum already.
  const std::vector<Real>& update(const std::vector<Real>& other, std::vector<Real>& t, bool keep_lists);

  // The same, and the gradients (rows.padded(),) along three axes of the rows' soft minima by their points.
  const std::vector<Real>& update(const std::vector<Real>& other, std::vector<Real>& t, std::vector<Real> (&gradient)[3]);

  // Where there is no guess: set `t` so that each row's largest term is one.
  void start(const std::vector<Real>& other, std::vector<Real>& t);

  // Pairs evaluated since the construction.
  int64_t pairs() const { return pairs_; }

 private:
  void prepare(const std::vector<Real>& other);
  Rows<Real> block(int number, Real* t) const;
  template <class Work>
  void for_blocks(Work&& work);
  void forget();
  void check_lists(const std::vector<Real>& t);
  const std::vector<Real>& pass(std::vector<Real>& t, std::vector<Real> (*gradient)[3], bool keep_lists);
  int solve_block(Rows<Real>& rows, Real* guess, int number, std::vector<int32_t>& scratch, bool with_gradient, int present);

  Team& team_;
  const Kernels<Real>& kernels_;
  const Cloud<Real>& rows_;
  const Cloud<Real>& columns_;
  int exponent_;
  Real scale_ = 1, cut_ = sizeof(Real) == 4 ? 22 : 44, margin_ = 8;
  std::vector<Real> h_, h_largest_, packed_, log2_sum_;
  Columns<Real> view_{};
  std::vector<std::vector<int32_t>> scratch_;  // of each thread
  std::vector<std::vector<int32_t>> lists_;    // of each block
  std::vector<int> snapshot_;                  // of each block: which of `listed_h_` its list was made for, or `none`
  std::vector<std::vector<Real>> listed_h_;    // columns' potentials when lists were made
  std::vector<Real> listed_t_;                 // rows' potentials when their lists were made
  std::vector<Real> reach_;                    // of each block: exponents below -reach may be missing in its list
  int64_t pairs_ = 0;
};

extern template class SoftMinimum<float>;
extern template class SoftMinimum<double>;

}  // namespace cpdeform::transport
