#include "coupling.h"

#include <algorithm>
#include <cmath>

namespace cpdeform::transport {

namespace {

// First iterations, which settle neighbours among each other, are not over-relaxed; `near` a solution one is enough for that.
constexpr int plain_iterations = 3, near_plain_iterations = 1;
// Above this error the problem is far from linear, and over-relaxation may overshoot.
constexpr double nonlinear_error = 0.5;
// Iterations between two looks at the rate of convergence.
constexpr int window = 8;
// Near a solution only the slow errors of long distances are left, and few iterations to mend them.
constexpr double first_relaxation = 1.6, near_first_relaxation = 1.8, most_relaxation = 1.95;

// L1 error of a marginal whose potentials would change by `log2_sum`.
template <class Real>
double marginal_error(const Cloud<Real>& cloud, const std::vector<Real>& log2_sum) {
  double error = 0.0;
  for (int i = 0; i < cloud.count(); ++i)
    error += cloud.weight()[i] * static_cast<double>(std::abs(std::exp2(std::min(log2_sum[i], Real{60})) - Real{1}));
  return error;
}

// Relaxation that is best for the slowest error, whose rate under `relaxation` was `rate` (Young's formula for successive
// over-relaxation).
double better_relaxation(double rate, double relaxation) {
  if (rate <= relaxation - 1.0) return relaxation;  // faster than the slowest error: already beyond the best
  const double root = (rate + relaxation - 1.0) / relaxation;
  const double plain_rate = std::min(root * root / rate, 1.0);
  return std::clamp(2.0 / (1.0 + std::sqrt(1.0 - plain_rate)), 1.0, most_relaxation);
}

}  // namespace

template <class Real>
Coupling<Real>::Coupling(Team& team, const Kernels<Real>& kernels, const Cloud<Real>& source, const Cloud<Real>& target, int exponent)
    : source_(source),
      target_(target),
      to_source_(team, kernels, source, target, exponent),
      to_target_(team, kernels, target, source, exponent),
      source_itself_(team, kernels, source, source, exponent),
      target_itself_(team, kernels, target, target, exponent) {
  potentials_.source.assign(source.padded(), Real{});
  potentials_.target.assign(target.padded(), Real{});
  potentials_.source_self.assign(source.padded(), Real{});
  potentials_.target_self.assign(target.padded(), Real{});
}

template <class Real>
void Coupling<Real>::set_temperature(double epsilon) {
  const Real factor = static_cast<Real>(epsilon_ / epsilon);
  for (std::vector<Real>* potential :
       {&potentials_.source, &potentials_.target, &potentials_.source_self, &potentials_.target_self})
    for (Real& value : *potential) value *= factor;
  epsilon_ = epsilon;
  for (SoftMinimum<Real>* half : {&to_source_, &to_target_, &source_itself_, &target_itself_}) half->set_temperature(epsilon);
}

template <class Real>
void Coupling<Real>::set_cut(int cut, int margin) {
  for (SoftMinimum<Real>* half : {&to_source_, &to_target_, &source_itself_, &target_itself_}) half->set_cut(cut, margin);
}

template <class Real>
int Coupling<Real>::descend(const Descent& descent) {
  const int plain = descent.near ? near_plain_iterations : plain_iterations;
  std::vector<Real>&f = potentials_.source, &g = potentials_.target;
  double relaxation = 1.0, mark = 0.0;
  int marked = 0;
  for (int iteration = 1;; ++iteration) {
    const std::vector<Real>& change = to_source_.update(g, f, true);
    const double error = marginal_error(source_, change);
    // A slow error changes the potentials of over-relaxed iterations by 1 / (2 - relaxation) of what a plain one does. A solution
    // from afar profits from the larger measure: it converges farther.
    const double told = descent.near ? (2.0 - relaxation) * error : error;
    const bool last = iteration >= descent.limit || (told < descent.tolerance && iteration >= descent.least);
    if (error > nonlinear_error || iteration <= plain) {
      relaxation = 1.0;
      marked = iteration;
      mark = error;
    } else if (relaxation == 1.0) {
      relaxation = descent.near ? near_first_relaxation : first_relaxation;
    } else if (iteration - marked == window) {
      // an error that grows without being nonlinear: the relaxation is too strong
      const double rate = std::pow(error / std::max(mark, 1e-300), 1.0 / window);
      relaxation = rate >= 1.0 ? 1.0 + 0.7 * (relaxation - 1.0) : better_relaxation(rate, relaxation);
      marked = iteration;
      mark = error;
    }
    const Real beyond = last ? Real{} : static_cast<Real>(relaxation - 1.0);
    for (size_t i = 0; i < f.size(); ++i) f[i] -= beyond * change[i];
    const std::vector<Real>& other_change = to_target_.update(f, g, true);
    for (size_t j = 0; j < g.size(); ++j) g[j] -= beyond * other_change[j];
    if (last) return iteration;
  }
}

template <class Real>
void Coupling<Real>::descend_self(bool of_source, double tolerance, int limit) {
  const Cloud<Real>& cloud = of_source ? source_ : target_;
  SoftMinimum<Real>& itself = of_source ? source_itself_ : target_itself_;
  std::vector<Real>& t = of_source ? potentials_.source_self : potentials_.target_self;
  double before = 1e300;
  for (int iteration = 0; iteration < limit; ++iteration) {
    const std::vector<Real> other = t;
    const std::vector<Real>& change = itself.update(other, t, limit > 1);
    for (size_t i = 0; i < t.size(); ++i) t[i] += Real(0.5) * change[i];
    const double error = marginal_error(cloud, change);
    // rounding may stop the descent before the tolerance is reached
    if (error < tolerance || (error < 100.0 * tolerance && error > 0.9 * before)) break;
    before = error;
  }
}

template <class Real>
double Coupling<Real>::finish(bool debias, std::vector<Real> (&gradient)[3]) {
  const double error = marginal_error(source_, to_source_.update(potentials_.target, potentials_.source, gradient));
  if (debias) {
    std::vector<Real> self_gradient[3];
    const std::vector<Real> other = potentials_.source_self;
    source_itself_.update(other, potentials_.source_self, self_gradient);
    for (int axis = 0; axis < 3; ++axis)
      for (size_t i = 0; i < other.size(); ++i) gradient[axis][i] -= self_gradient[axis][i];
  }
  return error;
}

template class Coupling<float>;
template class Coupling<double>;

}  // namespace cpdeform::transport
