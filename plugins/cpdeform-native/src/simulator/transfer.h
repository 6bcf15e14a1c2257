// Transfers between particles and grid, and their adjoints: MLS-MPM with quadratic B-splines.
//
// The affine term is linear in the stencil offset, so a node costs one multiply-add. Particles come sorted by cell; where registers
// are wide enough the sums of a cell's nine rows stay in them until the cell changes.
//
// Hu et al., "A Moving Least Squares Material Point Method with Displacement Discontinuity and Two-Way Rigid Body Coupling",
// SIGGRAPH 2018.
#pragma once

#include "frame.h"
#include "material.h"
#include "profile.h"
#include "stencil.h"

namespace CPDEFORM_ISA {

template <class Real>
struct Transfer {
  using V = Vec<Real>;
  using S = Stencil<Real>;
  using Row = typename S::Row;
  using Law = Material<Real>;
  using Index = typename Simd<Real>::Index;
  using Phase = cpdeform::Phase;
  static constexpr int lanes = S::lanes;
  static constexpr int record_size = S::record_size;

  // Where the stencils of one vector of particles are, and their weights.
  struct Block {
    alignas(64) Real records[lanes * record_size];
    alignas(64) Real second[lanes * record_size];
    alignas(64) Real w[9][lanes];    // wx, wy, wz
    alignas(64) Real d[9][lanes];    // slopes
    alignas(64) Real wxy[9][lanes];  // wx wy
    alignas(64) int32_t node[lanes];
    V f[3];
  };

  CPDEFORM_INLINE static Index base_along(V x, const Constants<Real>& k) {
    // truncation, not floor: a particle in the lowest half cell keeps a stencil that starts at node 0. And a position that is not
    // finite keeps inside the grid, where it spreads nan instead of writing to foreign memory.
    const Index base = __builtin_convertvector(x * k.inverse_distance - Real(0.5), Index);
    const Index zero = {};
    const Index last = zero + (k.grid_size - 3);
    const Index raised = base < zero ? zero : base;
    return raised > last ? last : raised;
  }

  // Box of all stencils of a range.
  static Box bounds(const Frame<Real>& frame, Range range, const Constants<Real>& k) {
    Box box;
    for (int a = 0; a < 3; ++a) {
      Index low = Index{} + k.grid_size, high = Index{};
      for (int64_t p = range.first; p < range.last; p += lanes) {
        const Index base = base_along(frame.get(at_position + a, p), k);
        low = base < low ? base : low;
        high = base > high ? base : high;
      }
      box.low[a] = low[0];
      box.high[a] = high[0];
      for (int l = 1; l < lanes; ++l) {
        if (low[l] < box.low[a]) box.low[a] = low[l];
        if (high[l] > box.high[a]) box.high[a] = high[l];
      }
      box.high[a] += 2;
    }
    return box;
  }

  template <bool with_slopes, bool with_products>
  CPDEFORM_INLINE static void locate(const Frame<Real>& frame, int64_t p, const Constants<Real>& k, const Box& box, Block& block) {
    Index base[3];
    V w[9];
    for (int a = 0; a < 3; ++a) {
      const V x = frame.get(at_position + a, p);
      base[a] = base_along(x, k);
      block.f[a] = x * k.inverse_distance - __builtin_convertvector(base[a], V);
      S::weights(block.f[a], w + 3 * a);
      for (int i = 0; i < 3; ++i) store(block.w[3 * a + i], w[3 * a + i]);
      if constexpr (with_slopes) {
        V d[3];
        S::slopes(block.f[a], d);
        for (int i = 0; i < 3; ++i) store(block.d[3 * a + i], d[i]);
      }
    }
    if constexpr (with_products)
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) store(block.wxy[3 * i + j], (V)(w[i] * w[3 + j]));
    const Index node = ((base[0] - box.low[0]) * box.size(1) + (base[1] - box.low[1])) * box.size(2) + (base[2] - box.low[2]);
    std::memcpy(block.node, &node, sizeof(node));
  }

  // A linear function of the stencil offset, start + i x + j y + k z, as rows along z.
  struct Linear {
    Row start, x, y;
    CPDEFORM_INLINE explicit Linear(const Real* record) {
      const Row z = S::repeat(record + 12);
      start = S::repeat(record) + z * S::along(0, 1, 2);
      x = S::repeat(record + 4);
      y = S::repeat(record + 8);
    }
    CPDEFORM_INLINE Linear weighted(const Row& w) const {
      Linear r = *this;
      r.start = start * w;
      r.x = x * w;
      r.y = y * w;
      return r;
    }
  };

  // Sums of one cell's nine rows.
  struct Sums {
    Row row[9];
    int64_t node = -1;
    Real* nodes;
    int64_t layer, line;  // in nodes

    CPDEFORM_INLINE Sums(const Grid<Real>& grid) : nodes(grid.nodes), layer(grid.box.layer()), line(grid.box.size(2)) {}

    CPDEFORM_INLINE void flush() {
      if constexpr (lanes == 16) {
        if (node < 0) return;
        for (int i = 0; i < 3; ++i)
          for (int j = 0; j < 3; ++j) {
            Real* target = nodes + 4 * (node + i * layer + j * line);
            S::write(target, S::read(target) + row[3 * i + j]);
          }
      }
    }

    CPDEFORM_INLINE void add(const Block& block, int lane, const Linear& value) {
      Row current = value.start;
      const int64_t n = block.node[lane];
      if constexpr (lanes == 16) {
        if (n != node) {
          flush();
          node = n;
          for (int r = 0; r < 9; ++r) row[r] = Row{};
        }
      }
      for (int i = 0; i < 3; ++i) {
        Row v = current;
        for (int j = 0; j < 3; ++j) {
          if constexpr (lanes == 16) {
            row[3 * i + j].add(block.wxy[3 * i + j][lane], v);
          } else {
            Real* target = nodes + 4 * (n + i * layer + j * line);
            Row old = S::read(target);
            old.add(block.wxy[3 * i + j][lane], v);
            S::write(target, old);
          }
          if (j < 2) v += value.y;
        }
        if (i < 2) current += value.x;
      }
    }
  };

  CPDEFORM_INLINE static typename Law::Symmetric strain_of(const Frame<Real>& frame, int64_t p) {
    return {frame.get(at_strain, p),     frame.get(at_strain + 1, p), frame.get(at_strain + 2, p),
            frame.get(at_strain + 3, p), frame.get(at_strain + 4, p), frame.get(at_strain + 5, p)};
  }
  CPDEFORM_INLINE static typename Law::Matrix affine_of(const Frame<Real>& frame, int64_t p) {
    typename Law::Matrix c;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) c.m[i][j] = frame.get(at_affine + 3 * i + j, p);
    return c;
  }
  CPDEFORM_INLINE static void set_strain(const Frame<Real>& frame, int64_t p, const typename Law::Symmetric& e) {
    frame.set(at_strain, p, e.xx);
    frame.set(at_strain + 1, p, e.yy);
    frame.set(at_strain + 2, p, e.zz);
    frame.set(at_strain + 3, p, e.xy);
    frame.set(at_strain + 4, p, e.xz);
    frame.set(at_strain + 5, p, e.yz);
  }
  CPDEFORM_INLINE static typename Law::Matrix scaled(const typename Law::Matrix& c, Real s) {
    typename Law::Matrix r;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) r.m[i][j] = c.m[i][j] * s;
    return r;
  }
  CPDEFORM_INLINE static typename Law::Law law_of(const Real* material, int64_t stride, int64_t p) {
    return {load(material + p), load(material + stride + p), load(material + 2 * stride + p)};
  }

  // a = dx (stress_scale stress + mass C), and the record start = mass v - a f, mass; a's columns.
  CPDEFORM_INLINE static void momentum_record(const Frame<Real>& frame, int64_t p, const Constants<Real>& k,
                                              const typename Law::Matrix& c, const typename Law::Symmetric& stress, Block& block,
                                              typename Law::Matrix& a) {
    const typename Law::Matrix tau = Law::full(stress);
    const Real s = k.node_distance * k.stress_scale, m = k.node_distance * k.particle_mass;
    V record[record_size];
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) a.m[i][j] = s * tau.m[i][j] + m * c.m[i][j];
      record[i] = k.particle_mass * frame.get(at_velocity + i, p) -
                  (a.m[i][0] * block.f[0] + a.m[i][1] * block.f[1] + a.m[i][2] * block.f[2]);
      for (int j = 0; j < 3; ++j) record[4 + 4 * j + i] = a.m[i][j];
    }
    record[3] = splat(k.particle_mass);
    record[7] = record[11] = record[15] = V{};
    S::to_records(record, block.records);
  }

  // Material update and momentum of a range of particles, added to `grid`; new strains go to `after`.
  static void particles_to_grid(const Frame<Real>& frame, const Frame<Real>& after, const Real* material, Range range,
                                const Constants<Real>& k, const Grid<Real>& grid) {
    cpdeform::Stopwatch watch(Phase::other);
    Block block;
    Sums sums(grid);
    for (int64_t p = range.first; p < range.last; p += lanes) {
      watch.change(Phase::material);
      const typename Law::Matrix c = affine_of(frame, p);
      const typename Law::Symmetric trial = Law::trial_strain(strain_of(frame, p), scaled(c, k.time_step));
      typename Law::Symmetric strain, stress;
      Law::respond(trial, law_of(material, frame.stride, p), strain, stress);
      set_strain(after, p, strain);
      watch.change(Phase::records);
      locate<false, true>(frame, p, k, grid.box, block);
      typename Law::Matrix a;
      momentum_record(frame, p, k, c, stress, block, a);
      watch.change(Phase::scatter);
      const int live = range.last - p < lanes ? int(range.last - p) : lanes;
      for (int l = 0; l < live; ++l)
        sums.add(block, l, Linear(block.records + l * record_size).weighted(S::along(block.w[6][l], block.w[7][l], block.w[8][l])));
    }
    sums.flush();
  }

  // Velocity, affine field and position after the substep.
  static void grid_to_particles(const Frame<Real>& frame, const Frame<Real>& after, Range range, const Constants<Real>& k,
                                const Grid<Real>& grid) {
    cpdeform::Stopwatch watch(Phase::other);
    Block block;
    for (int i = 0; i < lanes * record_size; ++i) block.records[i] = 0;
    const int64_t layer = grid.box.layer(), line = grid.box.size(2);
    const Row offsets = S::along(0, 1, 2);
    for (int64_t p = range.first; p < range.last; p += lanes) {
      watch.change(Phase::records);
      locate<false, false>(frame, p, k, grid.box, block);
      watch.change(Phase::gather);
      const int live = range.last - p < lanes ? int(range.last - p) : lanes;
      for (int l = 0; l < live; ++l) {
        const Real* nodes = grid.nodes + 4 * int64_t(block.node[l]);
        Row total = {}, x = {}, y = {};
        for (int i = 0; i < 3; ++i) {
          const Real* rows = nodes + 4 * i * layer;
          const Row second = S::read(rows + 4 * line) * block.w[4][l];
          const Row third = S::read(rows + 8 * line) * block.w[5][l];
          Row sum = second + third;
          sum.add(block.w[3][l], S::read(rows));
          Row sloped = second + third + third;
          const Real wx = block.w[i][l];
          total.add(wx, sum);
          y.add(wx, sloped);
          if (i > 0) x.add(Real(i) * wx, sum);
        }
        const Row wz = S::along(block.w[6][l], block.w[7][l], block.w[8][l]);
        total = total * wz;
        S::reduce(total, x * wz, y * wz, total * offsets, block.records + l * record_size);
      }
      watch.change(Phase::records);
      V sum[record_size];
      S::from_records(block.records, sum);
      const Real scale = 4 * k.inverse_distance;
      for (int i = 0; i < 3; ++i) {
        const V v = sum[i];
        for (int j = 0; j < 3; ++j) after.set(at_affine + 3 * i + j, p, scale * (sum[4 + 4 * j + i] - block.f[j] * v));
        after.set(at_velocity + i, p, v);
        const V moved = frame.get(at_position + i, p) + k.time_step * v;
        // unlike min and max, these let nan through
        const V raised = moved < k.lower[i] ? splat(k.lower[i]) : moved;
        after.set(at_position + i, p, raised > k.upper[i] ? splat(k.upper[i]) : raised);
      }
    }
  }

  // Adjoint of `grid_to_particles`: adds to the gradient of the grid's velocities, and makes the positions' gradient that of the
  // positions before, as far as this stage goes. `velocity_after` are the three velocity components after the substep.
  static void grid_to_particles_adjoint(const Frame<Real>& frame, const Real* velocity_after, const Frame<Real>& gradient,
                                        Range range, const Constants<Real>& k, const Grid<Real>& velocity,
                                        const Grid<Real>& grad_grid) {
    cpdeform::Stopwatch watch(Phase::other);
    Block block;
    for (int i = 0; i < lanes * record_size; ++i) block.second[i] = 0;
    Sums sums(grad_grid);
    const int64_t layer = velocity.box.layer(), line = velocity.box.size(2);
    for (int64_t p = range.first; p < range.last; p += lanes) {
      watch.change(Phase::records);
      Index base[3];
      locate<true, true>(frame, p, k, grad_grid.box, block);
      for (int a = 0; a < 3; ++a) base[a] = base_along(frame.get(at_position + a, p), k);
      const Box& b = velocity.box;
      const Index node = ((base[0] - b.low[0]) * b.size(1) + (base[1] - b.low[1])) * b.size(2) + (base[2] - b.low[2]);
      V gx[3], v[3], record[record_size];
      for (int a = 0; a < 3; ++a) {
        v[a] = load(velocity_after + a * frame.stride + p);
        const V moved = frame.get(at_position + a, p) + k.time_step * v[a];
        const V g = gradient.get(at_position + a, p);
        gx[a] = (moved < k.lower[a]) | (moved > k.upper[a]) ? V{} : g;
      }
      const Real scale = 4 * k.inverse_distance;
      typename Law::Matrix gc = scaled(affine_of(gradient, p), scale);
      for (int i = 0; i < 3; ++i) {
        record[i] = gradient.get(at_velocity + i, p) + k.time_step * gx[i] -
                    (gc.m[i][0] * block.f[0] + gc.m[i][1] * block.f[1] + gc.m[i][2] * block.f[2]);
        for (int j = 0; j < 3; ++j) record[4 + 4 * j + i] = gc.m[i][j];
      }
      record[3] = record[7] = record[11] = record[15] = V{};
      S::to_records(record, block.records);
      watch.change(Phase::scatter);
      const int live = range.last - p < lanes ? int(range.last - p) : lanes;
      for (int l = 0; l < live; ++l) {
        const Linear value(block.records + l * record_size);
        const Row wz = S::along(block.w[6][l], block.w[7][l], block.w[8][l]);
        const Real* nodes = velocity.nodes + 4 * int64_t(node[l]);
        Row sx = {}, sy = {}, sz = {};
        Row current = value.start;
        for (int i = 0; i < 3; ++i) {
          const Real* rows = nodes + 4 * i * layer;
          Row here = current;
          Row weighted = {}, sloped = {};
          for (int j = 0; j < 3; ++j) {
            const Row product = S::read(rows + 4 * j * line) * here;
            weighted.add(block.w[3 + j][l], product);
            sloped.add(block.d[3 + j][l], product);
            if (j < 2) here += value.y;
          }
          sx.add(block.d[i][l], weighted);
          sz.add(block.w[i][l], weighted);
          sy.add(block.w[i][l], sloped);
          if (i < 2) current += value.x;
        }
        S::reduce(sx * wz, sy * wz, sz * S::along(block.d[6][l], block.d[7][l], block.d[8][l]), Row{},
                  block.second + l * record_size);
        sums.add(block, l, value.weighted(wz));
      }
      watch.change(Phase::records);
      V sum[record_size];
      S::from_records(block.second, sum);
      for (int a = 0; a < 3; ++a) {
        const V slope = sum[4 * a] + sum[4 * a + 1] + sum[4 * a + 2] - (gc.m[0][a] * v[0] + gc.m[1][a] * v[1] + gc.m[2][a] * v[2]);
        gradient.set(at_position + a, p, gx[a] + k.inverse_distance * slope);
      }
    }
    sums.flush();
  }

  // Adjoint of `particles_to_grid`: turns gradients after the substep, in place, into those before it. Strain gradients are entries
  // of a symmetric matrix. `grid` holds the gradient of momentum and mass.
  static void particles_to_grid_adjoint(const Frame<Real>& frame, const Real* material, const Frame<Real>& gradient, Range range,
                                        const Constants<Real>& k, const Grid<Real>& grid) {
    cpdeform::Stopwatch watch(Phase::other);
    Block block;
    for (int i = 0; i < lanes * record_size; ++i) block.second[i] = 0;
    alignas(64) Real third[lanes * record_size] = {};
    const int64_t layer = grid.box.layer(), line = grid.box.size(2);
    const Row offsets = S::along(0, 1, 2);
    for (int64_t p = range.first; p < range.last; p += lanes) {
      watch.change(Phase::material);
      const typename Law::Matrix c = affine_of(frame, p), d = scaled(c, k.time_step);
      const typename Law::Symmetric old = strain_of(frame, p);
      const typename Law::Symmetric trial = Law::trial_strain(old, d);
      const typename Law::Law law = law_of(material, frame.stride, p);
      typename Law::Symmetric stress;
      typename Law::Eigen eigen;
      typename Law::Mapped mapped;
      const bool series = Law::series_stress(trial, law, stress);
      if (!series) {
        Law::eigen(trial, eigen);
        mapped = Law::return_map(eigen.value, law);
        V principal[3];
        Law::principal_stress(mapped.stretch, law, principal);
        stress = Law::compose(principal, eigen);
      }
      watch.change(Phase::records);
      locate<true, false>(frame, p, k, grid.box, block);
      typename Law::Matrix a;
      momentum_record(frame, p, k, c, stress, block, a);
      watch.change(Phase::gather);
      const int live = range.last - p < lanes ? int(range.last - p) : lanes;
      for (int l = 0; l < live; ++l) {
        const Linear value(block.records + l * record_size);
        const Row wz = S::along(block.w[6][l], block.w[7][l], block.w[8][l]);
        const Real* nodes = grid.nodes + 4 * int64_t(block.node[l]);
        Row total = {}, x = {}, y = {}, sx = {}, sy = {}, sz = {};
        Row current = value.start;
        for (int i = 0; i < 3; ++i) {
          const Real* rows = nodes + 4 * i * layer;
          Row here = current;
          Row sum = {}, lifted = {}, weighted = {}, sloped = {};
          for (int j = 0; j < 3; ++j) {
            const Row row = S::read(rows + 4 * j * line);
            const Row product = row * here;
            const Real wy = block.w[3 + j][l];
            sum.add(wy, row);
            if (j > 0) lifted.add(Real(j) * wy, row);
            weighted.add(wy, product);
            sloped.add(block.d[3 + j][l], product);
            if (j < 2) here += value.y;
          }
          const Real wx = block.w[i][l];
          total.add(wx, sum);
          if (i > 0) x.add(Real(i) * wx, sum);
          y.add(wx, lifted);
          sx.add(block.d[i][l], weighted);
          sz.add(wx, weighted);
          sy.add(wx, sloped);
          if (i < 2) current += value.x;
        }
        total = total * wz;
        S::reduce(total, x * wz, y * wz, total * offsets, block.second + l * record_size);
        S::reduce(sx * wz, sy * wz, sz * S::along(block.d[6][l], block.d[7][l], block.d[8][l]), Row{}, third + l * record_size);
      }
      watch.change(Phase::records);
      V sum[record_size], slope[record_size];
      S::from_records(block.second, sum);
      S::from_records(third, slope);
      typename Law::Matrix ga;
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) ga.m[i][j] = k.node_distance * (sum[4 + 4 * j + i] - block.f[j] * sum[i]);
      for (int j = 0; j < 3; ++j) {
        const V s = slope[4 * j] + slope[4 * j + 1] + slope[4 * j + 2] + slope[4 * j + 3] -
                    (a.m[0][j] * sum[0] + a.m[1][j] * sum[1] + a.m[2][j] * sum[2]);
        gradient.set(at_position + j, p, gradient.get(at_position + j, p) + k.inverse_distance * s);
        gradient.set(at_velocity + j, p, k.particle_mass * sum[j]);
      }
      watch.change(Phase::material);
      const Real half = Real(0.5) * k.stress_scale;
      const typename Law::Symmetric grad_stress = {
          k.stress_scale * ga.m[0][0],           k.stress_scale * ga.m[1][1],           k.stress_scale * ga.m[2][2],
          half * (ga.m[0][1] + ga.m[1][0]), half * (ga.m[0][2] + ga.m[2][0]), half * (ga.m[1][2] + ga.m[2][1])};
      const typename Law::Symmetric grad_new = strain_of(gradient, p);
      const typename Law::Symmetric grad_trial = series ? Law::series_adjoint(trial, law, grad_new, grad_stress)
                                                        : Law::eigen_adjoint(eigen, mapped, law, grad_new, grad_stress);
      typename Law::Symmetric grad_old;
      typename Law::Matrix grad_affine;
      Law::trial_adjoint(old, d, k.time_step, grad_trial, grad_old, grad_affine);
      set_strain(gradient, p, grad_old);
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
          gradient.set(at_affine + 3 * i + j, p, k.particle_mass * ga.m[i][j] + grad_affine.m[i][j]);
    }
  }
};

}  // namespace CPDEFORM_ISA
