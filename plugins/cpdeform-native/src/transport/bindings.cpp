// The Python module `_transport`.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <limits>
#include <stdexcept>

#include "arrays.h"
#include "checks.h"
#include "signals.h"
#include "solver.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using cpdeform::transport::Arrays;
using cpdeform::transport::Options;
using cpdeform::transport::Outcome;

// A solver: threads and an instruction set.
class Solver {
 public:
  Solver(int threads, const std::string& instruction_set)
      : team_(checked(threads), cpdeform::signal_came), set_(cpdeform::instruction_set_of(instruction_set)) {}

  int threads() const { return team_.size(); }
  std::string instruction_set() const { return cpdeform::name_of(set_); }

  template <class Real>
  Outcome solve(const Options& options, const Arrays<Real>& arrays) {
    return cpdeform::transport::solve<Real>(team_, set_, options, arrays);
  }

 private:
  static int checked(int threads) {
    cpdeform::expect_between("threads", threads, 1, cpdeform::most_threads);
    return threads;
  }

  cpdeform::Team team_;
  cpdeform::InstructionSet set_;
};

template <class Real, class Shape>
using In = nb::ndarray<const Real, Shape, nb::c_contig, nb::device::cpu>;
template <class Real, class Shape>
using Out = nb::ndarray<Real, Shape, nb::c_contig, nb::device::cpu>;
using Points = nb::shape<-1, 3>;
using Values = nb::shape<-1>;
using Order = Out<int32_t, Values>;

template <class Real>
nb::tuple solve(Solver& self, In<Real, Points> source, In<Real, Points> target, In<Real, Values> source_weights,
                In<Real, Values> target_weights, Out<Real, Values> source_potential, Out<Real, Values> target_potential,
                Out<Real, Values> source_self, Out<Real, Values> target_self, Out<Real, Points> gradient, int exponent, double blur,
                bool debias, double scaling, double tolerance, int iterations, bool warm, double warm_tolerance,
                int warm_iterations, bool same_target, Order source_order, Order target_order, double source_extent,
                double target_extent) {
  const size_t n = source.shape(0), m = target.shape(0);
  if (n == 0 || m == 0 || std::max(n, m) > static_cast<size_t>(std::numeric_limits<int>::max() / 64))
    throw std::invalid_argument("clouds need between 1 and 33 million points");
  const int64_t rows = static_cast<int64_t>(n), columns = static_cast<int64_t>(m);
  cpdeform::expect_shape("source", source, {rows, 3});
  cpdeform::expect_shape("target", target, {columns, 3});
  cpdeform::expect_shape("source_weights", source_weights, {rows});
  cpdeform::expect_shape("target_weights", target_weights, {columns});
  cpdeform::expect_shape("source_potential", source_potential, {rows});
  cpdeform::expect_shape("target_potential", target_potential, {columns});
  cpdeform::expect_shape("source_self", source_self, {rows});
  cpdeform::expect_shape("target_self", target_self, {columns});
  cpdeform::expect_shape("gradient", gradient, {rows, 3});
  cpdeform::expect_shape("source_order", source_order, {rows});
  cpdeform::expect_shape("target_order", target_order, {columns});
  const Options options{exponent, blur, debias, scaling, tolerance, iterations, warm, warm_tolerance, warm_iterations, same_target};
  const Arrays<Real> arrays{source.data(),           target.data(),           source_weights.data(),   target_weights.data(),
                            static_cast<int>(n),     static_cast<int>(m),     source_potential.data(), target_potential.data(),
                            source_self.data(),      target_self.data(),      gradient.data(),
                            {source_order.data(), source_extent}, {target_order.data(), target_extent}};
  cpdeform::transport::check_options(options);
  cpdeform::transport::check_arrays(options, arrays);
  Outcome outcome;
  cpdeform::unlocked([&] { outcome = self.solve<Real>(options, arrays); });
  return nb::make_tuple(outcome.iterations, outcome.marginal_error, outcome.source_extent, outcome.target_extent);
}

template <class Real>
void bind_solve(nb::class_<Solver>& solver) {
  solver.def("solve", &solve<Real>, "source"_a.noconvert(), "target"_a.noconvert(), "source_weights"_a.noconvert(),
             "target_weights"_a.noconvert(), "source_potential"_a.noconvert(), "target_potential"_a.noconvert(),
             "source_self"_a.noconvert(), "target_self"_a.noconvert(), "gradient"_a.noconvert(), nb::kw_only(), "exponent"_a,
             "blur"_a, "debias"_a, "scaling"_a, "tolerance"_a, "iterations"_a, "warm"_a, "warm_tolerance"_a, "warm_iterations"_a,
             "same_target"_a, "source_order"_a.noconvert(), "target_order"_a.noconvert(), "source_extent"_a, "target_extent"_a);
}

}  // namespace

NB_MODULE(_transport, module) {
  module.doc() = "Entropic optimal transport between point clouds, on truncated soft minima.";
  module.def("instruction_sets", [] {
    std::vector<std::string> names;
    for (cpdeform::InstructionSet set : cpdeform::available_instruction_sets()) names.emplace_back(cpdeform::name_of(set));
    return names;
  });
  nb::class_<Solver> solver(module, "Solver");
  solver.def(nb::init<int, const std::string&>(), "threads"_a, "instruction_set"_a = "")
      .def_prop_ro("threads", &Solver::threads)
      .def_prop_ro("instruction_set", &Solver::instruction_set);
  bind_solve<float>(solver);
  bind_solve<double>(solver);
}
