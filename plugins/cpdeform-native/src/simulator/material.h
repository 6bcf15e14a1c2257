// The material of one vector of particles: trial strain, return mapping, stress, and the adjoint of all three.
//
// State is the elastic strain e = b - I with b = F F^T. For a trial e* = U diag(l) U^T both the new strain and the stress share the
// eigenvectors U (the model is isotropic), so a symmetric eigendecomposition replaces the SVD of F. The adjoint is the
// Daleckii-Krein formula with divided differences in closed forms that do not cancel where eigenvalues meet. In float, a vector
// whose lanes all hold small strains inside the yield surface takes power series instead.
//
// de Souza Neto, Peric, Owen, "Computational Methods for Plasticity", 2008, chapter 14 and appendix A (isotropic functions).
#pragma once

#include "simd.h"

namespace CPDEFORM_ISA {

template <class Real>
struct Material {
  using V = Vec<Real>;
  using M = Mask<Real>;

  struct Symmetric {
    V xx, yy, zz, xy, xz, yz;
  };
  struct Matrix {
    V m[3][3];
  };
  struct Eigen {
    V value[3];
    V vector[3][3];  // [number][component]
  };
  struct Law {
    V mu, lambda, yield_stress;
  };

  static constexpr Real smallest_stretch_squared = Real(0.05 * 0.05 - 1.0);
  static constexpr Real norm_regularization = Real(1e-8);
  static constexpr Real series_limit = Real(9e-4);  // squared strain up to which the series are exact to float
  static constexpr bool has_series = sizeof(Real) == 4;

  CPDEFORM_INLINE static Matrix full(const Symmetric& s) {
    return {{{s.xx, s.xy, s.xz}, {s.xy, s.yy, s.yz}, {s.xz, s.yz, s.zz}}};
  }

  CPDEFORM_INLINE static Matrix multiply(const Matrix& a, const Matrix& b) {
    Matrix r;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) r.m[i][j] = a.m[i][0] * b.m[0][j] + a.m[i][1] * b.m[1][j] + a.m[i][2] * b.m[2][j];
    return r;
  }

  // Product of commuting symmetric matrices, which is symmetric.
  CPDEFORM_INLINE static Symmetric multiply_commuting(const Symmetric& a, const Symmetric& b) {
    return {a.xx * b.xx + a.xy * b.xy + a.xz * b.xz, a.xy * b.xy + a.yy * b.yy + a.yz * b.yz,
            a.xz * b.xz + a.yz * b.yz + a.zz * b.zz, a.xx * b.xy + a.xy * b.yy + a.xz * b.yz,
            a.xx * b.xz + a.xy * b.yz + a.xz * b.zz, a.xy * b.xz + a.yy * b.yz + a.yz * b.zz};
  }

  // e* = (I + D)(I + e)(I + D)^T - I with D = dt C, without the cancellation. `d` is D.
  CPDEFORM_INLINE static Symmetric trial_strain(const Symmetric& e, const Matrix& d) {
    const Matrix de = multiply(d, full(e));
    Matrix s;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) s.m[i][j] = d.m[i][j] + de.m[i][j];
    auto entry = [&](V old, int i, int j) {
      return old + s.m[i][j] + s.m[j][i] + s.m[i][0] * d.m[j][0] + s.m[i][1] * d.m[j][1] + s.m[i][2] * d.m[j][2];
    };
    return {entry(e.xx, 0, 0), entry(e.yy, 1, 1), entry(e.zz, 2, 2), entry(e.xy, 0, 1), entry(e.xz, 0, 2), entry(e.yz, 1, 2)};
  }

  // One Jacobi rotation that makes apq small; p and q are the eigenvector columns, r the third axis. The angle is approximate, which
  // costs no digits: cosine and sine belong to one angle exactly, and the next sweep starts from what is left of apq.
  CPDEFORM_INLINE static void rotate(V& app, V& aqq, V& apq, V& arp, V& arq, V (&up)[3], V (&uq)[3]) {
    const V tiny = splat(Real(1e-30));
    const V d = aqq - app;
    const V twice = apq + apq;
    const V squared = d * d + twice * twice;
    const V root = squared * approximate_reciprocal_root(squared + tiny);
    const V t = twice * approximate_reciprocal(d < V{} ? d - root - tiny : d + root + tiny);
    const V c = reciprocal_root(Real(1) + t * t);
    const V s = t * c;
    const V ss = s * s, cross = c * s * twice;
    // app' = c^2 app - 2 c s apq + s^2 aqq, and so on, as changes
    const V change = ss * d - cross;
    apq = apq - (ss * twice + c * s * d);
    app += change;
    aqq -= change;
    const V p = c * arp - s * arq;
    arq = s * arp + c * arq;
    arp = p;
    for (int i = 0; i < 3; ++i) {
      const V w = c * up[i] - s * uq[i];
      uq[i] = s * up[i] + c * uq[i];
      up[i] = w;
    }
  }

  // Cyclic Jacobi.
  static __attribute__((noinline)) void eigen(const Symmetric& e, Eigen& r) {
    V xx = e.xx, yy = e.yy, zz = e.zz, xy = e.xy, xz = e.xz, yz = e.yz;
    V u[3][3] = {};
    for (int i = 0; i < 3; ++i) u[i][i] = splat(Real(1));
    const Real tolerance = sizeof(Real) == 4 ? Real(1e-14) : Real(1e-30);
    for (int sweep = 0; sweep < 8; ++sweep) {
      const V off = xy * xy + xz * xz + yz * yz;
      if (!any<Real>(off > tolerance * (xx * xx + yy * yy + zz * zz + off))) break;
      rotate(xx, yy, xy, xz, yz, u[0], u[1]);
      rotate(xx, zz, xz, xy, yz, u[0], u[2]);
      rotate(yy, zz, yz, xy, xz, u[1], u[2]);
    }
    r.value[0] = xx;
    r.value[1] = yy;
    r.value[2] = zz;
    for (int n = 0; n < 3; ++n)
      for (int i = 0; i < 3; ++i) r.vector[n][i] = u[n][i];
  }

  // sum_n d[n] u_n u_n^T
  CPDEFORM_INLINE static Symmetric compose(const V (&d)[3], const Eigen& e) {
    auto entry = [&](int i, int j) {
      return d[0] * e.vector[0][i] * e.vector[0][j] + d[1] * e.vector[1][i] * e.vector[1][j] +
             d[2] * e.vector[2][i] * e.vector[2][j];
    };
    return {entry(0, 0), entry(1, 1), entry(2, 2), entry(0, 1), entry(0, 2), entry(1, 2)};
  }

  struct Mapped {
    V stretch[3];    // new stretches minus one
    V hencky[3];     // new Hencky strains
    V trial[3];      // trial Hencky strains
    V deviator[3];   // of the trial Hencky strains
    V norm;          // of the deviator
    V factor;        // what the deviator was scaled by, where plastic
    M plastic;
  };

  CPDEFORM_INLINE static Mapped return_map(const V (&value)[3], const Law& law) {
    Mapped r;
    for (int i = 0; i < 3; ++i)
      r.trial[i] = Real(0.5) * logarithm_of_one_plus(maximum(value[i], splat(smallest_stretch_squared)));
    const V mean = (r.trial[0] + r.trial[1] + r.trial[2]) * Real(1.0 / 3.0);
    V squared = splat(norm_regularization);
    for (int i = 0; i < 3; ++i) {
      r.deviator[i] = r.trial[i] - mean;
      squared += r.deviator[i] * r.deviator[i];
    }
    r.norm = square_root(squared);
    const V limit = law.yield_stress / (law.mu + law.mu);
    r.plastic = r.norm > limit;
    r.factor = limit / r.norm;
    for (int i = 0; i < 3; ++i) {
      const V mapped = mean + r.factor * r.deviator[i];
      r.hencky[i] = r.plastic ? mapped : r.trial[i];
      const V inside = maximum(Real(1) + value[i], V{});
      const V elastic = maximum(value[i] / (Real(1) + square_root(inside)), splat(Real(-1)));
      r.stretch[i] = r.plastic ? exponential_minus_one(mapped) : elastic;
    }
    return r;
  }

  // Principal Kirchhoff stresses 2 mu (s-1) s + lambda J (J-1) of stretches s = 1 + a.
  CPDEFORM_INLINE static void principal_stress(const V (&a)[3], const Law& law, V (&stress)[3]) {
    const V j1 = a[0] + a[1] + a[2] + a[0] * a[1] + a[0] * a[2] + a[1] * a[2] + a[0] * a[1] * a[2];
    const V pressure = law.lambda * (Real(1) + j1) * j1;
    for (int i = 0; i < 3; ++i) stress[i] = (law.mu + law.mu) * a[i] * (Real(1) + a[i]) + pressure;
  }

  // J - 1 with J^2 = det(I + e)
  CPDEFORM_INLINE static V volume_change(const Symmetric& e) {
    const V minors = e.xx * e.yy + e.xx * e.zz + e.yy * e.zz - e.xy * e.xy - e.xz * e.xz - e.yz * e.yz;
    const V product = e.xx * (e.yy * e.zz - e.yz * e.yz) + Real(2) * e.xy * e.xz * e.yz - e.yy * e.xz * e.xz - e.zz * e.xy * e.xy;
    const V d = e.xx + e.yy + e.zz + minors + product;
    return d / (Real(1) + square_root(Real(1) + d));
  }

  // Whether all lanes are small strains inside the yield surface; then `stress` is theirs.
  CPDEFORM_INLINE static bool series_stress(const Symmetric& e, const Law& law, Symmetric& stress) {
    if constexpr (!has_series) return false;
    const V size = e.xx * e.xx + e.yy * e.yy + e.zz * e.zz + Real(2) * (e.xy * e.xy + e.xz * e.xz + e.yz * e.yz);
    if (any<Real>(!(size < series_limit))) return false;
    const Symmetric e2 = multiply_commuting(e, e), e3 = multiply_commuting(e2, e), e4 = multiply_commuting(e2, e2);
    auto hencky = [](V a, V b, V c, V d) { return Real(0.5) * a - Real(0.25) * b + Real(1.0 / 6.0) * c - Real(0.125) * d; };
    const V hxx = hencky(e.xx, e2.xx, e3.xx, e4.xx), hyy = hencky(e.yy, e2.yy, e3.yy, e4.yy), hzz = hencky(e.zz, e2.zz, e3.zz, e4.zz);
    const V hxy = hencky(e.xy, e2.xy, e3.xy, e4.xy), hxz = hencky(e.xz, e2.xz, e3.xz, e4.xz), hyz = hencky(e.yz, e2.yz, e3.yz, e4.yz);
    const V mean = (hxx + hyy + hzz) * Real(1.0 / 3.0);
    const V norm = hxx * hxx + hyy * hyy + hzz * hzz + Real(2) * (hxy * hxy + hxz * hxz + hyz * hyz) - Real(3) * mean * mean +
                   norm_regularization;
    const V limit = law.yield_stress / (law.mu + law.mu);
    if (any<Real>(!(norm <= limit * limit))) return false;
    const V j1 = volume_change(e);
    const V pressure = law.lambda * (Real(1) + j1) * j1;
    const V twice = law.mu + law.mu;
    auto entry = [&](V a, V b, V c, V d) {
      return twice * (Real(0.5) * a + Real(0.125) * b - Real(0.0625) * c + Real(5.0 / 128.0) * d);
    };
    stress = {entry(e.xx, e2.xx, e3.xx, e4.xx) + pressure,
              entry(e.yy, e2.yy, e3.yy, e4.yy) + pressure,
              entry(e.zz, e2.zz, e3.zz, e4.zz) + pressure,
              entry(e.xy, e2.xy, e3.xy, e4.xy),
              entry(e.xz, e2.xz, e3.xz, e4.xz),
              entry(e.yz, e2.yz, e3.yz, e4.yz)};
    return true;
  }

  // New elastic strain and Kirchhoff stress of a trial strain.
  CPDEFORM_INLINE static void respond(const Symmetric& trial, const Law& law, Symmetric& strain, Symmetric& stress) {
    strain = trial;
    if (series_stress(trial, law, stress)) return;
    Eigen e;
    eigen(trial, e);
    const Mapped mapped = return_map(e.value, law);
    V principal[3], squared[3];
    principal_stress(mapped.stretch, law, principal);
    stress = compose(principal, e);
    if (!any<Real>(mapped.plastic)) return;
    for (int i = 0; i < 3; ++i) squared[i] = mapped.stretch[i] * (Real(2) + mapped.stretch[i]);
    const Symmetric made = compose(squared, e);
    strain = {mapped.plastic ? made.xx : trial.xx, mapped.plastic ? made.yy : trial.yy, mapped.plastic ? made.zz : trial.zz,
              mapped.plastic ? made.xy : trial.xy, mapped.plastic ? made.xz : trial.xz, mapped.plastic ? made.yz : trial.yz};
  }

  // Gradient with respect to a trial strain that `series_stress` accepted.
  CPDEFORM_INLINE static Symmetric series_adjoint(const Symmetric& trial, const Law& law, const Symmetric& grad_strain,
                                                  const Symmetric& grad_stress) {
    const Matrix e = full(trial);
    const Matrix g1 = multiply(e, full(grad_stress)), g2 = multiply(e, g1), g3 = multiply(e, g2);
    const Matrix g2e = multiply(g2, e), g1e = multiply(g1, e);
    const V j = Real(1) + volume_change(trial);
    const V b0 = Real(1) + trial.xx, b1 = Real(1) + trial.yy, b2 = Real(1) + trial.zz;
    // d J / d e = cofactor(I + e) / (2 J)
    const V trace = grad_stress.xx + grad_stress.yy + grad_stress.zz;
    const V pull = Real(0.5) / j * law.lambda * (Real(2) * j - Real(1)) * trace;
    const V twice = law.mu + law.mu;
    auto entry = [&](V strain, V stress, int i, int k, V cofactor) {
      const V sides = Real(0.125) * (g1.m[i][k] + g1.m[k][i]) - Real(0.0625) * (g2.m[i][k] + g2.m[k][i]) +
                      Real(5.0 / 128.0) * (g3.m[i][k] + g3.m[k][i] + g2e.m[i][k] + g2e.m[k][i]);
      return strain + twice * (Real(0.5) * stress + sides - Real(0.0625) * g1e.m[i][k]) + pull * cofactor;
    };
    return {entry(grad_strain.xx, grad_stress.xx, 0, 0, b1 * b2 - trial.yz * trial.yz),
            entry(grad_strain.yy, grad_stress.yy, 1, 1, b0 * b2 - trial.xz * trial.xz),
            entry(grad_strain.zz, grad_stress.zz, 2, 2, b0 * b1 - trial.xy * trial.xy),
            entry(grad_strain.xy, grad_stress.xy, 0, 1, trial.xz * trial.yz - trial.xy * b2),
            entry(grad_strain.xz, grad_stress.xz, 0, 2, trial.xy * trial.yz - trial.xz * b1),
            entry(grad_strain.yz, grad_stress.yz, 1, 2, trial.xy * trial.xz - trial.yz * b0)};
  }

  // sinh(x) / x
  CPDEFORM_INLINE static V sinhc(V x) {
    const V x2 = x * x;
    const V series = Real(1) + x2 * Real(1.0 / 6.0) * (Real(1) + x2 * Real(1.0 / 20.0) * (Real(1) + x2 * Real(1.0 / 42.0)));
    const M large = x2 > Real(0.25);
    if (!any<Real>(large)) return series;
    const V grown = exponential(x);
    const V ratio = Real(0.5) * (grown - Real(1) / grown) / (large ? x : splat(Real(1)));
    return large ? ratio : series;
  }

  // Divided difference (s_i - s_j) / (l_i - l_j) of new stretches over trial eigenvalues, exact where they meet.
  CPDEFORM_INLINE static V stretch_slope(const Mapped& r, const V (&value)[3], int i, int j) {
    const V elastic = Real(1) / maximum(Real(2) + r.stretch[i] + r.stretch[j], splat(Real(1e-6)));
    if (!any<Real>(r.plastic)) return elastic;
    const V gap = r.trial[i] - r.trial[j];
    const V smooth = Real(0.5) * r.factor * exponential(Real(0.5) * (r.hencky[i] + r.hencky[j]) - (r.trial[i] + r.trial[j])) *
                     sinhc(Real(0.5) * r.factor * gap) / sinhc(gap);
    const V distance = value[i] - value[j];
    const M apart = absolute(distance) > Real(1e-6);
    const V ratio = (r.stretch[i] - r.stretch[j]) / (apart ? distance : splat(Real(1)));
    const V clamped = apart ? ratio : V{};
    const M free = (value[i] > smallest_stretch_squared) & (value[j] > smallest_stretch_squared);
    return r.plastic ? (free ? smooth : clamped) : elastic;
  }

  CPDEFORM_INLINE static void project(const Symmetric& g, const V (&u)[3], V (&r)[3]) {
    r[0] = g.xx * u[0] + g.xy * u[1] + g.xz * u[2];
    r[1] = g.xy * u[0] + g.yy * u[1] + g.yz * u[2];
    r[2] = g.xz * u[0] + g.yz * u[1] + g.zz * u[2];
  }
  CPDEFORM_INLINE static V dot(const V (&a)[3], const V (&b)[3]) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

  // Gradient with respect to a trial strain whose eigensystem and return mapping are given.
  CPDEFORM_INLINE static Symmetric eigen_adjoint(const Eigen& e, const Mapped& r, const Law& law, const Symmetric& grad_strain,
                                                 const Symmetric& grad_stress) {
    V gt[3][3], ge[3][3], s[3];
    for (int n = 0; n < 3; ++n) {
      project(grad_stress, e.vector[n], gt[n]);
      project(grad_strain, e.vector[n], ge[n]);
      s[n] = Real(1) + r.stretch[n];
    }
    V t[3], d[3];
    for (int n = 0; n < 3; ++n) {
      t[n] = dot(e.vector[n], gt[n]);
      d[n] = dot(e.vector[n], ge[n]);
    }
    const V twice = law.mu + law.mu;
    const V j = s[0] * s[1] * s[2];
    const V pressure = (t[0] + t[1] + t[2]) * law.lambda * (Real(2) * j - Real(1));
    V gs[3], gl[3];
    for (int n = 0; n < 3; ++n)
      gs[n] = twice * (Real(2) * s[n] - Real(1)) * t[n] + pressure * s[(n + 1) % 3] * s[(n + 2) % 3];
    for (int n = 0; n < 3; ++n) gl[n] = gs[n] * Real(0.5) / maximum(s[n], splat(Real(1e-6))) + d[n];
    if (any<Real>(r.plastic)) {
      V gh[3];
      for (int n = 0; n < 3; ++n) gh[n] = (gs[n] + Real(2) * s[n] * d[n]) * s[n];
      const V average = (gh[0] + gh[1] + gh[2]) * Real(1.0 / 3.0);
      const V bend = r.factor / (r.norm * r.norm) * dot(gh, r.deviator);
      for (int n = 0; n < 3; ++n) {
        const M free = e.value[n] > smallest_stretch_squared;
        const V slope = (average + r.factor * (gh[n] - average) - bend * r.deviator[n]) * Real(0.5) /
                        (free ? Real(1) + e.value[n] : splat(Real(1)));
        gl[n] = r.plastic ? (free ? slope : V{}) : gl[n];
      }
    }
    Symmetric result = compose(gl, e);
    auto mix = [&](int a, int b) {
      const V h = stretch_slope(r, e.value, a, b) * (twice * (s[a] + s[b] - Real(1)) * dot(e.vector[a], gt[b]) +
                                                    (s[a] + s[b]) * dot(e.vector[a], ge[b]));
      const V(&u)[3] = e.vector[a];
      const V(&w)[3] = e.vector[b];
      result.xx += Real(2) * h * u[0] * w[0];
      result.yy += Real(2) * h * u[1] * w[1];
      result.zz += Real(2) * h * u[2] * w[2];
      result.xy += h * (u[0] * w[1] + u[1] * w[0]);
      result.xz += h * (u[0] * w[2] + u[2] * w[0]);
      result.yz += h * (u[1] * w[2] + u[2] * w[1]);
    };
    mix(0, 1);
    mix(0, 2);
    mix(1, 2);
    return result;
  }

  // Gradients with respect to the old strain and to C, from that of the trial strain. `d` is dt C.
  CPDEFORM_INLINE static void trial_adjoint(const Symmetric& e, const Matrix& d, Real time_step, const Symmetric& grad_trial,
                                            Symmetric& grad_strain, Matrix& grad_affine) {
    Matrix f = d;
    for (int i = 0; i < 3; ++i) f.m[i][i] += Real(1);
    const Matrix gf = multiply(full(grad_trial), f);
    const Matrix gfe = multiply(gf, full(e));
    for (int i = 0; i < 3; ++i)
      for (int k = 0; k < 3; ++k) grad_affine.m[i][k] = (Real(2) * time_step) * (gf.m[i][k] + gfe.m[i][k]);
    auto entry = [&](int i, int k) { return f.m[0][i] * gf.m[0][k] + f.m[1][i] * gf.m[1][k] + f.m[2][i] * gf.m[2][k]; };
    grad_strain = {entry(0, 0), entry(1, 1), entry(2, 2), entry(0, 1), entry(0, 2), entry(1, 2)};
  }
};

}  // namespace CPDEFORM_ISA
