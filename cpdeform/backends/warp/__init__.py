"""MPM on NVIDIA Warp, CPU and CUDA: kernels with hand-written adjoints, and the host code around them."""
