// The Python module `_transport`.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <limits>
#include <stdexcept>

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
      : team_(threads), set_(cpdeform::instruction_set_of(instruction_set)) {}

  int threads() const { return team_.size(); }
  std::string instruction_set() const { return cpdeform::name_of(set_); }

  template <class Real>
  Outcome solve(const Options& options, const Arrays<Real>& arrays) {
    return cpdeform::transport::solve<Real>(team_, set_, options, arrays);
  }

 private:
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

// Numbers that are read, of points, come from outside, maybe from a file.
void check(const Order& order, size_t count, double extent) {
  const auto outside = [count](int32_t number) { return number < 0 || static_cast<size_t>(number) >= count; };
  if (order.shape(0) != count) throw std::invalid_argument("an order of another size than its cloud");
  if (extent > 0.0 && std::any_of(order.data(), order.data() + count, outside))
    throw std::invalid_argument("an order with numbers beyond its cloud");
}

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
  if (source_weights.shape(0) != n || source_potential.shape(0) != n || source_self.shape(0) != n || gradient.shape(0) != n ||
      target_weights.shape(0) != m || target_potential.shape(0) != m || target_self.shape(0) != m)
    throw std::invalid_argument("arrays of other sizes than their clouds");
  check(source_order, n, source_extent);
  check(target_order, m, target_extent);
  const Options options{exponent, blur, debias, scaling, tolerance, iterations, warm, warm_tolerance, warm_iterations, same_target};
  const Arrays<Real> arrays{source.data(),           target.data(),           source_weights.data(),   target_weights.data(),
                            static_cast<int>(n),     static_cast<int>(m),     source_potential.data(), target_potential.data(),
                            source_self.data(),      target_self.data(),      gradient.data(),
                            {source_order.data(), source_extent}, {target_order.data(), target_extent}};
  Outcome outcome;
  {
    nb::gil_scoped_release release;
    outcome = self.solve<Real>(options, arrays);
  }
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
