// The Python module `_simulator`: NumPy arrays in and out, no interpreter lock while computing.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "arrays.h"
#include "checks.h"
#include "instruction_sets.h"
#include "interface.h"
#include "profile.h"
#include "signals.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace cpdeform {
namespace {

template <class Real>
using In = nb::ndarray<const Real, nb::c_contig, nb::device::cpu>;
template <class Real>
using Out = nb::ndarray<Real, nb::c_contig, nb::device::cpu>;

template <class Real>
Engine<Real>* make_engine(InstructionSet set, const Scene& scene, const double* material, int threads) {
  constexpr bool single = std::is_same_v<Real, float>;
  auto choose = [&](auto* in_float, auto* in_double) -> Engine<Real>* {
    if constexpr (single)
      return in_float(scene, material, threads);
    else
      return in_double(scene, material, threads);
  };
#if defined(CPDEFORM_HAS_AVX512)
  if (set == InstructionSet::avx512) return choose(engines_avx512::make_engine_float, engines_avx512::make_engine_double);
#endif
#if defined(CPDEFORM_HAS_AVX2)
  if (set == InstructionSet::avx2) return choose(engines_avx2::make_engine_float, engines_avx2::make_engine_double);
#endif
  return choose(engines_baseline::make_engine_float, engines_baseline::make_engine_double);
}

// Everything that a history needs to stay alive.
template <class Real>
struct Shared {
  Shared(const Scene& s, const double* material, int threads, InstructionSet set)
      : scene(with_own_grids(s)), team(threads, signal_came), engine(make_engine<Real>(set, scene, material, threads)) {}

  Scene with_own_grids(Scene s) {
    for (int m = 0; m < s.tool_count; ++m) {
      Tool& tool = s.tools[m];
      if (!tool.grid) continue;
      grids[m].assign(tool.grid, tool.grid + tool.grid_count);
      tool.grid = grids[m].data();
    }
    return s;
  }

  std::vector<double> grids[max_tools];  // before the scene, which points to them
  Scene scene;
  Team team;
  std::unique_ptr<Engine<Real>> engine;
};

template <class Real>
struct Checkpoints {
  std::shared_ptr<Shared<Real>> shared;  // before the history: destroyed after it
  std::unique_ptr<History> history;
  int64_t worlds, steps;
};

// Their products with the counts of a scene stay within 64 bits.
constexpr int64_t most_grid_nodes = 1024;
constexpr int64_t most_worlds = int64_t(1) << 20, most_steps = int64_t(1) << 28;

template <class Real>
class Simulator {
 public:
  Simulator(const Scene& scene, In<double> material, int threads, const std::string& instruction_set)
      : set_(instruction_set_of(instruction_set)) {
    check_scene(scene);
    expect_shape("material", material, {3, scene.particle_count});
    expect_between("threads", threads, 1, most_threads);
    shared_ = std::make_shared<Shared<Real>>(scene, material.data(), threads, set_);
  }

  std::string instruction_set() const { return name_of(set_); }

  std::unique_ptr<Checkpoints<Real>> rollout(int64_t worlds, int64_t steps, In<Real> position, In<Real> velocity, In<Real> affine,
                                             In<Real> strain, In<Real> pose, In<Real> actions, Out<Real> positions, Out<Real> poses,
                                             Out<Real> last_velocity, Out<Real> last_affine, Out<Real> last_strain, bool keep) {
    const Scene& s = shared_->scene;
    const int64_t n = s.particle_count, tools = s.tool_count, numbers = s.action_size;
    expect_between("worlds", worlds, 1, most_worlds);
    expect_between("steps", steps, 0, most_steps);
    expect_shape("position", position, {worlds, n, 3});
    expect_shape("velocity", velocity, {worlds, n, 3});
    expect_shape("affine", affine, {worlds, n, 3, 3});
    expect_shape("strain", strain, {worlds, n, 6});
    expect_shape("pose", pose, {worlds, tools, pose_size});
    expect_shape("actions", actions, {worlds, steps, numbers});
    expect_shape("positions", positions, {worlds, steps + 1, n, 3});
    expect_shape("poses", poses, {worlds, steps + 1, tools, pose_size});
    expect_shape("last_velocity", last_velocity, {worlds, n, 3});
    expect_shape("last_affine", last_affine, {worlds, n, 3, 3});
    expect_shape("last_strain", last_strain, {worlds, n, 6});
    const RolloutArguments<Real> arguments = {worlds,           steps,         position.data(), velocity.data(),
                                              affine.data(),    strain.data(), pose.data(),     actions.data(),
                                              positions.data(), poses.data(),  last_velocity.data(),
                                              last_affine.data(), last_strain.data(), keep};
    auto made = std::make_unique<Checkpoints<Real>>();
    made->shared = shared_;
    made->worlds = worlds;
    made->steps = steps;
    unlocked([&] {
      made->history.reset(shared_->engine->make_history(worlds, steps));
      shared_->team.run([&](int thread) { shared_->engine->rollout(shared_->team, thread, arguments, *made->history); });
    });
    return made;
  }

  void release_memory() {
    unlocked([&] {
      shared_->team.run([&](int thread) {
        if (thread == 0) shared_->engine->release_memory();
      });
    });
  }

  // Whether checkpoints come from this simulator's rollout.
  bool made(nb::object checkpoints) const {
    Checkpoints<Real>* known = nullptr;
    return nb::try_cast(checkpoints, known) && known && known->shared == shared_;
  }

  void vjp(Checkpoints<Real>& checkpoints, In<Real> actions, In<Real> grad_positions, std::optional<In<Real>> grad_poses,
           std::optional<In<Real>> grad_last_velocity, std::optional<In<Real>> grad_last_affine,
           std::optional<In<Real>> grad_last_strain, Out<double> grad_actions, Out<Real> grad_position, Out<Real> grad_velocity,
           Out<Real> grad_affine, Out<Real> grad_strain, Out<double> grad_pose) {
    const Scene& s = shared_->scene;
    const int64_t worlds = checkpoints.worlds, steps = checkpoints.steps;
    const int64_t n = s.particle_count, tools = s.tool_count, numbers = s.action_size;
    if (checkpoints.shared != shared_) throw std::invalid_argument("checkpoints: made by another simulator");
    expect_shape("actions", actions, {worlds, steps, numbers});
    expect_shape("grad_positions", grad_positions, {worlds, steps + 1, n, 3});
    if (grad_poses) expect_shape("grad_poses", *grad_poses, {worlds, steps + 1, tools, pose_size});
    if (bool(grad_last_velocity) != bool(grad_last_affine) || bool(grad_last_velocity) != bool(grad_last_strain))
      throw std::invalid_argument("grad_last: expected gradients of velocity, affine and strain, or of none");
    if (grad_last_velocity) {
      expect_shape("grad_last_velocity", *grad_last_velocity, {worlds, n, 3});
      expect_shape("grad_last_affine", *grad_last_affine, {worlds, n, 3, 3});
      expect_shape("grad_last_strain", *grad_last_strain, {worlds, n, 6});
    }
    expect_shape("grad_actions", grad_actions, {worlds, steps, numbers});
    expect_shape("grad_position", grad_position, {worlds, n, 3});
    expect_shape("grad_velocity", grad_velocity, {worlds, n, 3});
    expect_shape("grad_affine", grad_affine, {worlds, n, 3, 3});
    expect_shape("grad_strain", grad_strain, {worlds, n, 6});
    expect_shape("grad_pose", grad_pose, {worlds, tools, pose_size});
    const VjpArguments<Real> arguments = {worlds,
                                          steps,
                                          actions.data(),
                                          grad_positions.data(),
                                          grad_poses ? grad_poses->data() : nullptr,
                                          grad_last_velocity ? grad_last_velocity->data() : nullptr,
                                          grad_last_affine ? grad_last_affine->data() : nullptr,
                                          grad_last_strain ? grad_last_strain->data() : nullptr,
                                          grad_actions.data(),
                                          grad_position.data(),
                                          grad_velocity.data(),
                                          grad_affine.data(),
                                          grad_strain.data(),
                                          grad_pose.data()};
    unlocked([&] {
      shared_->team.run([&](int thread) { shared_->engine->vjp(shared_->team, thread, arguments, *checkpoints.history); });
    });
  }

 private:
  InstructionSet set_;
  std::shared_ptr<Shared<Real>> shared_;
};

template <class Real>
void bind(nb::module_& m, const char* name, const char* checkpoints) {
  nb::class_<Checkpoints<Real>>(m, checkpoints)
      .def_ro("worlds", &Checkpoints<Real>::worlds)
      .def_ro("steps", &Checkpoints<Real>::steps)
      .def_prop_ro("nbytes", [](const Checkpoints<Real>& c) { return c.history->bytes(); });
  // as they come: of a copy in another type, results would be lost
  const auto array = [](const char* argument) { return nb::arg(argument).noconvert(); };
  nb::class_<Simulator<Real>>(m, name)
      .def(nb::init<const Scene&, In<double>, int, const std::string&>(), "scene"_a, array("material"), "threads"_a,
           "instruction_set"_a)
      .def_prop_ro("instruction_set", &Simulator<Real>::instruction_set)
      .def("release_memory", &Simulator<Real>::release_memory)
      .def("made", &Simulator<Real>::made, "checkpoints"_a)
      .def("rollout", &Simulator<Real>::rollout, "worlds"_a, "steps"_a, array("position"), array("velocity"), array("affine"),
           array("strain"), array("pose"), array("actions"), array("positions"), array("poses"), array("last_velocity"),
           array("last_affine"), array("last_strain"), "keep"_a)
      .def("vjp", &Simulator<Real>::vjp, "checkpoints"_a, array("actions"), array("grad_positions"), array("grad_poses").none(),
           array("grad_last_velocity").none(), array("grad_last_affine").none(), array("grad_last_strain").none(),
           array("grad_actions"), array("grad_position"), array("grad_velocity"), array("grad_affine"), array("grad_strain"),
           array("grad_pose"));
}

void copy(const std::vector<double>& from, double* to, size_t size, const char* name) {
  check_numbers(name, from, 0, size);
  for (size_t i = 0; i < size; ++i) to[i] = i < from.size() ? from[i] : 0.0;
}

void add_tool(Scene& scene, int kind, const std::vector<double>& size, double friction, int action_size,
              const std::vector<double>& scale, const std::vector<double>& lower, const std::vector<double>& upper,
              std::optional<In<double>> grid) {
  if (scene.tool_count == max_tools) throw std::invalid_argument("scene: too many tools");
  check_tool(kind, size, friction, action_size, scale, lower, upper);
  if (kind == mesh) {
    for (int a = 1; a < 4; ++a) expect_between("size", int64_t(std::min(size[a], 1e6)), 3, most_grid_nodes);
    if (!grid) throw std::invalid_argument("grid: got nothing, expected the distances of a mesh");
    const int64_t count = grid->ndim() ? int64_t(grid->shape(0)) : 0;
    expect_shape("grid", *grid, {count});
    check_mesh(grid->data(), count, int64_t(size[1]) * int64_t(size[2]) * int64_t(size[3]));
  }
  Tool& tool = scene.tools[scene.tool_count++];
  tool.grid = kind == mesh ? grid->data() : nullptr;
  tool.grid_count = kind == mesh ? int64_t(grid->shape(0)) : 0;
  tool.kind = kind;
  tool.friction = friction;
  tool.action_offset = scene.action_size;
  tool.action_size = action_size;
  scene.action_size += action_size;
  copy(size, tool.size, 4, "size");
  copy(scale, tool.scale, 7, "scale");
  copy(lower, tool.lower, 3, "lower");
  copy(upper, tool.upper, 3, "upper");
}

}  // namespace
}  // namespace cpdeform

NB_MODULE(_simulator, m) {
  using namespace cpdeform;
  // a simulator that lives until the interpreter ends (in a traceback, say) is no error
  nb::set_leak_warnings(false);
  m.attr("MAX_TOOLS") = max_tools;
  m.def("instruction_sets", [] {
    std::vector<std::string> names;
    for (InstructionSet set : available_instruction_sets()) names.push_back(name_of(set));
    return names;
  });
#if defined(CPDEFORM_PROFILE) && defined(__x86_64__)
  m.def("take_profile", [] {
    const char* names[] = {"sorting", "material", "records", "scatter", "gather", "grid", "tools", "other"};
    nb::dict ticks;
    for (int p = 0; p < int(Phase::count); ++p) ticks[names[p]] = phase_ticks[p].exchange(0);
    return ticks;
  });
#endif
  nb::class_<Scene>(m, "Scene")
      .def(
          "__init__",
          [](Scene* scene, double time_step, double node_distance, double particle_mass, const std::vector<double>& gravity,
             double softness, double ground_friction, int ground_nodes, int wall_nodes, const std::vector<double>& lower,
             const std::vector<double>& upper, int grid_size, int substeps, int64_t particle_count) {
            check_numbers("gravity", gravity, 3, 3);
            check_numbers("lower", lower, 3, 3);
            check_numbers("upper", upper, 3, 3);
            new (scene) Scene{};
            scene->time_step = time_step;
            scene->node_distance = node_distance;
            scene->particle_mass = particle_mass;
            scene->softness = softness;
            scene->ground_friction = ground_friction;
            scene->ground_nodes = ground_nodes;
            scene->wall_nodes = wall_nodes;
            scene->grid_size = grid_size;
            scene->substeps = substeps;
            scene->particle_count = particle_count;
            copy(gravity, scene->gravity, 3, "gravity");
            copy(lower, scene->lower, 3, "lower");
            copy(upper, scene->upper, 3, "upper");
            check_scene(*scene);
          },
          nb::kw_only(), "time_step"_a, "node_distance"_a, "particle_mass"_a, "gravity"_a, "softness"_a, "ground_friction"_a,
          "ground_nodes"_a, "wall_nodes"_a, "lower"_a, "upper"_a, "grid_size"_a, "substeps"_a, "particle_count"_a)
      .def("add_tool", &add_tool, nb::kw_only(), "kind"_a, "size"_a, "friction"_a, "action_size"_a, "scale"_a, "lower"_a, "upper"_a,
           "grid"_a.noconvert().none() = nb::none(), nb::keep_alive<1, 9>());
  bind<float>(m, "SimulatorFloat", "CheckpointsFloat");
  bind<double>(m, "SimulatorDouble", "CheckpointsDouble");
}
