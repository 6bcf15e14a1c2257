// Square roots and powers of two as the soft minimum needs them.
#pragma once

#include "simd.h"

namespace CPDEFORM_ISA {

// 1 / sqrt(a) of positive normal numbers, relative error below 3e-7 in float.
CPDEFORM_INLINE Vec<float> inverse_square_root(Vec<float> a) {
#if defined(__AVX512F__)
  const Vec<float> guess = (Vec<float>)_mm512_maskz_rsqrt14_ps(0xffff, (__m512)a);  // 14 bits, a Newton step gives all 24
  return guess * (1.5f - 0.5f * (a * guess) * guess);
#else
  return 1.0f / square_root(a);
#endif
}

CPDEFORM_INLINE Vec<double> inverse_square_root(Vec<double> a) { return 1.0 / square_root(a); }

// shift - scale * sqrt(a), for positive normal a.
CPDEFORM_INLINE Vec<float> minus_scaled_root(Vec<float> shift, Vec<float> a, float scale) {
#if defined(__AVX512F__)
  const Vec<float> guess = (Vec<float>)_mm512_maskz_rsqrt14_ps(0xffff, (__m512)a);
  const Vec<float> root = a * guess;
  return shift - root * (1.5f * scale - root * guess * (0.5f * scale));
#else
  return shift - scale * square_root(a);
#endif
}

CPDEFORM_INLINE Vec<double> minus_scaled_root(Vec<double> shift, Vec<double> a, double scale) { return shift - scale * square_root(a); }

// 2^x with x clamped to [-120, 120]; relative error below 3e-7 (a minimax polynomial on [-1/2, 1/2], 8e-8, and rounding). Adding
// 1.5 * 2^23 rounds to a whole number, in the low bits.
CPDEFORM_INLINE Vec<float> exponential_of_two(Vec<float> x) {
  x = minimum(maximum(x, splat(-120.0f)), splat(120.0f));
  const Vec<float> shifted = x + 12582912.0f;
  const Vec<float> r = x - (shifted - 12582912.0f);
  Vec<float> p = splat(9.67554132e-3f) + r * 1.327647012e-3f;
  p = 5.550713279e-2f + r * p;
  p = 2.402211972e-1f + r * p;
  p = 6.931469671e-1f + r * p;
  p = 1.000000072f + r * p;
  return (Vec<float>)((Mask<float>)p + ((Mask<float>)shifted << 23));
}

// 2^x with x clamped to [-1000, 1000]; relative error below 1e-15: the Taylor series of exp(r log 2), |r| <= 1/2.
CPDEFORM_INLINE Vec<double> exponential_of_two(Vec<double> x) {
  x = minimum(maximum(x, splat(-1000.0)), splat(1000.0));
  const Vec<double> shifted = x + 6755399441055744.0;
  const Vec<double> r = (x - (shifted - 6755399441055744.0)) * 0.69314718055994530942;
  Vec<double> p = splat(1.0 / 6227020800.0);
  p = 1.0 / 479001600.0 + r * p;
  p = 1.0 / 39916800.0 + r * p;
  p = 1.0 / 3628800.0 + r * p;
  p = 1.0 / 362880.0 + r * p;
  p = 1.0 / 40320.0 + r * p;
  p = 1.0 / 5040.0 + r * p;
  p = 1.0 / 720.0 + r * p;
  p = 1.0 / 120.0 + r * p;
  p = 1.0 / 24.0 + r * p;
  p = 1.0 / 6.0 + r * p;
  p = 0.5 + r * p;
  p = 1.0 + r * p;
  p = 1.0 + r * p;
  return (Vec<double>)((Mask<double>)p + ((Mask<double>)shifted << 52));
}

// Append to `list` the numbers first, first + 1, ... of the lanes of `mask`; writes up to `lanes` numbers, returns how many count.
template <class Real>
CPDEFORM_INLINE int append(int32_t* list, Mask<Real> mask, int32_t first) {
  int count = 0;
#if defined(__AVX512F__)
  if constexpr (sizeof(Real) == 4) {
    const __mmask16 bits = _mm512_test_epi32_mask((__m512i)mask, (__m512i)mask);
    const __m512i numbers = _mm512_add_epi32(_mm512_set1_epi32(first), _mm512_set_epi32(15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0));
    _mm512_storeu_si512(list, _mm512_maskz_compress_epi32(bits, numbers));
    return __builtin_popcount(bits);
  }
#endif
  for (int lane = 0; lane < Simd<Real>::lanes; ++lane) {
    list[count] = first + lane;
    count += mask[lane] != 0;
  }
  return count;
}

}  // namespace CPDEFORM_ISA
