from __future__ import annotations

from toy_fixtures import make_toy_task, toy_distribution, toy_entry_points, toy_task_file

__all__ = ["make_toy_task", "toy_distribution", "toy_entry_points", "toy_task_file"]
