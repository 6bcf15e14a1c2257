"""Pictures and animations of run records."""

from __future__ import annotations

from cpdeform.report.draw import draw_run

__all__ = ["draw_run"]
