// What the host calls of the kernels of one instruction set.
#pragma once

#include <cstdint>

#include "scene.h"
#include "threads.h"

namespace cpdeform {

// What a rollout keeps for its way back; made and read by the engine of one instruction set and type.
class History {
 public:
  virtual ~History() = default;
  virtual int64_t bytes() const = 0;
};

// Arrays in C order. B worlds, T environment steps, N particles, A action components, M tools.
template <class Real>
struct RolloutArguments {
  int64_t worlds, steps;
  const Real* position;  // (B, N, 3)
  const Real* velocity;  // (B, N, 3)
  const Real* affine;    // (B, N, 3, 3)
  const Real* strain;    // (B, N, 6)
  const Real* pose;      // (B, M, 8)
  const Real* actions;   // (B, T, A)
  Real* positions;       // (B, T + 1, N, 3), out
  Real* poses;           // (B, T + 1, M, 8), out
  Real* last_velocity;   // (B, N, 3), out
  Real* last_affine;     // (B, N, 3, 3), out
  Real* last_strain;     // (B, N, 6), out
  bool keep;             // whether the history holds every substep, or only the start of each step
};

template <class Real>
struct VjpArguments {
  int64_t worlds, steps;
  const Real* actions;         // (B, T, A)
  const Real* grad_positions;  // (B, T + 1, N, 3)
  const Real* grad_poses;      // (B, T + 1, M, 8), or null
  // with respect to the final state, all or none of them null
  const Real* grad_last_velocity;  // (B, N, 3)
  const Real* grad_last_affine;    // (B, N, 3, 3)
  const Real* grad_last_strain;    // (B, N, 6): derivatives by the entries of a matrix, of which an off-diagonal number stands for two
  double* grad_actions;        // (B, T, A), out, zero before
  Real* grad_position;         // (B, N, 3), out
  Real* grad_velocity;         // (B, N, 3), out
  Real* grad_affine;           // (B, N, 3, 3), out
  Real* grad_strain;           // (B, N, 6), out: derivatives by the six numbers
  double* grad_pose;           // (B, M, 8), out
};

// The team's threads call a method together, each once with its own number.
template <class Real>
class Engine {
 public:
  virtual ~Engine() = default;
  // Give back what is kept between calls. One thread, while no other method runs.
  virtual void release_memory() = 0;
  virtual History* make_history(int64_t worlds, int64_t steps) = 0;
  virtual void rollout(Team& team, int thread, const RolloutArguments<Real>& arguments, History& history) = 0;
  virtual void vjp(Team& team, int thread, const VjpArguments<Real>& arguments, History& history) = 0;
};

#define CPDEFORM_DECLARE_ENGINES(isa)                                                                   \
  namespace isa {                                                                                       \
  /* material: shear modulus, Lame lambda and yield stress, one array (N) after the other */            \
  Engine<float>* make_engine_float(const Scene& scene, const double* material, int threads);            \
  Engine<double>* make_engine_double(const Scene& scene, const double* material, int threads);          \
  }

CPDEFORM_DECLARE_ENGINES(engines_baseline)
CPDEFORM_DECLARE_ENGINES(engines_avx2)
CPDEFORM_DECLARE_ENGINES(engines_avx512)

}  // namespace cpdeform
