"""Algorithm 1 and what it is made of: strategies, phases, descent, pruning, losses and metrics."""
