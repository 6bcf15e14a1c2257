// One environment step of one world, forward and backward.
//
// The threads of a `Crew` call the same function together. Each owns a range of the particles, sorted by cell at the start of the
// step, and scatters to a grid of its own over just its particles' nodes; between barriers each owns some layers of the common grid.
#pragma once

#include "grid_pass.h"
#include "motion.h"
#include "profile.h"
#include "records.h"
#include "transfer.h"

namespace CPDEFORM_ISA {

template <class Real>
class World {
 public:
  static constexpr int lanes = Simd<Real>::lanes;
  using T = Transfer<Real>;
  using Work = Workspace<Real>;
  using Record = StepRecord<Real>;

  World(const cpdeform::Scene& scene, const double* material)
      : scene_(scene), pass_(scene), count_(scene.particle_count), stride_((count_ + lanes - 1) / lanes * lanes) {
    constants_.time_step = Real(scene.time_step);
    constants_.node_distance = Real(scene.node_distance);
    constants_.inverse_distance = Real(1.0 / scene.node_distance);
    constants_.particle_mass = Real(scene.particle_mass);
    constants_.stress_scale = Real(-scene.time_step * scene.particle_mass * 4.0 / (scene.node_distance * scene.node_distance));
    for (int a = 0; a < 3; ++a) {
      constants_.lower[a] = Real(scene.lower[a]);
      constants_.upper[a] = Real(scene.upper[a]);
    }
    constants_.grid_size = scene.grid_size;
    material_.reserve(size_t(3 * count_));
    for (int64_t i = 0; i < 3 * count_; ++i) material_[i] = Real(material[i]);
  }

  const cpdeform::Scene& scene() const { return scene_; }
  int64_t count() const { return count_; }
  int64_t stride() const { return stride_; }

  // Particles of a thread.
  Range range_of(const Crew& crew) const {
    const int64_t blocks = stride_ / lanes;
    const int64_t first = blocks * crew.thread / crew.size * lanes, last = blocks * (crew.thread + 1) / crew.size * lanes;
    return {first, last < count_ ? last : count_};
  }
  // The same with the particles that fill up the last vector.
  static int64_t padded(const Range& range) { return (range.last + lanes - 1) / lanes * lanes; }

  void make_record(Arena& arena, Record& record, bool keep) const {
    if (!record.order) record.order = arena.take<int32_t>(stride_);
    if (keep) {
      record.frames = arena.take<Real>(int64_t(scene_.substeps) * component_count * stride_);
      record.last_velocity = arena.take<Real>(3 * stride_);
      record.momentum = arena.take<Grid<Real>>(scene_.substeps);
    } else {
      record.start = arena.take<Real>(component_count * stride_);
    }
  }

  // One step: from the particles `work.last`, which stand in `work.order`, to those after it, which then stand in `record.order`.
  void forward(const Crew& crew, Work& work, Arena& arena, Record& record, const double* poses, int64_t step, bool keep) const {
    if (crew.thread == 0)
      work.attempt([&] {
        make_record(arena, record, keep);
        sort(work, record);
      });
    crew.barrier();
    work.check();
    const Range range = range_of(crew);
    const Frame<Real> start = {keep ? record.frames : record.start, stride_};
    for (int c = 0; c < component_count; ++c) {
      const Real* from = work.last.get() + c * stride_;
      Real* to = start.at(c);
      for (int64_t p = range.first; p < padded(range); ++p) to[p] = from[work.permutation[p]];
    }
    sort_material(work, record.order, range);
    crew.barrier([&] { work.order = record.order; });
    run_substeps(crew, work, arena, record, start, poses, step, keep);
  }

  // One step backward. `work.gradient` (in the scene's order) is the gradient with respect to the particles after the step and
  // becomes that before it, plus `grad_positions` (N, 3).
  void backward(const Crew& crew, Work& work, Record& kept, const double* poses, int64_t step, const Real* grad_positions) const {
    const Range range = range_of(crew);
    sort_material(work, kept.order, range);
    Record record = kept;
    if (!kept.frames) {
      recompute(crew, work, kept, poses, step);
      record = work.scratch;
    }
    const Frame<Real> gradient = {work.sorted_gradient.get(), stride_};
    for (int c = 0; c < component_count; ++c) {
      const Real* from = work.gradient.get() + c * stride_;
      Real* to = gradient.at(c);
      for (int64_t p = range.first; p < range.last; ++p) to[p] = from[record.order[p]];
      for (int64_t p = range.last; p < padded(range); ++p) to[p] = 0;
    }
    crew.barrier([&] { prepare(work, record, poses, step, scene_.substeps - 1); });
    work.check();
    update_velocity(crew, work, record, scene_.substeps - 1);
    crew.barrier();
    for (int s = scene_.substeps - 1; s >= 0; --s) backward_substep(crew, work, record, poses, step, s, gradient, range);
    for (int c = 0; c < component_count; ++c) {
      const Real* from = gradient.at(c);
      Real* to = work.gradient.get() + c * stride_;
      if (c < 3)
        for (int64_t p = range.first; p < range.last; ++p)
          to[record.order[p]] = from[p] + grad_positions[3 * int64_t(record.order[p]) + c];
      else
        for (int64_t p = range.first; p < range.last; ++p) to[record.order[p]] = from[p];
    }
    crew.barrier();
  }

 private:
  // Sort the particles `work.last` by cell, and by number within a cell, whatever order they come in: the order of the sums, and with
  // it their last digits, depends on the state alone. Counting sort; one thread.
  void sort(Work& work, Record& record) const {
    cpdeform::Stopwatch watch(cpdeform::Phase::sorting);
    const Frame<Real> last = {work.last.get(), stride_};
    const Box box = T::bounds(last, {0, count_}, constants_);
    const int64_t cells = box.nodes();
    int32_t* cell = work.cell.reserve(stride_);
    int32_t* counts = work.counts.reserve(cells + 1);
    int32_t* permutation = work.permutation.reserve(stride_);
    int32_t* place = work.place.reserve(stride_);
    std::memset(counts, 0, size_t(cells + 1) * sizeof(int32_t));
    for (int64_t p = 0; p < stride_; p += lanes) {
      typename Simd<Real>::Index n = {};
      for (int a = 0; a < 3; ++a) n = n * box.size(a) + (T::base_along(last.get(at_position + a, p), constants_) - box.low[a]);
      std::memcpy(cell + p, &n, sizeof(n));
    }
    for (int64_t p = 0; p < count_; ++p) ++counts[cell[p] + 1];
    for (int64_t c = 0; c < cells; ++c) counts[c + 1] += counts[c];
    for (int64_t p = 0; p < count_; ++p) place[work.order[p]] = int32_t(p);
    for (int64_t n = 0; n < count_; ++n) permutation[counts[cell[place[n]]]++] = place[n];
    for (int64_t p = count_; p < stride_; ++p) permutation[p] = permutation[count_ - 1];
    for (int64_t p = 0; p < stride_; ++p) record.order[p] = work.order[permutation[p]];
  }

  void sort_material(Work& work, const int32_t* order, const Range& range) const {
    for (int c = 0; c < 3; ++c)
      for (int64_t p = range.first; p < padded(range); ++p) work.material[c * stride_ + p] = material_[c * count_ + order[p]];
  }

  void run_substeps(const Crew& crew, Work& work, Arena& arena, Record& record, const Frame<Real>& start, const double* poses,
                    int64_t step, bool keep) const {
    const Range range = range_of(crew);
    Frame<Real> current = start;
    for (int s = 0; s < scene_.substeps; ++s) {
      Frame<Real> next = {work.last.get(), stride_};
      if (s + 1 < scene_.substeps)
        next.data = keep ? record.frames + int64_t(s + 1) * component_count * stride_ : (s % 2 ? work.second : work.first).get();
      forward_substep(crew, work, keep ? &arena : nullptr, keep ? record.momentum[s] : work.momentum_grid, current, next, poses,
                      step * scene_.substeps + s, range);
      current = next;
    }
    if (keep)
      for (int c = 0; c < 3; ++c)
        std::memcpy(record.last_velocity + c * stride_ + range.first, current.at(at_velocity + c) + range.first,
                    size_t(padded(range) - range.first) * sizeof(Real));
    crew.barrier();
  }

  static size_t numbers_of(const Box& box) { return size_t(4 * box.nodes() + spare_numbers); }

  static void clear(const Grid<Real>& grid) { std::memset(grid.nodes, 0, numbers_of(grid.box) * sizeof(Real)); }

  // Memory of momentum and mass: the arena's where substeps are kept.
  void allocate_momentum(Work& work, Arena* arena, Grid<Real>& momentum) const {
    const size_t numbers = numbers_of(momentum.box);
    momentum.nodes = arena ? arena->template take<Real>(int64_t(numbers)) : work.momentum.reserve(numbers);
  }

  void make_tools(Work& work, int slot, const double* poses, int64_t frame) const {
    const int64_t width = int64_t(scene_.tool_count) * cpdeform::pose_size;
    ToolMotion<Real>* tools = work.tools[slot].reserve(cpdeform::max_tools);
    for (int m = 0; m < scene_.tool_count; ++m) {
      const double* before = poses + frame * width + m * cpdeform::pose_size;
      tools[m] = ToolMotion<Real>::make(scene_.tools[m], before, before + width, scene_);
    }
  }

  // Memory for a grid that row reads may leave by `spare_numbers`.
  static Real* reserve_nodes(Buffer<Real>& buffer, const Box& box) {
    const size_t numbers = numbers_of(box);
    Real* nodes = buffer.reserve(numbers);
    for (int64_t i = 0; i < spare_numbers; ++i) nodes[numbers - spare_numbers + i] = 0;
    return nodes;
  }

  struct Layers {
    int first, last;
  };
  static Layers layers_of(const Crew& crew, const Box& box) {
    const int64_t size = box.size(0);
    return {box.low[0] + int(size * crew.thread / crew.size), box.low[0] + int(size * (crew.thread + 1) / crew.size)};
  }

  // This thread's grid for scattering: its own part, or the common grid where it is alone.
  void open_part(const Crew& crew, Work& work, const Frame<Real>& frame, const Range& range) const {
    Grid<Real>& part = work.parts[crew.thread];
    part = Grid<Real>{};
    if (range.first >= range.last) {
      for (int a = 0; a < 3; ++a) part.box.low[a] = constants_.grid_size;
      return;
    }
    part.box = T::bounds(frame, range, constants_);
    part.nodes = work.part_memory[crew.thread].reserve(numbers_of(part.box));
    clear(part);
  }

  static Box common_box(const Crew& crew, const Work& work) {
    Box box = work.parts[0].box;
    for (int t = 1; t < crew.size; ++t) box.include(work.parts[t].box);
    return box;
  }

  void forward_substep(const Crew& crew, Work& work, Arena* arena, Grid<Real>& momentum, const Frame<Real>& current,
                       const Frame<Real>& next, const double* poses, int64_t frame, const Range& range) const {
    const bool alone = crew.size == 1;
    crew.take_notice(work);
    work.attempt([&] {
      if (alone) {
        momentum.box = T::bounds(current, range, constants_);
        allocate_momentum(work, arena, momentum);
        clear(momentum);
      } else {
        open_part(crew, work, current, range);
      }
    });
    if (!work.failed() && range.first < range.last)
      T::particles_to_grid(current, next, work.material.get(), range, constants_, alone ? momentum : work.parts[crew.thread]);
    crew.barrier([&] {
      work.attempt([&] {
        if (!alone) {
          momentum.box = common_box(crew, work);
          allocate_momentum(work, arena, momentum);
        }
        reserve_nodes(work.velocity[0], momentum.box);
        make_tools(work, 0, poses, frame);
      });
    });
    work.check();
    const Layers layers = layers_of(crew, momentum.box);
    if (!alone) GridPass<Real>::sum(momentum, work.parts.get(), crew.size, layers.first, layers.last);
    pass_.update(momentum, work.velocity[0].get(), work.tools[0].get(), scene_.tool_count, layers.first, layers.last);
    crew.barrier();
    T::grid_to_particles(current, next, range, constants_, {momentum.box, work.velocity[0].get()});
  }

  // Compute a step's substeps anew into `work.scratch`.
  void recompute(const Crew& crew, Work& work, const Record& kept, const double* poses, int64_t step) const {
    if (crew.thread == 0)
      work.attempt([&] {
        work.scratch_arena.clear();
        work.scratch = Record{};
        work.scratch.order = kept.order;
        make_record(work.scratch_arena, work.scratch, true);
      });
    crew.barrier();
    work.check();
    const Range range = range_of(crew);
    const Frame<Real> start = {work.scratch.frames, stride_};
    for (int c = 0; c < component_count; ++c)
      std::memcpy(start.at(c) + range.first, kept.start + c * stride_ + range.first,
                  size_t(padded(range) - range.first) * sizeof(Real));
    run_substeps(crew, work, work.scratch_arena, work.scratch, start, poses, step, true);
  }

  // What `update_velocity` of a substep needs. One thread.
  void prepare(Work& work, const Record& record, const double* poses, int64_t step, int s) const {
    work.attempt([&] {
      reserve_nodes(work.velocity[s % 2], record.momentum[s].box);
      make_tools(work, s % 2, poses, step * scene_.substeps + s);
    });
  }

  void update_velocity(const Crew& crew, Work& work, const Record& record, int s) const {
    const Layers layers = layers_of(crew, record.momentum[s].box);
    pass_.update(record.momentum[s], work.velocity[s % 2].get(), work.tools[s % 2].get(), scene_.tool_count, layers.first,
                 layers.last);
  }

  void backward_substep(const Crew& crew, Work& work, const Record& record, const double* poses, int64_t step, int s,
                        const Frame<Real>& gradient, const Range& range) const {
    const bool alone = crew.size == 1, last = s + 1 == scene_.substeps;
    const Frame<Real> frame = {record.frames + int64_t(s) * component_count * stride_, stride_};
    const Real* velocity_after = last ? record.last_velocity : frame.data + (component_count + at_velocity) * stride_;
    const Grid<Real>& momentum = record.momentum[s];
    Grid<Real> grad_grid = {momentum.box, nullptr};
    crew.take_notice(work);
    work.attempt([&] {
      if (alone) {
        grad_grid.nodes = reserve_nodes(work.grad_sum, momentum.box);
        clear(grad_grid);
      } else {
        open_part(crew, work, frame, range);
      }
    });
    if (!work.failed() && range.first < range.last)
      T::grid_to_particles_adjoint(frame, velocity_after, gradient, range, constants_, {momentum.box, work.velocity[s % 2].get()},
                                   alone ? grad_grid : work.parts[crew.thread]);
    crew.barrier([&] {
      work.attempt([&] {
        if (!alone) reserve_nodes(work.grad_sum, momentum.box);
      });
      if (s > 0) prepare(work, record, poses, step, s - 1);
    });
    work.check();
    grad_grid.nodes = work.grad_sum.get();
    const Layers layers = layers_of(crew, momentum.box);
    if (!alone) GridPass<Real>::sum(grad_grid, work.parts.get(), crew.size, layers.first, layers.last);
    ToolGradient* tools = work.tool_gradients.get() + crew.thread * cpdeform::max_tools;
    std::memset(static_cast<void*>(tools), 0, sizeof(ToolGradient) * scene_.tool_count);
    pass_.adjoint(momentum, grad_grid, work.tools[s % 2].get(), scene_.tool_count, layers.first, layers.last, tools);
    add_pose_gradients(crew, work, tools, poses, step * scene_.substeps + s);
    if (s > 0) update_velocity(crew, work, record, s - 1);
    crew.barrier();
    T::particles_to_grid_adjoint(frame, work.material.get(), gradient, range, constants_, grad_grid);
  }

  void add_pose_gradients(const Crew& crew, Work& work, const ToolGradient* tools, const double* poses, int64_t frame) const {
    const int64_t width = int64_t(scene_.tool_count) * cpdeform::pose_size;
    for (int m = 0; m < scene_.tool_count; ++m) {
      const double* pose = poses + frame * width + m * cpdeform::pose_size;
      double* before = work.grad_poses.get() + crew.thread * work.pose_numbers + frame * width + m * cpdeform::pose_size;
      double* after = before + width;
      for (int i = 0; i < 3; ++i) {
        before[i] += tools[m].position_before[i];
        after[i] += tools[m].position_after[i];
      }
      rotation_adjoint(pose + 3, tools[m].rotation_before, before + 3);
      rotation_adjoint(pose + width + 3, tools[m].rotation_after, after + 3);
      before[7] += tools[m].gap;
    }
  }

  const cpdeform::Scene scene_;
  const GridPass<Real> pass_;
  int64_t count_, stride_;
  Constants<Real> constants_;
  Buffer<Real> material_;
};

}  // namespace CPDEFORM_ISA
