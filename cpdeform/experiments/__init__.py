"""Experiments: comparisons over tasks, parts and seeds, as tables."""
