// Two clouds, their potentials and those of each with itself, at one temperature; and iterations on them.
#pragma once

#include <vector>

#include "softmin.h"

namespace cpdeform::transport {

// Potentials are kept in units of the temperature, to base two, in the clouds' order: `source` belongs to f, `target` to g,
// `source_self` and `target_self` to the transport of each cloud to itself, which debiasing subtracts (Feydy et al., "Interpolating
// between Optimal Transport and MMD using Sinkhorn Divergences", AISTATS 2019).
template <class Real>
struct Potentials {
  std::vector<Real> source, target, source_self, target_self;
};

// Temperature at which potentials are in units of the cost: 1 / log 2.
constexpr double natural_temperature = 1.4426950408889634;

// When a descent ends, and how boldly it goes.
struct Descent {
  double tolerance;  // L1 error of the source's marginal
  int least, limit;  // iterations
  bool near;         // the start is a solution of a nearby problem
};

template <class Real>
class Coupling {
 public:
  Coupling(Team& team, const Kernels<Real>& kernels, const Cloud<Real>& source, const Cloud<Real>& target, int exponent);

  // Change the temperature, in units of the cost. Potentials stay what they are in units of the cost. At first it is the
  // `natural_temperature`.
  void set_temperature(double epsilon);
  // Precision of the soft minima, see SoftMinimum.
  void set_cut(int cut, int margin);
  double epsilon() const { return epsilon_; }

  // Over-relaxed Sinkhorn iterations (Thibault et al., "Overrelaxed Sinkhorn-Knopp Algorithm for Regularized Optimal Transport",
  // Algorithms 2021), the source's potential first, until the L1 error of the source's marginal is small. The relaxation
  // follows the observed rate of convergence. Afterwards the target's potential is the soft minimum of the source's. Returns the
  // iterations used.
  int descend(const Descent& descent);

  // Averaged iterations t <- (t + softmin(t)) / 2 on the potential of a cloud with itself, which converge fast.
  void descend_self(bool of_source, double tolerance, int limit);

  // Last update of the source's potentials, with the gradient (padded, 3 axes) of the debiased (or not) cost per unit of weight.
  // Returns the L1 error of the source's marginal before it.
  double finish(bool debias, std::vector<Real> (&gradient)[3]);

  Potentials<Real>& potentials() { return potentials_; }

 private:
  const Cloud<Real>& source_;
  const Cloud<Real>& target_;
  SoftMinimum<Real> to_source_, to_target_, source_itself_, target_itself_;
  Potentials<Real> potentials_;
  double epsilon_ = natural_temperature;
};

extern template class Coupling<float>;
extern template class Coupling<double>;

}  // namespace cpdeform::transport
