// Cold and warm solutions of one problem.
#pragma once

#include "coupling.h"
#include "instruction_sets.h"

namespace cpdeform::transport {

struct Options {
  int exponent;        // power of the distance, 1 or 2
  double blur;         // length units; the temperature is blur^exponent
  bool debias;         // whether to subtract the self-terms
  double scaling;      // ratio of successive blurs of a cold solution
  double tolerance;    // L1 error of the source's marginal
  int iterations;      // most iterations at one temperature
  bool warm;           // start from the potentials given
  double warm_tolerance;
  int warm_iterations;
  bool same_target;    // the target's self-potential given is still right
};

// The caller's arrays: points (N, 3) and (M, 3), weights, and potentials in units of the cost, which hold the start of a warm
// solution and receive the result, biased. `gradient` (N, 3) is that of the cost by the source's points, debiased if wanted. The
// orders of an earlier solution spare sorting the points.
template <class Real>
struct Arrays {
  const Real* source;
  const Real* target;
  const Real* source_weights;
  const Real* target_weights;
  int source_count;
  int target_count;
  Real* source_potential;
  Real* target_potential;
  Real* source_self;
  Real* target_self;
  Real* gradient;
  Order source_order, target_order;
};

struct Outcome {
  int iterations;        // at the final temperature
  double marginal_error;
  double source_extent, target_extent;  // of the orders used
};

template <class Real>
Outcome solve(Team& team, InstructionSet set, const Options& options, const Arrays<Real>& arrays);

extern template Outcome solve<float>(Team&, InstructionSet, const Options&, const Arrays<float>&);
extern template Outcome solve<double>(Team&, InstructionSet, const Options&, const Arrays<double>&);

}  // namespace cpdeform::transport
