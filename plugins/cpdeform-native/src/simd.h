// Vectors of one native register (or more), on the compiler's vector extensions.
//
// Included by kernel files, which are compiled once per instruction set: CPDEFORM_ISA names the set and the namespace,
// CPDEFORM_REGISTER_BYTES is the width of its registers.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

#define CPDEFORM_INLINE inline __attribute__((always_inline))

namespace CPDEFORM_ISA {

// Lanes of a vector of Real: a register's, but at least the four floats of a grid node.
template <class Real>
constexpr int lanes_of = CPDEFORM_REGISTER_BYTES / sizeof(Real) < 4 ? 4 : CPDEFORM_REGISTER_BYTES / sizeof(Real);

template <class Real>
struct IntegerOf;
template <>
struct IntegerOf<float> {
  using type = int32_t;
};
template <>
struct IntegerOf<double> {
  using type = int64_t;
};

template <class Real>
struct Simd {
  static constexpr int lanes = lanes_of<Real>;
  using Integer = typename IntegerOf<Real>::type;
  typedef Real V __attribute__((vector_size(sizeof(Real) * lanes)));
  typedef Integer M __attribute__((vector_size(sizeof(Real) * lanes)));  // masks (all bits or none) and integers
  typedef int32_t Index __attribute__((vector_size(sizeof(int32_t) * lanes)));
  typedef Real Unaligned __attribute__((vector_size(sizeof(Real) * lanes), aligned(sizeof(Real)), may_alias));
};

template <class Real>
using Vec = typename Simd<Real>::V;
template <class Real>
using Mask = typename Simd<Real>::M;

template <class Real>
CPDEFORM_INLINE Vec<Real> splat(Real x) {
  return Vec<Real>{} + x;
}

template <class Real>
CPDEFORM_INLINE Vec<Real> load(const Real* p) {
  return *reinterpret_cast<const typename Simd<Real>::Unaligned*>(p);
}

template <class Real>
CPDEFORM_INLINE void store(Real* p, Vec<Real> v) {
  *reinterpret_cast<typename Simd<Real>::Unaligned*>(p) = v;
}

// Whether any lane of a mask is set.
template <class Real>
CPDEFORM_INLINE bool any(Mask<Real> m) {
#if defined(__AVX512F__)
  if constexpr (sizeof(m) == 64) return _mm512_test_epi64_mask((__m512i)m, (__m512i)m) != 0;
#endif
#if defined(__AVX2__)
  if constexpr (sizeof(m) == 32) return !_mm256_testz_si256((__m256i)m, (__m256i)m);
#endif
  uint64_t words[sizeof(m) / 8];
  std::memcpy(words, &m, sizeof(m));
  uint64_t all = 0;
  for (uint64_t word : words) all |= word;
  return all != 0;
}

template <class V>
CPDEFORM_INLINE V maximum(V a, V b) {
  return a > b ? a : b;
}
template <class V>
CPDEFORM_INLINE V minimum(V a, V b) {
  return a < b ? a : b;
}
// The compiler makes a comparison and a blend of the above; the processor's own instruction gives the same, also for nan.
#if defined(__AVX512F__)
CPDEFORM_INLINE Vec<float> maximum(Vec<float> a, Vec<float> b) { return (Vec<float>)_mm512_maskz_max_ps(0xffff, (__m512)a, (__m512)b); }
CPDEFORM_INLINE Vec<float> minimum(Vec<float> a, Vec<float> b) { return (Vec<float>)_mm512_maskz_min_ps(0xffff, (__m512)a, (__m512)b); }
#elif defined(__AVX2__)
CPDEFORM_INLINE Vec<float> maximum(Vec<float> a, Vec<float> b) { return (Vec<float>)_mm256_max_ps((__m256)a, (__m256)b); }
CPDEFORM_INLINE Vec<float> minimum(Vec<float> a, Vec<float> b) { return (Vec<float>)_mm256_min_ps((__m256)a, (__m256)b); }
#elif defined(__SSE2__)
CPDEFORM_INLINE Vec<float> maximum(Vec<float> a, Vec<float> b) { return (Vec<float>)_mm_max_ps((__m128)a, (__m128)b); }
CPDEFORM_INLINE Vec<float> minimum(Vec<float> a, Vec<float> b) { return (Vec<float>)_mm_min_ps((__m128)a, (__m128)b); }
#endif

template <class V>
CPDEFORM_INLINE V absolute(V a) {
  return a < V{} ? -a : a;
}

CPDEFORM_INLINE Vec<float> square_root(Vec<float> a) {
#if defined(__AVX512F__)
  return (Vec<float>)_mm512_sqrt_ps((__m512)a);
#elif defined(__AVX2__)
  return (Vec<float>)_mm256_sqrt_ps((__m256)a);
#elif defined(__SSE2__)
  return (Vec<float>)_mm_sqrt_ps((__m128)a);
#else
  for (int l = 0; l < Simd<float>::lanes; ++l) a[l] = std::sqrt(a[l]);
  return a;
#endif
}

CPDEFORM_INLINE Vec<double> square_root(Vec<double> a) {
#if defined(__AVX512F__)
  return (Vec<double>)_mm512_sqrt_pd((__m512d)a);
#elif defined(__AVX2__)
  return (Vec<double>)_mm256_sqrt_pd((__m256d)a);
#else
  for (int l = 0; l < Simd<double>::lanes; ++l) a[l] = std::sqrt(a[l]);
  return a;
#endif
}

// 1 / x and 1 / sqrt(x), good to 11 bits.
CPDEFORM_INLINE Vec<float> approximate_reciprocal(Vec<float> x) {
#if defined(__AVX512F__)
  return (Vec<float>)_mm512_rcp14_ps((__m512)x);
#elif defined(__AVX2__)
  return (Vec<float>)_mm256_rcp_ps((__m256)x);
#elif defined(__SSE2__)
  return (Vec<float>)_mm_rcp_ps((__m128)x);
#else
  return 1.0f / x;
#endif
}
CPDEFORM_INLINE Vec<float> approximate_reciprocal_root(Vec<float> x) {
#if defined(__AVX512F__)
  return (Vec<float>)_mm512_rsqrt14_ps((__m512)x);
#elif defined(__AVX2__)
  return (Vec<float>)_mm256_rsqrt_ps((__m256)x);
#elif defined(__SSE2__)
  return (Vec<float>)_mm_rsqrt_ps((__m128)x);
#else
  return 1.0f / square_root(x);
#endif
}
CPDEFORM_INLINE Vec<double> approximate_reciprocal(Vec<double> x) { return 1.0 / x; }
CPDEFORM_INLINE Vec<double> approximate_reciprocal_root(Vec<double> x) { return 1.0 / square_root(x); }

// 1 / sqrt(x) to the last digits.
CPDEFORM_INLINE Vec<float> reciprocal_root(Vec<float> x) {
#if defined(__AVX512F__)
  // one Newton step takes 14 bits to 27; AVX2's 11 bits would take two, and its division is fast
  const Vec<float> y = approximate_reciprocal_root(x);
  return y + y * (0.5f - 0.5f * x * y * y);
#else
  return 1.0f / square_root(x);
#endif
}
CPDEFORM_INLINE Vec<double> reciprocal_root(Vec<double> x) { return 1.0 / square_root(x); }

// Elementary functions. In float: polynomials, relative error below 3e-7 where the result is not denormal (tests hold them to it).
// In double: the C library's, lane by lane; double is for checks.

// 2^k for whole k in [-126, 127]
CPDEFORM_INLINE Vec<float> power_of_two(Mask<float> k) { return (Vec<float>)((k + 127) << 23); }

CPDEFORM_INLINE Mask<float> nearest(Vec<float> x) {
  const Vec<float> shifted = x + (x < Vec<float>{} ? splat(-0.5f) : splat(0.5f));
  return __builtin_convertvector(shifted, Mask<float>);
}

// Argument reduction x = k log 2 + r and the polynomial of expm1(r), |r| <= log(2)/2.
CPDEFORM_INLINE Vec<float> expm1_reduced(Vec<float> x, Mask<float>& k) {
  x = minimum(maximum(x, splat(-87.0f)), splat(88.0f));
  k = nearest(x * 1.44269504088896341f);
  const Vec<float> n = __builtin_convertvector(k, Vec<float>);
  const Vec<float> r = (x - n * 0.693359375f) + n * 2.12194440e-4f;
  Vec<float> p = splat(1.0f / 5040.0f) + r * (1.0f / 40320.0f);
  p = 1.0f / 720.0f + r * p;
  p = 1.0f / 120.0f + r * p;
  p = 1.0f / 24.0f + r * p;
  p = 1.0f / 6.0f + r * p;
  p = 0.5f + r * p;
  return r + r * r * p;
}

CPDEFORM_INLINE Vec<float> exponential(Vec<float> x) {
  Mask<float> k;
  const Vec<float> p = expm1_reduced(x, k);
  return (p + 1.0f) * power_of_two(k);
}

CPDEFORM_INLINE Vec<float> exponential_minus_one(Vec<float> x) {
  Mask<float> k;
  const Vec<float> p = expm1_reduced(x, k);
  const Vec<float> scale = power_of_two(k);
  return scale * p + (scale - 1.0f);
}

// Natural logarithm of a positive normal number.
CPDEFORM_INLINE Vec<float> logarithm(Vec<float> x) {
  Mask<float> bits = (Mask<float>)x;
  // mantissa in [sqrt(1/2), sqrt(2))
  const Mask<float> k = (bits - 0x3f3504f3) >> 23;
  const Vec<float> m = (Vec<float>)(bits - (k << 23)) - 1.0f;
  const Vec<float> n = __builtin_convertvector(k, Vec<float>);
  // atanh series: log(1 + m) = 2 atanh(s), s = m / (2 + m)
  const Vec<float> s = m / (2.0f + m);
  const Vec<float> z = s * s;
  Vec<float> p = splat(2.0f / 9.0f) + z * (2.0f / 11.0f);
  p = 2.0f / 7.0f + z * p;
  p = 2.0f / 5.0f + z * p;
  p = 2.0f / 3.0f + z * p;
  // 2 s + s z p, with 2 s = m - s m for digits near zero
  const Vec<float> log1p = m - s * (m - z * p);
  return n * 0.693359375f + (log1p - n * 2.12194440e-4f);
}

CPDEFORM_INLINE Vec<float> logarithm_of_one_plus(Vec<float> x) {
  const Vec<float> u = 1.0f + x;
  return logarithm(u) + (x - (u - 1.0f)) / u;
}

CPDEFORM_INLINE Vec<double> exponential(Vec<double> x) {
  for (int l = 0; l < Simd<double>::lanes; ++l) x[l] = std::exp(x[l]);
  return x;
}
CPDEFORM_INLINE Vec<double> exponential_minus_one(Vec<double> x) {
  for (int l = 0; l < Simd<double>::lanes; ++l) x[l] = std::expm1(x[l]);
  return x;
}
CPDEFORM_INLINE Vec<double> logarithm(Vec<double> x) {
  for (int l = 0; l < Simd<double>::lanes; ++l) x[l] = std::log(x[l]);
  return x;
}
CPDEFORM_INLINE Vec<double> logarithm_of_one_plus(Vec<double> x) {
  for (int l = 0; l < Simd<double>::lanes; ++l) x[l] = std::log1p(x[l]);
  return x;
}

}  // namespace CPDEFORM_ISA
