"""Interfaces, data, and Algorithm 1; nothing here imports a backend, a solver or a placer."""
