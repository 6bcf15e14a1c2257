// Particles as structure of arrays, and boxes of grid nodes.
#pragma once

#include <cstddef>
#include <cstdint>

#include "simd.h"

namespace CPDEFORM_ISA {

// First component of each quantity. The affine field is row-major, the strain xx, yy, zz, xy, xz, yz.
constexpr int at_position = 0, at_velocity = 3, at_affine = 6, at_strain = 15, component_count = 21;

// Component c of particle p is at data[c * stride + p]; the stride is a multiple of a vector's lanes.
template <class Real>
struct Frame {
  Real* data = nullptr;
  int64_t stride = 0;

  CPDEFORM_INLINE Real* at(int component) const { return data + component * stride; }
  CPDEFORM_INLINE Vec<Real> get(int component, int64_t particle) const { return load(data + component * stride + particle); }
  CPDEFORM_INLINE void set(int component, int64_t particle, Vec<Real> v) const {
    store(data + component * stride + particle, v);
  }
};

// Nodes low .. high (inclusive) along each axis; z runs fastest.
struct Box {
  int low[3] = {0, 0, 0};
  int high[3] = {-1, -1, -1};

  CPDEFORM_INLINE int size(int axis) const { return high[axis] - low[axis] + 1; }
  CPDEFORM_INLINE int64_t nodes() const { return int64_t(size(0)) * size(1) * size(2); }
  CPDEFORM_INLINE int64_t layer() const { return int64_t(size(1)) * size(2); }
  CPDEFORM_INLINE void include(const Box& other) {
    for (int a = 0; a < 3; ++a) {
      if (other.low[a] < low[a]) low[a] = other.low[a];
      if (other.high[a] > high[a]) high[a] = other.high[a];
    }
  }
};

// Four numbers a node, and as many behind the last node as a vector may read or add zero to.
constexpr int64_t spare_numbers = 16;

template <class Real>
struct Grid {
  Box box;
  Real* nodes = nullptr;
};

// A contiguous range of particles; starts at a multiple of a vector's lanes.
struct Range {
  int64_t first = 0, last = 0;
};

// What every particle kernel needs of the scene, in the kernels' type.
template <class Real>
struct Constants {
  Real time_step, node_distance, inverse_distance, particle_mass, stress_scale;
  Real lower[3], upper[3];
  int grid_size;
};

}  // namespace CPDEFORM_ISA
