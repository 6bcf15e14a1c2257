// What a world keeps of a rollout, and the memory its steps work in.
#pragma once

#include <atomic>

#include "buffer.h"
#include "contact.h"
#include "frame.h"
#include "memory.h"
#include "threads.h"

namespace CPDEFORM_ISA {

// The threads that work on one world: the whole team, or one thread alone.
struct Crew {
  cpdeform::Team* team;   // null: one thread
  int thread, size;
  cpdeform::Team* whole;  // the team that the crew belongs to
  int thread_of_whole;    // this thread's number in it

  // Take notice, once a substep, of the wish to end the call. All of the crew learn of it from `work.check()` after the next barrier.
  template <class Work>
  CPDEFORM_INLINE void take_notice(Work& work) const {
    if (thread == 0 && whole->interrupted(thread_of_whole)) work.interrupt();
  }

  template <class F>
  CPDEFORM_INLINE void barrier(F&& completion) const {
    if (team)
      team->barrier(completion);
    else
      completion();
  }
  CPDEFORM_INLINE void barrier() const {
    barrier([] {});
  }
};

// A step's records, its particles in the order they were sorted in.
template <class Real>
struct StepRecord {
  int32_t* order = nullptr;        // number of each particle in the scene's order
  Real* start = nullptr;           // all components at the start, where substeps are not kept
  Real* frames = nullptr;          // all components before each substep, where they are
  Real* last_velocity = nullptr;   // after the last substep, where they are
  Grid<Real>* momentum = nullptr;  // momentum and mass of each substep, where they are
};

template <class Real>
struct WorldHistory {
  Arena arena;
  StepRecord<Real>* steps = nullptr;
  double* poses = nullptr;  // (T * substeps + 1, M, 8)
};

template <class Real>
class Workspace {
 public:
  Buffer<Real> last, first, second;           // frames: the particles between steps, and two that substeps take in turn
  Buffer<Real> gradient, sorted_gradient;     // frames, in the scene's order and in the step's
  Buffer<Real> material;                      // in the step's order
  Buffer<int32_t> permutation, cell, counts, place;  // of the sort
  Buffer<int32_t> identity;
  const int32_t* order = nullptr;  // scene numbers of the particles in `last`
  Buffer<Real> velocity[2], momentum, grad_sum;
  Grid<Real> momentum_grid;
  Buffer<ToolMotion<Real>> tools[2];
  // one for each thread
  Buffer<Real>* part_memory = nullptr;
  Buffer<Grid<Real>> parts;
  Buffer<ToolGradient> tool_gradients;
  Buffer<double> grad_poses;
  int64_t pose_numbers = 0;  // of all frames of the rollout
  // the substeps of a step that are computed anew on the way back
  StepRecord<Real> scratch;
  Arena scratch_arena;

  Workspace(int crew, Pool* pool) {
    part_memory = new Buffer<Real>[crew];
    parts.reserve(crew);
    scratch_arena.attach(pool);
  }
  Workspace(const Workspace&) = delete;
  Workspace& operator=(const Workspace&) = delete;
  ~Workspace() { delete[] part_memory; }

  // Run something that may find no memory. A thread that failed must still come to the barrier, where all learn of it.
  template <class F>
  CPDEFORM_INLINE void attempt(F&& work) {
    try {
      work();
    } catch (...) {
      failed_.store(true, std::memory_order_relaxed);
    }
  }
  void interrupt() {
    interrupted_.store(true, std::memory_order_relaxed);
    failed_.store(true, std::memory_order_relaxed);
  }
  void reset() {
    failed_.store(false, std::memory_order_relaxed);
    interrupted_.store(false, std::memory_order_relaxed);
  }
  bool failed() const { return failed_.load(std::memory_order_relaxed); }
  void check() const {
    if (!failed()) return;
    if (interrupted_.load(std::memory_order_relaxed)) cpdeform::throw_interrupted();
    throw std::bad_alloc();
  }

 private:
  std::atomic<bool> failed_{false}, interrupted_{false};
};

}  // namespace CPDEFORM_ISA
