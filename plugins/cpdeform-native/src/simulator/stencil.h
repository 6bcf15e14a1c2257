// The 27 nodes around a particle, nine rows of three along z.
//
// A grid node is four numbers (momentum and mass, or a velocity and zero). The three nodes of a row and the one behind them are one
// AVX-512 register of floats; narrower registers take two or three. The fourth node's weight is zero.
#pragma once

#include "simd.h"

namespace CPDEFORM_ISA {

template <int... numbers>
struct Sequence {};
template <int n, int... numbers>
struct MakeSequence : MakeSequence<n - 1, n - 1, numbers...> {};
template <int... numbers>
struct MakeSequence<0, numbers...> {
  using type = Sequence<numbers...>;
};

// Exchange of the off-diagonal blocks of size `step`, one stage of a transposition.
template <int step, class V, int... lane>
CPDEFORM_INLINE void exchange(V& a, V& b, Sequence<lane...>) {
  constexpr int lanes = sizeof...(lane);
  const V low = __builtin_shufflevector(a, b, ((lane & step) ? lanes + lane - step : lane)...);
  const V high = __builtin_shufflevector(a, b, ((lane & step) ? lanes + lane : lane + step)...);
  a = low;
  b = high;
}

template <class Real>
struct Stencil {
  using V = Vec<Real>;
  static constexpr int lanes = Simd<Real>::lanes;
  static constexpr int parts = lanes >= 16 ? 1 : (12 + lanes - 1) / lanes;
  static constexpr int record_size = 16;

  struct Row {
    V part[parts];
    CPDEFORM_INLINE Row operator+(const Row& o) const {
      Row r;
      for (int p = 0; p < parts; ++p) r.part[p] = part[p] + o.part[p];
      return r;
    }
    CPDEFORM_INLINE Row operator*(const Row& o) const {
      Row r;
      for (int p = 0; p < parts; ++p) r.part[p] = part[p] * o.part[p];
      return r;
    }
    CPDEFORM_INLINE Row operator*(Real s) const {
      Row r;
      for (int p = 0; p < parts; ++p) r.part[p] = part[p] * s;
      return r;
    }
    CPDEFORM_INLINE void operator+=(const Row& o) {
      for (int p = 0; p < parts; ++p) part[p] += o.part[p];
    }
    // this += s * o
    CPDEFORM_INLINE void add(Real s, const Row& o) {
      for (int p = 0; p < parts; ++p) part[p] += s * o.part[p];
    }
  };

  CPDEFORM_INLINE static Row read(const Real* nodes) {
    Row r;
    for (int p = 0; p < parts; ++p) r.part[p] = load(nodes + p * lanes);
    return r;
  }
  CPDEFORM_INLINE static void write(Real* nodes, const Row& r) {
    for (int p = 0; p < parts; ++p) store(nodes + p * lanes, r.part[p]);
  }

  // The same four numbers at all nodes.
  CPDEFORM_INLINE static Row repeat(const Real* four) {
    V v;
    if constexpr (lanes == 4) {
      v = load(four);
    } else {
#if defined(__AVX512F__)
      if constexpr (sizeof(V) == 64 && lanes == 16) v = (V)_mm512_broadcast_f32x4(_mm_loadu_ps((const float*)four));
      if constexpr (sizeof(V) == 64 && lanes == 8) v = (V)_mm512_broadcast_f64x4(_mm256_loadu_pd((const double*)four));
#elif defined(__AVX__)
      if constexpr (sizeof(V) == 32 && lanes == 8) v = (V)_mm256_broadcast_ps((const __m128*)four);
#else
      for (int l = 0; l < lanes; ++l) v[l] = four[l % 4];
#endif
    }
    Row r;
    for (int p = 0; p < parts; ++p) r.part[p] = v;
    return r;
  }

  // One number per node.
  CPDEFORM_INLINE static Row along(Real a, Real b, Real c) {
    Row r;
    if constexpr (lanes == 16) {
      const Mask<Real> second = {0, 0, 0, 0, -1, -1, -1, -1, 0, 0, 0, 0, 0, 0, 0, 0};
      const Mask<Real> third = {0, 0, 0, 0, 0, 0, 0, 0, -1, -1, -1, -1, 0, 0, 0, 0};
      const Mask<Real> fourth = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, -1, -1, -1, -1};
      V v = second ? splat(b) : splat(a);
      v = third ? splat(c) : v;
      r.part[0] = fourth ? V{} : v;
    } else if constexpr (lanes == 8) {
      const Mask<Real> upper = {0, 0, 0, 0, -1, -1, -1, -1};
      r.part[0] = upper ? splat(b) : splat(a);
      r.part[1] = upper ? V{} : splat(c);
    } else {
      r.part[0] = splat(a);
      r.part[1] = splat(b);
      r.part[2] = splat(c);
    }
    return r;
  }

  // Sums over the nodes of four rows: record = (sum a, sum b, sum c, sum d), four numbers each.
  CPDEFORM_INLINE static void reduce(const Row& a, const Row& b, const Row& c, const Row& d, Real* record) {
    if constexpr (lanes == 16) {
      const V x = a.part[0], y = b.part[0], z = c.part[0], w = d.part[0];
      const V p = __builtin_shufflevector(x, y, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23) +
                  __builtin_shufflevector(x, y, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
      const V q = __builtin_shufflevector(z, w, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23) +
                  __builtin_shufflevector(z, w, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
      store(record, (V)(__builtin_shufflevector(p, q, 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27) +
                        __builtin_shufflevector(p, q, 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30, 31)));
    } else if constexpr (lanes == 8) {
      const V x = a.part[0] + a.part[1], y = b.part[0] + b.part[1], z = c.part[0] + c.part[1], w = d.part[0] + d.part[1];
      store(record, (V)(__builtin_shufflevector(x, y, 0, 1, 2, 3, 8, 9, 10, 11) +
                        __builtin_shufflevector(x, y, 4, 5, 6, 7, 12, 13, 14, 15)));
      store(record + 8, (V)(__builtin_shufflevector(z, w, 0, 1, 2, 3, 8, 9, 10, 11) +
                            __builtin_shufflevector(z, w, 4, 5, 6, 7, 12, 13, 14, 15)));
    } else {
      store(record, (V)(a.part[0] + a.part[1] + a.part[2]));
      store(record + 4, (V)(b.part[0] + b.part[1] + b.part[2]));
      store(record + 8, (V)(c.part[0] + c.part[1] + c.part[2]));
      store(record + 12, (V)(d.part[0] + d.part[1] + d.part[2]));
    }
  }

  CPDEFORM_INLINE static void transpose(V* v) {
    using Lanes = typename MakeSequence<lanes>::type;
    for (int i = 0; i < lanes; i += 2) exchange<1>(v[i], v[i + 1], Lanes{});
    for (int i = 0; i < lanes; ++i)
      if (!(i & 2)) exchange<2>(v[i], v[i + 2], Lanes{});
    if constexpr (lanes >= 8)
      for (int i = 0; i < lanes; ++i)
        if (!(i & 4)) exchange<4>(v[i], v[i + 4], Lanes{});
    if constexpr (lanes >= 16)
      for (int i = 0; i < lanes; ++i)
        if (!(i & 8)) exchange<8>(v[i], v[i + 8], Lanes{});
  }

  // Sixteen numbers of each lane from vectors to records (lane after lane), and back.
  CPDEFORM_INLINE static void to_records(V (&v)[record_size], Real* records) {
    for (int group = 0; group < record_size; group += lanes) {
      transpose(v + group);
      for (int l = 0; l < lanes; ++l) store(records + l * record_size + group, v[group + l]);
    }
  }
  CPDEFORM_INLINE static void from_records(const Real* records, V (&v)[record_size]) {
    for (int group = 0; group < record_size; group += lanes) {
      for (int l = 0; l < lanes; ++l) v[group + l] = load(records + l * record_size + group);
      transpose(v + group);
    }
  }

  // Quadratic B-spline weights along one axis, and their slopes, for f = x/dx - base in [1/2, 3/2).
  CPDEFORM_INLINE static void weights(V f, V* w) {
    const V a = Real(1.5) - f, b = f - Real(1), c = f - Real(0.5);
    w[0] = Real(0.5) * a * a;
    w[1] = Real(0.75) - b * b;
    w[2] = Real(0.5) * c * c;
  }
  CPDEFORM_INLINE static void slopes(V f, V* d) {
    d[0] = f - Real(1.5);
    d[1] = Real(2) * (Real(1) - f);
    d[2] = f - Real(0.5);
  }
};

}  // namespace CPDEFORM_ISA
