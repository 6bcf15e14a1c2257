"""A simulator for cpdeform in plain PyTorch: the tutorial for authors of backends, and a gradient to test others against."""
