"""SIMD C++ parts of cpdeform for the CPU: the simulator and the optimal transport solver `native`."""
