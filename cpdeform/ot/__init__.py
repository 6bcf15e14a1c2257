"""Optimal-transport solvers: `pot` (Python Optimal Transport) and `geomloss`; see `cpdeform.core.ot` for their one contract."""
