"""MPM on Taichi, CPU and CUDA: kernels with hand-written adjoints, and the host code around them."""
