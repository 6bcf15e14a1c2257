"""A part whose optional dependency is not installed."""

from __future__ import annotations

import cpdeform_toy_dependency_that_is_not_installed  # noqa: F401
