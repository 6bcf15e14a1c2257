"""cpdeform plans how robot tools sculpt soft, clay-like bodies.

The names below are imported on first use, so that `import cpdeform` and `cpdeform --help` stay quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cpdeform.core.hookspecs import PluginSpec, hookimpl
    from cpdeform.core.scene import Scene
    from cpdeform.core.simulator import Simulator, differentiable_rollout
    from cpdeform.core.state import State
    from cpdeform.core.task import Task, load_task
    from cpdeform.planning.optimizer import TrajectoryOptimizer
    from cpdeform.planning.result import Observer
    from cpdeform.run.deform import deform

__version__ = "0.1.0"

__all__ = [
    "Observer",
    "PluginSpec",
    "Scene",
    "Simulator",
    "State",
    "Task",
    "TrajectoryOptimizer",
    "deform",
    "differentiable_rollout",
    "hookimpl",
    "load_task",
]


def __getattr__(name: str) -> Any:
    modules = {
        "Observer": "cpdeform.planning.result",
        "PluginSpec": "cpdeform.core.hookspecs",
        "Scene": "cpdeform.core.scene",
        "Simulator": "cpdeform.core.simulator",
        "State": "cpdeform.core.state",
        "Task": "cpdeform.core.task",
        "TrajectoryOptimizer": "cpdeform.planning.optimizer",
        "deform": "cpdeform.run.deform",
        "differentiable_rollout": "cpdeform.core.simulator",
        "hookimpl": "cpdeform.core.hookspecs",
        "load_task": "cpdeform.core.task",
    }
    if name not in modules:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(modules[name]), name)
