// The kernels of each instruction set.
#pragma once

#include "pass.h"

#define CPDEFORM_DECLARE_KERNELS(set)                                 \
  namespace set {                                                     \
  extern const cpdeform::transport::Kernels<float> transport_float;   \
  extern const cpdeform::transport::Kernels<double> transport_double; \
  }

CPDEFORM_DECLARE_KERNELS(baseline)
CPDEFORM_DECLARE_KERNELS(avx2)
CPDEFORM_DECLARE_KERNELS(avx512)

#undef CPDEFORM_DECLARE_KERNELS
