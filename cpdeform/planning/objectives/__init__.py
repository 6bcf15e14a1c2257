"""Losses on trajectories and the metrics that results are reported in."""
