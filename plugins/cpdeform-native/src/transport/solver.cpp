// A direct descent at a small temperature does not converge, so the temperature is lowered step by step (epsilon scaling: Schmitzer,
// "Stabilized Sparse Scaling Algorithms for Entropy Regularized Transport Problems", SIAM J. Sci. Comput. 2019). What is carried
// from step to step are the debiased potentials F = f_xy - f_xx and G = g_xy - g_yy, which hardly depend on the temperature: the
// next step starts from F + f_xx and G + g_yy of its own temperature, already a fixed point wherever the two clouds agree. Large
// clouds go through the wide blurs as an even subset.

#include "solver.h"

#include <algorithm>
#include <cmath>
#include <optional>

#include "kernels.h"

namespace cpdeform::transport {

namespace {

constexpr int subset_points = 2000;
constexpr double first_blur = 0.25;    // of the diameter
constexpr double subset_blur = 0.01;   // of the diameter: about the spacing of the subset's points
constexpr double loose = 10.0;         // tolerance of the steps before the last, as a multiple of the last one's
constexpr double self_tolerance = 0.01;  // of the step's tolerance: self-problems are easy
constexpr int self_iterations = 200;
// Weakly linked points settle long after the marginals have.
constexpr int least_iterations = 20;
// Precision of a warm solution's soft minima: beyond that of its few iterations.
constexpr int warm_cut = 10, warm_margin = 3;

template <class Real>
const Kernels<Real>& kernels_of(InstructionSet set) {
  constexpr bool single = sizeof(Real) == 4;
#if defined(CPDEFORM_HAS_AVX512)
  if (set == InstructionSet::avx512) {
    if constexpr (single) return ::avx512::transport_float;
    else return ::avx512::transport_double;
  }
#endif
#if defined(CPDEFORM_HAS_AVX2)
  if (set == InstructionSet::avx2) {
    if constexpr (single) return ::avx2::transport_float;
    else return ::avx2::transport_double;
  }
#endif
  if constexpr (single) return ::baseline::transport_float;
  else return ::baseline::transport_double;
}

// Diagonal of the box around both clouds, length units.
template <class Real>
double diameter(const Cloud<Real>& first, const Cloud<Real>& second) {
  double square = 0.0;
  for (int axis = 0; axis < 3; ++axis) {
    Real low = first.axis(axis)[0], high = low;
    for (const Cloud<Real>* cloud : {&first, &second}) {
      const auto [least, most] = std::minmax_element(cloud->axis(axis), cloud->axis(axis) + cloud->padded());
      low = std::min(low, *least);
      high = std::max(high, *most);
    }
    square += (static_cast<double>(high) - low) * (static_cast<double>(high) - low);
  }
  return std::sqrt(square);
}

// Geometric sequence from `first` down to exactly `last`, with ratios of about `scaling`.
std::vector<double> blurs(double first, double last, double scaling) {
  int steps = first > last ? static_cast<int>(std::lround(std::log(last / first) / std::log(scaling))) : 0;
  steps = std::max(steps, first > 1.001 * last ? 1 : 0);
  std::vector<double> result;
  for (int step = 0; step < steps; ++step) result.push_back(last * std::pow(first / last, 1.0 - static_cast<double>(step) / steps));
  result.push_back(last);
  return result;
}

// From debiased potentials, in the coupling's places for f and g, through `steps`. Returns the iterations at the last.
template <class Real>
int descend_ladder(Coupling<Real>& coupling, const std::vector<double>& steps, const Options& options, bool final) {
  Potentials<Real>& p = coupling.potentials();
  int used = 0;
  for (size_t step = 0; step < steps.size(); ++step) {
    const bool last = final && step + 1 == steps.size();
    const double tolerance = last ? options.tolerance : std::min(0.05, loose * options.tolerance);
    coupling.set_temperature(std::pow(steps[step], options.exponent));
    coupling.descend_self(true, self_tolerance * tolerance, self_iterations);
    coupling.descend_self(false, self_tolerance * tolerance, self_iterations);
    for (size_t i = 0; i < p.source.size(); ++i) p.source[i] += p.source_self[i];
    for (size_t j = 0; j < p.target.size(); ++j) p.target[j] += p.target_self[j];
    used = coupling.descend({tolerance, least_iterations, options.iterations, false});
    if (last) break;
    for (size_t i = 0; i < p.source.size(); ++i) p.source[i] -= p.source_self[i];
    for (size_t j = 0; j < p.target.size(); ++j) p.target[j] -= p.target_self[j];
  }
  return used;
}

// Evenly strided points. Clouds of one size keep the points of the same numbers, so that a point stays with its copy.
template <class Real>
Cloud<Real> subset(const Real* points, const Real* weights, int count) {
  const int kept = std::min(count, subset_points);
  std::vector<Real> some(3 * static_cast<size_t>(kept)), their_weights(kept);
  double total = 0.0;
  for (int n = 0; n < kept; ++n) {
    const int i = static_cast<int>(static_cast<int64_t>(n) * count / kept);
    std::copy_n(points + 3 * static_cast<size_t>(i), 3, some.data() + 3 * static_cast<size_t>(n));
    their_weights[n] = weights[i];
    total += weights[i];
  }
  // all the weight may sit on the points left out
  if (!(total > 0.0)) std::fill(their_weights.begin(), their_weights.end(), Real{1});
  return Cloud<Real>(some.data(), their_weights.data(), kept);
}

// Debiased potential at the points `rows`: soft minimum of `across` over `columns` less that of `own` over `own_columns`.
template <class Real>
std::vector<Real> extended(Team& team, const Kernels<Real>& kernels, const Cloud<Real>& rows, const Cloud<Real>& columns,
                           const std::vector<Real>& across, const Cloud<Real>& own_columns, const std::vector<Real>& own,
                           int exponent, double epsilon) {
  std::vector<Real> result(rows.padded(), Real{}), minus(rows.padded(), Real{});
  SoftMinimum<Real> first(team, kernels, rows, columns, exponent), second(team, kernels, rows, own_columns, exponent);
  first.set_temperature(epsilon);
  second.set_temperature(epsilon);
  first.start(across, result);
  first.update(across, result, false);
  second.start(own, minus);
  second.update(own, minus, false);
  for (size_t i = 0; i < result.size(); ++i) result[i] -= minus[i];
  return result;
}

template <class Real>
int solve_cold(Team& team, const Kernels<Real>& kernels, const Options& options, const Arrays<Real>& arrays,
               const Cloud<Real>& source, const Cloud<Real>& target, Coupling<Real>& coupling) {
  const double size = diameter(source, target);
  double first = std::max(options.blur, first_blur * size);
  if (std::max(source.count(), target.count()) > subset_points) {
    const double last = std::max(options.blur, subset_blur * size);
    const Cloud<Real> some_source = subset(arrays.source, arrays.source_weights, arrays.source_count);
    const Cloud<Real> some_target = subset(arrays.target, arrays.target_weights, arrays.target_count);
    Coupling<Real> coarse(team, kernels, some_source, some_target, options.exponent);
    descend_ladder(coarse, blurs(first, last, options.scaling), options, false);
    Potentials<Real>& p = coarse.potentials();
    for (size_t i = 0; i < p.source.size(); ++i) p.source[i] += p.source_self[i];
    for (size_t j = 0; j < p.target.size(); ++j) p.target[j] += p.target_self[j];
    coupling.set_temperature(coarse.epsilon());
    coupling.potentials().source = extended(team, kernels, source, some_target, p.target, some_source, p.source_self,
                                            options.exponent, coarse.epsilon());
    coupling.potentials().target = extended(team, kernels, target, some_source, p.source, some_target, p.target_self,
                                            options.exponent, coarse.epsilon());
    first = last;
  }
  return descend_ladder(coupling, blurs(first, options.blur, options.scaling), options, true);
}

}  // namespace

template <class Real>
Outcome solve(Team& team, InstructionSet set, const Options& options, const Arrays<Real>& arrays) {
  const Kernels<Real>& kernels = kernels_of<Real>(set);
  std::optional<Cloud<Real>> clouds[2];
  Order orders[2] = {arrays.source_order, arrays.target_order};
  team.run([&](int thread) {
    if (thread == 0) clouds[0].emplace(arrays.source, arrays.source_weights, arrays.source_count, orders[0]);
    if (thread == 1 % team.size()) clouds[1].emplace(arrays.target, arrays.target_weights, arrays.target_count, orders[1]);
  });
  const Cloud<Real>&source = *clouds[0], &target = *clouds[1];
  Coupling<Real> coupling(team, kernels, source, target, options.exponent);
  Potentials<Real>& p = coupling.potentials();
  Outcome outcome{};
  outcome.source_extent = orders[0].extent;
  outcome.target_extent = orders[1].extent;
  if (options.warm) {
    source.gather(arrays.source_potential, p.source);
    target.gather(arrays.target_potential, p.target);
    source.gather(arrays.source_self, p.source_self);
    target.gather(arrays.target_self, p.target_self);
    coupling.set_temperature(std::pow(options.blur, options.exponent));
    coupling.set_cut(warm_cut, warm_margin);
    outcome.iterations = coupling.descend({options.warm_tolerance, 1, options.warm_iterations, true});
    if (options.debias) {
      coupling.descend_self(true, options.warm_tolerance, options.warm_iterations);
      if (!options.same_target) coupling.descend_self(false, self_tolerance * options.tolerance, self_iterations);
    }
  } else {
    outcome.iterations = solve_cold(team, kernels, options, arrays, source, target, coupling);
  }
  std::vector<Real> gradient[3];
  outcome.marginal_error = coupling.finish(options.debias, gradient);
  for (int place = 0; place < source.count(); ++place)
    for (int axis = 0; axis < 3; ++axis)
      arrays.gradient[3 * static_cast<size_t>(source.order()[place]) + axis] =
          static_cast<Real>(source.weight()[place] * gradient[axis][place]);
  coupling.set_temperature(natural_temperature);
  source.scatter(p.source, arrays.source_potential);
  target.scatter(p.target, arrays.target_potential);
  source.scatter(p.source_self, arrays.source_self);
  target.scatter(p.target_self, arrays.target_self);
  return outcome;
}

template Outcome solve<float>(Team&, InstructionSet, const Options&, const Arrays<float>&);
template Outcome solve<double>(Team&, InstructionSet, const Options&, const Arrays<double>&);

}  // namespace cpdeform::transport
