// Soft minima over listed pairs. One block of sixteen rows lies in registers; columns are broadcast one after the other, so that a
// single column may be left out and no sum runs across lanes.

#include "kernels.h"

#include "simd.h"
#include "vector_math.h"

namespace CPDEFORM_ISA {

namespace {

using cpdeform::transport::block_size;
using cpdeform::transport::Columns;
using cpdeform::transport::Rows;

// Terms summed in one go before they join the total: ten thousand floats in a row would lose three digits.
constexpr int chunk_size = 256;

template <class Real>
struct Block {
  static constexpr int vectors = block_size / Simd<Real>::lanes;
  Vec<Real> v[vectors];
};

template <class Real>
CPDEFORM_INLINE Block<Real> load_block(const Real* p) {
  Block<Real> block;
  for (int k = 0; k < Block<Real>::vectors; ++k) block.v[k] = load(p + k * Simd<Real>::lanes);
  return block;
}

template <class Real>
CPDEFORM_INLINE void store_block(Real* p, const Block<Real>& block) {
  for (int k = 0; k < Block<Real>::vectors; ++k) store(p + k * Simd<Real>::lanes, block.v[k]);
}

// Distance along one axis from [low, high] to [other_low, other_high].
template <class V>
CPDEFORM_INLINE V gap(V low, V high, V other_low, V other_high) {
  return maximum(maximum(other_low - high, low - other_high), V{});
}

template <int Exponent, class Real>
CPDEFORM_INLINE Vec<Real> cost_of(Vec<Real> square) {
  if constexpr (Exponent == 2) return square;
  return square_root(square);
}

// shift - scale * cost
template <int Exponent, class Real>
CPDEFORM_INLINE Vec<Real> exponent_of(Vec<Real> shift, Vec<Real> square, Real scale) {
  if constexpr (Exponent == 2) return shift - scale * square;
  return minus_scaled_root(shift, square, scale);
}

template <int Exponent, class Real>
int candidates(const Columns<Real>& columns, const Rows<Real>& rows, Real scale, Real cut, int32_t* list) {
  constexpr int lanes = Simd<Real>::lanes;
  Vec<Real> low[3], high[3];
  for (int axis = 0; axis < 3; ++axis) {
    low[axis] = splat(rows.box[axis]);
    high[axis] = splat(rows.box[axis + 3]);
  }
  const Vec<Real> ceiling = splat(rows.t_largest + cut);
  const int blocks = columns.count / block_size;
  int count = 0;
  for (int first = 0; first < blocks; first += lanes) {
    Mask<Real> near;
    {
      Vec<Real> square{};
      for (int axis = 0; axis < 3; ++axis) {
        const Vec<Real> d = gap(low[axis], high[axis], load(columns.box[axis] + first), load(columns.box[axis + 3] + first));
        square += d * d;
      }
      near = ceiling + load(columns.h_largest + first) - scale * cost_of<Exponent, Real>(square) > Vec<Real>{};
    }
    if (!any<Real>(near)) continue;
    for (int lane = 0; lane < lanes && first + lane < blocks; ++lane) {
      if (near[lane] == 0) continue;
      for (int j = (first + lane) * block_size; j < (first + lane + 1) * block_size; j += lanes) {
        Vec<Real> square{};
        for (int axis = 0; axis < 3; ++axis) {
          const Vec<Real> x = load(columns.axis[axis] + j);
          const Vec<Real> d = gap(low[axis], high[axis], x, x);
          square += d * d;
        }
        const Mask<Real> close = ceiling + load(columns.h + j) - scale * cost_of<Exponent, Real>(square) > Vec<Real>{};
        count += append<Real>(list + count, close, j);
      }
    }
  }
  return count;
}

// Most candidates fail: an exponential of each would cost more than going through the list twice.
template <int Exponent, class Real>
int select(const Columns<Real>& columns, const Rows<Real>& rows, Real scale, Real cut, int32_t* list, int count) {
  constexpr int vectors = Block<Real>::vectors;
  const Block<Real> x = load_block(rows.axis[0]), y = load_block(rows.axis[1]), z = load_block(rows.axis[2]);
  Block<Real> t = load_block(rows.t);
  for (int k = 0; k < vectors; ++k) t.v[k] += cut;
  int found = 0;
  for (int n = 0; n < count; ++n) {
    const int32_t j = list[n];
    const Real* column = columns.packed + 4 * static_cast<int64_t>(j);
    Mask<Real> large{};
    for (int k = 0; k < vectors; ++k) {
      const Vec<Real> dx = x.v[k] - column[0], dy = y.v[k] - column[1], dz = z.v[k] - column[2];
      const Vec<Real> square = dx * dx + (dy * dy + (dz * dz + static_cast<Real>(Exponent == 1 ? 1e-30 : 0)));
      large |= exponent_of<Exponent, Real>(t.v[k] + column[3], square, scale) > Vec<Real>{};
    }
    list[found] = j;
    found += any<Real>(large);
  }
  return found;
}

template <int Exponent, bool Gradient, class Real>
void evaluate(const Columns<Real>& columns, const Rows<Real>& rows, Real scale, const int32_t* list, int count) {
  constexpr int vectors = Block<Real>::vectors;
  const Block<Real> x = load_block(rows.axis[0]), y = load_block(rows.axis[1]), z = load_block(rows.axis[2]);
  const Block<Real> t = load_block(rows.t);
  Block<Real> total{}, slope[3]{};
  for (int first = 0; first < count; first += chunk_size) {
    const int last = first + chunk_size < count ? first + chunk_size : count;
    Block<Real> sum{};
    for (int n = first; n < last; ++n) {
      const int32_t j = list[n];
      const Real* column = columns.packed + 4 * static_cast<int64_t>(j);
      for (int k = 0; k < vectors; ++k) {
        const Vec<Real> dx = x.v[k] - column[0], dy = y.v[k] - column[1], dz = z.v[k] - column[2];
        // a pair at distance zero has no gradient; its symmetric subgradient is zero
        const Vec<Real> square = dx * dx + (dy * dy + (dz * dz + static_cast<Real>(Exponent == 1 ? 1e-30 : 0)));
        const Vec<Real> shift = t.v[k] + column[3];
        Vec<Real> inverse, exponent;
        if constexpr (Exponent == 1 && Gradient) {
          inverse = inverse_square_root(square);
          exponent = shift - scale * (square * inverse);
        } else {
          exponent = exponent_of<Exponent, Real>(shift, square, scale);
        }
        const Vec<Real> term = exponential_of_two(exponent);
        sum.v[k] += term;
        if constexpr (Gradient) {
          const Vec<Real> weight = Exponent == 1 ? term * inverse : term * 2;
          slope[0].v[k] += weight * dx;
          slope[1].v[k] += weight * dy;
          slope[2].v[k] += weight * dz;
        }
      }
    }
    for (int k = 0; k < vectors; ++k) total.v[k] += sum.v[k];
  }
  for (int k = 0; k < vectors; ++k) {
    // no column at all: as small as a sum can be told
    const Vec<Real> sum = maximum(total.v[k], splat(static_cast<Real>(1e-37)));
    if constexpr (Gradient) {
      for (int axis = 0; axis < 3; ++axis) slope[axis].v[k] /= sum;
    }
    total.v[k] = logarithm(sum) * static_cast<Real>(1.44269504088896340736);
  }
  store_block(rows.log2_sum, total);
  if constexpr (Gradient) {
    for (int axis = 0; axis < 3; ++axis) store_block(rows.gradient[axis], slope[axis]);
  }
}

template <int Exponent, class Real>
void largest(const Columns<Real>& columns, const Rows<Real>& rows, Real scale) {
  constexpr int vectors = Block<Real>::vectors;
  const Block<Real> x = load_block(rows.axis[0]), y = load_block(rows.axis[1]), z = load_block(rows.axis[2]);
  const Block<Real> t = load_block(rows.t);
  Block<Real> most;
  for (int k = 0; k < vectors; ++k) most.v[k] = splat(static_cast<Real>(-3e38f));
  for (int j = 0; j < columns.count; ++j) {
    const Real* column = columns.packed + 4 * static_cast<int64_t>(j);
    for (int k = 0; k < vectors; ++k) {
      const Vec<Real> dx = x.v[k] - column[0], dy = y.v[k] - column[1], dz = z.v[k] - column[2];
      const Vec<Real> square = dx * dx + dy * dy + dz * dz;
      most.v[k] = maximum(most.v[k], (t.v[k] + column[3]) - scale * cost_of<Exponent, Real>(square));
    }
  }
  store_block(rows.log2_sum, most);
}

template <class Real>
int any_candidates(const Columns<Real>& columns, const Rows<Real>& rows, int exponent, Real scale, Real cut, int32_t* list) {
  return exponent == 1 ? candidates<1>(columns, rows, scale, cut, list) : candidates<2>(columns, rows, scale, cut, list);
}

template <class Real>
int any_select(const Columns<Real>& columns, const Rows<Real>& rows, int exponent, Real scale, Real cut, int32_t* list, int count) {
  return exponent == 1 ? select<1>(columns, rows, scale, cut, list, count) : select<2>(columns, rows, scale, cut, list, count);
}

template <class Real>
void any_evaluate(const Columns<Real>& columns, const Rows<Real>& rows, int exponent, Real scale, const int32_t* list, int count) {
  exponent == 1 ? evaluate<1, false>(columns, rows, scale, list, count) : evaluate<2, false>(columns, rows, scale, list, count);
}

template <class Real>
void any_gradient(const Columns<Real>& columns, const Rows<Real>& rows, int exponent, Real scale, const int32_t* list, int count) {
  exponent == 1 ? evaluate<1, true>(columns, rows, scale, list, count) : evaluate<2, true>(columns, rows, scale, list, count);
}

template <class Real>
void any_largest(const Columns<Real>& columns, const Rows<Real>& rows, int exponent, Real scale) {
  exponent == 1 ? largest<1>(columns, rows, scale) : largest<2>(columns, rows, scale);
}

template <class Real>
constexpr cpdeform::transport::Kernels<Real> kernels = {any_candidates<Real>, any_select<Real>, any_evaluate<Real>,
                                                        any_gradient<Real>, any_largest<Real>};

}  // namespace

extern const cpdeform::transport::Kernels<float> transport_float = kernels<float>;
extern const cpdeform::transport::Kernels<double> transport_double = kernels<double>;

}  // namespace CPDEFORM_ISA
