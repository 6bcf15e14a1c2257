// The Python module `_simulator`: NumPy arrays in and out, no interpreter lock while computing.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "instruction_sets.h"
#include "interface.h"
#include "profile.h"

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

void expect_size(const char* name, size_t came, int64_t expected) {
  if (came != size_t(expected))
    throw std::invalid_argument(std::string(name) + ": came " + std::to_string(came) + " numbers, expected " +
                                std::to_string(expected));
}

// Everything that a history needs to stay alive.
template <class Real>
struct Shared {
  Shared(const Scene& s, const double* material, int threads, InstructionSet set)
      : scene(s), team(threads), engine(make_engine<Real>(set, s, material, threads)) {}
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

template <class Real>
class Simulator {
 public:
  Simulator(const Scene& scene, In<double> material, int threads, const std::string& instruction_set)
      : set_(instruction_set_of(instruction_set)) {
    expect_size("material", material.size(), 3 * scene.particle_count);
    shared_ = std::make_shared<Shared<Real>>(scene, material.data(), threads, set_);
  }

  std::string instruction_set() const { return name_of(set_); }

  std::unique_ptr<Checkpoints<Real>> rollout(int64_t worlds, int64_t steps, In<Real> position, In<Real> velocity, In<Real> affine,
                                             In<Real> strain, In<Real> pose, In<Real> actions, Out<Real> positions, Out<Real> poses,
                                             Out<Real> last_velocity, Out<Real> last_affine, Out<Real> last_strain, bool keep) {
    const Scene& s = shared_->scene;
    const int64_t particles = worlds * s.particle_count, tools = worlds * s.tool_count * pose_size;
    expect_size("position", position.size(), 3 * particles);
    expect_size("velocity", velocity.size(), 3 * particles);
    expect_size("affine", affine.size(), 9 * particles);
    expect_size("strain", strain.size(), 6 * particles);
    expect_size("pose", pose.size(), tools);
    expect_size("actions", actions.size(), worlds * steps * s.action_size);
    expect_size("positions", positions.size(), 3 * particles * (steps + 1));
    expect_size("poses", poses.size(), tools * (steps + 1));
    expect_size("last_velocity", last_velocity.size(), 3 * particles);
    expect_size("last_affine", last_affine.size(), 9 * particles);
    expect_size("last_strain", last_strain.size(), 6 * particles);
    const RolloutArguments<Real> arguments = {worlds,           steps,         position.data(), velocity.data(),
                                              affine.data(),    strain.data(), pose.data(),     actions.data(),
                                              positions.data(), poses.data(),  last_velocity.data(),
                                              last_affine.data(), last_strain.data(), keep};
    nb::gil_scoped_release unlocked;
    auto made = std::make_unique<Checkpoints<Real>>();
    made->shared = shared_;
    made->worlds = worlds;
    made->steps = steps;
    made->history.reset(shared_->engine->make_history(worlds, steps));
    shared_->team.run([&](int thread) { shared_->engine->rollout(shared_->team, thread, arguments, *made->history); });
    return made;
  }

  void release_memory() {
    nb::gil_scoped_release unlocked;
    shared_->team.run([&](int thread) {
      if (thread == 0) shared_->engine->release_memory();
    });
  }

  // Whether checkpoints come from this simulator's rollout.
  bool made(nb::object checkpoints) const {
    Checkpoints<Real>* known = nullptr;
    return nb::try_cast(checkpoints, known) && known && known->shared == shared_;
  }

  void vjp(Checkpoints<Real>& checkpoints, In<Real> actions, In<Real> grad_positions, std::optional<In<Real>> grad_poses,
           std::optional<In<Real>> grad_last_velocity, std::optional<In<Real>> grad_last_affine,
           std::optional<In<Real>> grad_last_strain, Out<double> grad_actions, Out<Real> grad_position, Out<Real> grad_velocity, Out<Real> grad_affine, Out<Real> grad_strain,
           Out<double> grad_pose) {
    const Scene& s = shared_->scene;
    const int64_t worlds = checkpoints.worlds, steps = checkpoints.steps;
    const int64_t particles = worlds * s.particle_count, tools = worlds * s.tool_count * pose_size;
    if (checkpoints.shared != shared_) throw std::invalid_argument("checkpoints: made by another simulator");
    expect_size("actions", actions.size(), worlds * steps * s.action_size);
    expect_size("grad_positions", grad_positions.size(), 3 * particles * (steps + 1));
    if (grad_poses) expect_size("grad_poses", grad_poses->size(), tools * (steps + 1));
    if (bool(grad_last_velocity) != bool(grad_last_affine) || bool(grad_last_velocity) != bool(grad_last_strain))
      throw std::invalid_argument("grad_last: expected gradients of velocity, affine and strain, or of none");
    if (grad_last_velocity) {
      expect_size("grad_last_velocity", grad_last_velocity->size(), 3 * particles);
      expect_size("grad_last_affine", grad_last_affine->size(), 9 * particles);
      expect_size("grad_last_strain", grad_last_strain->size(), 6 * particles);
    }
    expect_size("grad_actions", grad_actions.size(), worlds * steps * s.action_size);
    expect_size("grad_position", grad_position.size(), 3 * particles);
    expect_size("grad_velocity", grad_velocity.size(), 3 * particles);
    expect_size("grad_affine", grad_affine.size(), 9 * particles);
    expect_size("grad_strain", grad_strain.size(), 6 * particles);
    expect_size("grad_pose", grad_pose.size(), tools);
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
    nb::gil_scoped_release unlocked;
    shared_->team.run([&](int thread) { shared_->engine->vjp(shared_->team, thread, arguments, *checkpoints.history); });
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
  nb::class_<Simulator<Real>>(m, name)
      .def(nb::init<const Scene&, In<double>, int, const std::string&>(), "scene"_a, "material"_a, "threads"_a, "instruction_set"_a)
      .def_prop_ro("instruction_set", &Simulator<Real>::instruction_set)
      .def("release_memory", &Simulator<Real>::release_memory)
      .def("made", &Simulator<Real>::made, "checkpoints"_a)
      .def("rollout", &Simulator<Real>::rollout, "worlds"_a, "steps"_a, "position"_a, "velocity"_a, "affine"_a, "strain"_a, "pose"_a,
           "actions"_a, "positions"_a, "poses"_a, "last_velocity"_a, "last_affine"_a, "last_strain"_a, "keep"_a)
      .def("vjp", &Simulator<Real>::vjp, "checkpoints"_a, "actions"_a, "grad_positions"_a, "grad_poses"_a.none(),
           "grad_last_velocity"_a.none(), "grad_last_affine"_a.none(), "grad_last_strain"_a.none(), "grad_actions"_a, "grad_position"_a, "grad_velocity"_a, "grad_affine"_a, "grad_strain"_a, "grad_pose"_a);
}

void copy(const std::vector<double>& from, double* to, size_t size, const char* name) {
  if (from.size() > size) throw std::invalid_argument(std::string(name) + ": too many numbers");
  for (size_t i = 0; i < size; ++i) to[i] = i < from.size() ? from[i] : 0.0;
}

void add_tool(Scene& scene, int kind, const std::vector<double>& size, double friction, int action_size,
              const std::vector<double>& scale, const std::vector<double>& lower, const std::vector<double>& upper) {
  if (scene.tool_count == max_tools) throw std::invalid_argument("scene: too many tools");
  Tool& tool = scene.tools[scene.tool_count++];
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
          },
          nb::kw_only(), "time_step"_a, "node_distance"_a, "particle_mass"_a, "gravity"_a, "softness"_a, "ground_friction"_a,
          "ground_nodes"_a, "wall_nodes"_a, "lower"_a, "upper"_a, "grid_size"_a, "substeps"_a, "particle_count"_a)
      .def("add_tool", &add_tool, nb::kw_only(), "kind"_a, "size"_a, "friction"_a, "action_size"_a, "scale"_a, "lower"_a, "upper"_a);
  bind<float>(m, "SimulatorFloat", "CheckpointsFloat");
  bind<double>(m, "SimulatorDouble", "CheckpointsDouble");
}
