// The engine of one instruction set: worlds over threads, rollouts over steps.
#include "interface.h"
#include "world.h"

namespace CPDEFORM_ISA {

template <class Real>
class EngineOf final : public cpdeform::Engine<Real> {
  using Work = Workspace<Real>;

  class HistoryOf final : public cpdeform::History {
   public:
    explicit HistoryOf(int64_t count) : count(count), worlds(new WorldHistory<Real>[count]) {}
    ~HistoryOf() override { delete[] worlds; }
    int64_t bytes() const override {
      int64_t total = 0;
      for (int64_t w = 0; w < count; ++w) total += worlds[w].arena.bytes();
      return total;
    }
    int64_t count;
    WorldHistory<Real>* worlds;
  };

 public:
  EngineOf(const cpdeform::Scene& scene, const double* material, int threads)
      : world_(scene, material), threads_(threads), works_(new Work*[threads + 1]) {
    make_works();
  }
  ~EngineOf() override {
    delete_works();
    delete[] works_;
  }

  void release_memory() override {
    delete_works();
    make_works();
    pool_.clear();
  }

  cpdeform::History* make_history(int64_t worlds, int64_t steps) override {
    HistoryOf* history = new HistoryOf(worlds);
    try {
      fill(*history, worlds, steps);
    } catch (...) {
      delete history;
      throw;
    }
    return history;
  }

  void fill(HistoryOf& history, int64_t worlds, int64_t steps) {
    const cpdeform::Scene& scene = world_.scene();
    for (int64_t w = 0; w < worlds; ++w) {
      WorldHistory<Real>& h = history.worlds[w];
      h.arena.attach(&pool_);
      h.steps = h.arena.template take<StepRecord<Real>>(steps);
      for (int64_t s = 0; s < steps; ++s) h.steps[s] = StepRecord<Real>{};
      h.poses = h.arena.template take<double>((steps * scene.substeps + 1) * scene.tool_count * cpdeform::pose_size);
    }
  }

  void rollout(cpdeform::Team& team, int thread, const cpdeform::RolloutArguments<Real>& a, cpdeform::History& history) override {
    HistoryOf& kept = static_cast<HistoryOf&>(history);
    over_worlds(team, thread, a.worlds, [&](const Crew& crew, Work& work, int64_t w) {
      rollout_world(crew, work, a, w, kept.worlds[w]);
    });
  }

  void vjp(cpdeform::Team& team, int thread, const cpdeform::VjpArguments<Real>& a, cpdeform::History& history) override {
    HistoryOf& kept = static_cast<HistoryOf&>(history);
    over_worlds(team, thread, a.worlds,
                [&](const Crew& crew, Work& work, int64_t w) { vjp_world(crew, work, a, w, kept.worlds[w]); });
  }

 private:
  void make_works() {
    for (int t = 0; t <= threads_; ++t) works_[t] = new Work(t < threads_ ? 1 : threads_, &pool_);
  }
  void delete_works() {
    for (int t = 0; t <= threads_; ++t) delete works_[t];
  }

  // As many worlds as there are threads go side by side, each on one thread; those that are left over one after the other, each on
  // all threads.
  template <class F>
  void over_worlds(cpdeform::Team& team, int thread, int64_t worlds, F&& work) {
    const int size = team.size();
    const int64_t side_by_side = worlds / size * size;
    for (int64_t w = thread; w < side_by_side; w += size) work(Crew{nullptr, 0, 1, &team, thread}, *works_[thread], w);
    for (int64_t w = side_by_side; w < worlds; ++w) work(Crew{&team, thread, size, &team, thread}, *works_[size], w);
  }

  // Memory for frames and sorting. One thread.
  void open(Work& work, bool backward, int crew, int64_t pose_numbers) {
    const int64_t stride = world_.stride(), numbers = component_count * stride;
    work.reset();
    work.attempt([&] {
      work.last.reserve(numbers);
      work.first.reserve(numbers);
      work.second.reserve(numbers);
      work.material.reserve(3 * stride);
      work.permutation.reserve(stride);
      int32_t* identity = work.identity.reserve(stride);
      for (int64_t p = 0; p < stride; ++p) identity[p] = int32_t(p < world_.count() ? p : world_.count() - 1);
      work.order = identity;
      if (backward) {
        work.gradient.reserve(numbers);
        work.sorted_gradient.reserve(numbers);
        work.tool_gradients.reserve(crew * cpdeform::max_tools);
        work.pose_numbers = pose_numbers;
        double* grad_poses = work.grad_poses.reserve(crew * pose_numbers);
        for (int64_t i = 0; i < crew * pose_numbers; ++i) grad_poses[i] = 0;
      }
    });
  }

  void rollout_world(const Crew& crew, Work& work, const cpdeform::RolloutArguments<Real>& a, int64_t w,
                     WorldHistory<Real>& history) {
    const cpdeform::Scene& scene = world_.scene();
    const int64_t n = world_.count(), stride = world_.stride(), width = int64_t(scene.tool_count) * cpdeform::pose_size;
    if (crew.thread == 0) {
      open(work, false, crew.size, 0);
      for (int64_t i = 0; i < width; ++i) history.poses[i] = double(a.pose[w * width + i]);
      Motion::move(scene, a.actions + w * a.steps * scene.action_size, a.steps, history.poses);
      Real* poses = a.poses + w * (a.steps + 1) * width;
      for (int64_t s = 0; s <= a.steps; ++s)
        for (int64_t i = 0; i < width; ++i) poses[s * width + i] = Real(history.poses[s * scene.substeps * width + i]);
    }
    crew.barrier();
    work.check();
    const Range range = world_.range_of(crew);
    Real* positions = a.positions + w * (a.steps + 1) * n * 3;
    for (int64_t p = range.first; p < World<Real>::padded(range); ++p) {
      const int64_t q = w * n + (p < n ? p : n - 1);
      Real* to = work.last.get() + p;
      for (int c = 0; c < 3; ++c) to[(at_position + c) * stride] = a.position[3 * q + c];
      for (int c = 0; c < 3; ++c) to[(at_velocity + c) * stride] = a.velocity[3 * q + c];
      for (int c = 0; c < 9; ++c) to[(at_affine + c) * stride] = a.affine[9 * q + c];
      for (int c = 0; c < 6; ++c) to[(at_strain + c) * stride] = a.strain[6 * q + c];
      if (p < n)
        for (int c = 0; c < 3; ++c) positions[3 * p + c] = a.position[3 * q + c];
    }
    crew.barrier();
    const bool keep = a.keep;
    for (int64_t step = 0; step < a.steps; ++step) {
      StepRecord<Real>& record = history.steps[step];
      world_.forward(crew, work, history.arena, record, history.poses, step, keep);
      Real* snapshot = positions + (step + 1) * n * 3;
      for (int64_t p = range.first; p < range.last; ++p)
        for (int c = 0; c < 3; ++c) snapshot[3 * int64_t(record.order[p]) + c] = work.last[(at_position + c) * stride + p];
    }
    for (int64_t p = range.first; p < range.last; ++p) {
      const int64_t q = w * n + work.order[p];
      const Real* from = work.last.get() + p;
      for (int c = 0; c < 3; ++c) a.last_velocity[3 * q + c] = from[(at_velocity + c) * stride];
      for (int c = 0; c < 9; ++c) a.last_affine[9 * q + c] = from[(at_affine + c) * stride];
      for (int c = 0; c < 6; ++c) a.last_strain[6 * q + c] = from[(at_strain + c) * stride];
    }
    crew.barrier();
  }

  void vjp_world(const Crew& crew, Work& work, const cpdeform::VjpArguments<Real>& a, int64_t w, WorldHistory<Real>& history) {
    const cpdeform::Scene& scene = world_.scene();
    const int64_t n = world_.count(), stride = world_.stride(), width = int64_t(scene.tool_count) * cpdeform::pose_size;
    const int64_t pose_numbers = (a.steps * scene.substeps + 1) * width;
    if (crew.thread == 0) open(work, true, crew.size, pose_numbers);
    crew.barrier();
    work.check();
    const Range range = world_.range_of(crew);
    const Real* grad_positions = a.grad_positions + w * (a.steps + 1) * n * 3;
    Real* gradient = work.gradient.get();
    for (int c = 0; c < component_count; ++c)
      for (int64_t p = range.first; p < range.last; ++p)
        gradient[c * stride + p] = c < 3 ? grad_positions[(a.steps * n + p) * 3 + c] : Real(0);
    if (a.grad_last_velocity)
      for (int64_t p = range.first; p < range.last; ++p) {
        const int64_t q = w * n + p;
        Real* to = gradient + p;
        for (int c = 0; c < 3; ++c) to[(at_velocity + c) * stride] = a.grad_last_velocity[3 * q + c];
        for (int c = 0; c < 9; ++c) to[(at_affine + c) * stride] = a.grad_last_affine[9 * q + c];
        for (int c = 0; c < 6; ++c) to[(at_strain + c) * stride] = a.grad_last_strain[6 * q + c];
      }
    crew.barrier();
    for (int64_t step = a.steps - 1; step >= 0; --step)
      world_.backward(crew, work, history.steps[step], history.poses, step, grad_positions + step * n * 3);
    for (int64_t p = range.first; p < range.last; ++p) {
      const int64_t q = w * n + p;
      const Real* from = gradient + p;
      for (int c = 0; c < 3; ++c) a.grad_position[3 * q + c] = from[(at_position + c) * stride];
      for (int c = 0; c < 3; ++c) a.grad_velocity[3 * q + c] = from[(at_velocity + c) * stride];
      for (int c = 0; c < 9; ++c) a.grad_affine[9 * q + c] = from[(at_affine + c) * stride];
      // the kernels hold a symmetric matrix; an off-diagonal number stands for two entries
      for (int c = 0; c < 6; ++c) a.grad_strain[6 * q + c] = from[(at_strain + c) * stride] * Real(c < 3 ? 1 : 2);
    }
    if (crew.thread == 0) pull_back_tools(crew, work, a, w, history, pose_numbers, width);
    crew.barrier();
  }

  void pull_back_tools(const Crew& crew, Work& work, const cpdeform::VjpArguments<Real>& a, int64_t w,
                       const WorldHistory<Real>& history, int64_t pose_numbers, int64_t width) {
    const cpdeform::Scene& scene = world_.scene();
    double* total = work.grad_poses.get();
    for (int t = 1; t < crew.size; ++t)
      for (int64_t i = 0; i < pose_numbers; ++i) total[i] += work.grad_poses[t * pose_numbers + i];
    if (a.grad_poses)
      for (int64_t s = 0; s <= a.steps; ++s)
        for (int64_t i = 0; i < width; ++i)
          total[s * scene.substeps * width + i] += double(a.grad_poses[(w * (a.steps + 1) + s) * width + i]);
    const int64_t actions = w * a.steps * scene.action_size;
    Motion::move_adjoint(scene, a.actions + actions, a.steps, history.poses, total, a.grad_actions + actions);
    for (int64_t i = 0; i < width; ++i) a.grad_pose[w * width + i] = total[i];
  }

  Pool pool_;
  World<Real> world_;
  int threads_;
  Work** works_;  // of each thread alone, and of all together
};

}  // namespace CPDEFORM_ISA

#define CPDEFORM_JOIN(a, b) a##b
#define CPDEFORM_ENGINES(isa) CPDEFORM_JOIN(engines_, isa)

namespace cpdeform {
namespace CPDEFORM_ENGINES(CPDEFORM_ISA) {

Engine<float>* make_engine_float(const Scene& scene, const double* material, int threads) {
  return new CPDEFORM_ISA::EngineOf<float>(scene, material, threads);
}
Engine<double>* make_engine_double(const Scene& scene, const double* material, int threads) {
  return new CPDEFORM_ISA::EngineOf<double>(scene, material, threads);
}

}  // namespace CPDEFORM_ENGINES(CPDEFORM_ISA)
}  // namespace cpdeform
