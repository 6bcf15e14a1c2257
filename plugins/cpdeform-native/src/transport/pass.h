// What a kernel needs of one pass, a soft minimum over pairs; shared by host and kernel files, so without the standard library.
//
// All potentials are in units of the temperature and to base two: with s = 1 / (eps log 2), a row's potential f_i is t_i = s f_i,
// and a column's g_j with its weight b_j is h_j = s g_j + log2 b_j. A pair of cost c then has the exponent
//
//     e_ij = t_i + h_j - s c_ij,                                                                                      (1)
//
// and the soft minimum f_i = -eps log sum_j b_j exp((g_j - c_ij) / eps) becomes t_i - log2 sum_j 2^e_ij: the current t_i is a shift
// that keeps the sum near one, whatever its value.
#pragma once

#include <cstdint>

namespace cpdeform::transport {

// Rows of a block, treated together: a vector register of floats with AVX-512.
constexpr int block_size = 16;

// h of a point without weight: small enough to never matter, large enough to be added to.
constexpr double no_weight = -1e30;

template <class Real>
struct Columns {
  int count;              // whole blocks
  const Real* axis[3];    // coordinates (count,)
  const Real* h;          // (count,)
  const Real* packed;     // x, y, z, h (count, 4)
  const Real* box[6];     // lower and upper corners (count / block_size,)
  const Real* h_largest;  // largest h of a block (count / block_size,)
};

// One block of rows and where its results go.
template <class Real>
struct Rows {
  const Real* axis[3];  // coordinates (block_size,)
  const Real* t;        // (block_size,)
  Real box[6];          // lower and upper corner
  Real t_largest;
  Real* log2_sum;     // log2 sum_j 2^e_ij (block_size,)
  Real* gradient[3];  // sum_j P_ij d c_ij / d x_i, with P_ij = 2^e_ij / sum (block_size,), where wanted
};

// The kernels of one instruction set and type. `scale` is s of equation (1).
template <class Real>
struct Kernels {
  // Columns j with e_ij > -cut for some row i of the block, and others that the block's box cannot rule out. The list has room for
  // all columns and a register more. Returns their number.
  int (*candidates)(const Columns<Real>& columns, const Rows<Real>& rows, int exponent, Real scale, Real cut, int32_t* list);

  // Of the listed columns those with e_ij > -cut for some i, and no others: into `list` again. Returns their number.
  int (*select)(const Columns<Real>& columns, const Rows<Real>& rows, int exponent, Real scale, Real cut, int32_t* list, int count);

  // Soft minimum over the listed columns.
  void (*evaluate)(const Columns<Real>& columns, const Rows<Real>& rows, int exponent, Real scale, const int32_t* list, int count);

  // The same, and the gradient.
  void (*evaluate_gradient)(const Columns<Real>& columns, const Rows<Real>& rows, int exponent, Real scale, const int32_t* list,
                            int count);

  // Largest e_ij over all columns, into log2_sum.
  void (*largest)(const Columns<Real>& columns, const Rows<Real>& rows, int exponent, Real scale);
};

}  // namespace cpdeform::transport
