"""cpdeform plans how robot tools sculpt soft, clay-like bodies.

These names are the public face: what a notebook, a script or the author of a plugin needs. They keep their meaning between minor
versions; the modules behind them are free to change. Each is imported on first use, so that `import cpdeform` stays quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cpdeform.core.errors import CapabilityError, CpdeformError, InputError
    from cpdeform.core.hookspecs import PluginSpec, hookimpl
    from cpdeform.core.objective import Objective, ObjectiveAutograd, ObjectiveResult
    from cpdeform.core.ot import OTCapabilities, OTResult, OTSolver, TransportProblem
    from cpdeform.core.placer import Candidate, Placer, PlacerCapabilities, Proposal, Stage
    from cpdeform.core.plugins import Registry, load_registry
    from cpdeform.core.scene import Scene
    from cpdeform.core.simulator import RolloutGradient, Simulator, SimulatorCapabilities, Trajectory, differentiable_rollout
    from cpdeform.core.state import State
    from cpdeform.core.task import Task, load_task
    from cpdeform.placement.proposer import Proposer
    from cpdeform.planning.optimizer import TrajectoryOptimizer
    from cpdeform.planning.phases.phase import Phase
    from cpdeform.planning.pruner import Pruner
    from cpdeform.planning.result import DeformResult, Observer, StageResult, Status
    from cpdeform.planning.strategy import Strategy
    from cpdeform.report.public import render
    from cpdeform.run.deform import deform
    from cpdeform.run.record_reader import RunRecord, load_record
    from cpdeform.run.result import RunResult

__version__ = "0.1.0"

_MODULES = {
    "cpdeform.core.errors": ("CapabilityError", "CpdeformError", "InputError"),
    "cpdeform.core.hookspecs": ("PluginSpec", "hookimpl"),
    "cpdeform.core.objective": ("Objective", "ObjectiveAutograd", "ObjectiveResult"),
    "cpdeform.core.ot": ("OTCapabilities", "OTResult", "OTSolver", "TransportProblem"),
    "cpdeform.core.placer": ("Candidate", "Placer", "PlacerCapabilities", "Proposal", "Stage"),
    "cpdeform.core.plugins": ("Registry", "load_registry"),
    "cpdeform.core.scene": ("Scene",),
    "cpdeform.core.simulator": (
        "RolloutGradient",
        "Simulator",
        "SimulatorCapabilities",
        "Trajectory",
        "differentiable_rollout",
    ),
    "cpdeform.core.state": ("State",),
    "cpdeform.core.task": ("Task", "load_task"),
    "cpdeform.placement.proposer": ("Proposer",),
    "cpdeform.planning.optimizer": ("TrajectoryOptimizer",),
    "cpdeform.planning.phases.phase": ("Phase",),
    "cpdeform.planning.pruner": ("Pruner",),
    "cpdeform.planning.result": ("DeformResult", "Observer", "StageResult", "Status"),
    "cpdeform.planning.strategy": ("Strategy",),
    "cpdeform.report.public": ("render",),
    "cpdeform.run.deform": ("deform",),
    "cpdeform.run.record_reader": ("RunRecord", "load_record"),
    "cpdeform.run.result": ("RunResult",),
}

__all__ = [
    "Candidate",
    "CapabilityError",
    "CpdeformError",
    "DeformResult",
    "InputError",
    "OTCapabilities",
    "OTResult",
    "OTSolver",
    "Objective",
    "ObjectiveAutograd",
    "ObjectiveResult",
    "Observer",
    "Phase",
    "Placer",
    "PlacerCapabilities",
    "PluginSpec",
    "Proposal",
    "Proposer",
    "Pruner",
    "Registry",
    "RolloutGradient",
    "RunRecord",
    "RunResult",
    "Scene",
    "Simulator",
    "SimulatorCapabilities",
    "Stage",
    "StageResult",
    "State",
    "Status",
    "Strategy",
    "Task",
    "Trajectory",
    "TrajectoryOptimizer",
    "TransportProblem",
    "deform",
    "differentiable_rollout",
    "hookimpl",
    "load_record",
    "load_registry",
    "load_task",
    "render",
]


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            return getattr(importlib.import_module(module), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
