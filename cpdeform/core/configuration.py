"""The configuration of a run: what the command line sets and the run record keeps."""

from __future__ import annotations

import re
from typing import Any, Literal

from pydantic import Field, field_validator

from cpdeform.core.errors import InputError
from cpdeform.core.plugins import AUTO
from cpdeform.core.scene import FrozenModel


class OptimizerConfiguration(FrozenModel):
    """Options of `cpdeform.core.optimizer.TrajectoryOptimizer`; see there."""

    iterations: int = Field(default=40, ge=1)
    learning_rate: float = Field(default=0.1, gt=0.0)
    patience: int = Field(default=15, ge=1)
    tolerance: float = Field(default=1e-3, ge=0.0)
    initial_noise: float = Field(default=0.01, ge=0.0)
    schedule: Literal["halving", "paper"] = "halving"


class PrioritiesConfiguration(FrozenModel):
    """How transport priorities are computed, on all particles and once per stage.

    Attributes:
        blur: Entropic blur of the transport problem, length units. The larger, the quicker and the smoother; up to half a
            centimetre the potentials' peak stays at the particles that have to move.
    """

    blur: float = Field(default=5e-3, gt=0.0)


class ObjectiveConfiguration(FrozenModel):
    """What a plan's loss is.

    Attributes:
        points: Particles that the transport loss is computed on, a fixed random subset; None for all.
        blur: Entropic blur of the transport loss, length units.
        refresh: Solve from scratch every so many evaluations, warm-started between.
        contact_weight: Weight of PlasticineLab's contact term, which draws tools to the body.
    """

    points: int | None = Field(default=2000, ge=1)
    blur: float = Field(default=2e-3, gt=0.0)
    refresh: int = Field(default=20, ge=1)
    contact_weight: float = Field(default=0.0, ge=0.0)


class RunConfiguration(FrozenModel):
    """Everything that defines a run, under the names of the command line and of `--set`.

    Attributes:
        task: Registered name or path of a YAML file.
        backend: Registered name of the simulator, or ``"auto"``: the fastest one that is installed.
        ot: Registered name of the transport solver, or ``"auto"``.
        placer: Registered name of the placer.
        device: Where tensors live, ``"cpu"`` or ``"cuda"``.
        seed: Seed of first actions and random placements.
        stages: Number of stages; the task's own where absent.
        optimizer: Options of the optimiser.
        objective: Options of the loss.
        priorities: Options of the transport priorities.
        scene: Changes of the task's scene, e.g. ``{"ground_friction": 2.0, "bodies": {"0": {"particle_count": 3000}}}``.
        simulator_options: Further keyword options of the simulator.
        ot_options: Further keyword options of the transport solver that gives the priorities.
        placer_options: Keyword options of the placer.
    """

    task: str = "writer"
    backend: str = AUTO
    ot: str = AUTO
    placer: str = "transport"
    device: str = "cpu"
    seed: int = Field(default=0, ge=0)
    stages: int | None = Field(default=None, ge=1)
    optimizer: OptimizerConfiguration = OptimizerConfiguration()
    objective: ObjectiveConfiguration = ObjectiveConfiguration()
    priorities: PrioritiesConfiguration = PrioritiesConfiguration()
    scene: dict[str, Any] = Field(default_factory=dict)
    simulator_options: dict[str, Any] = Field(default_factory=dict)
    ot_options: dict[str, Any] = Field(default_factory=dict)
    placer_options: dict[str, Any] = Field(default_factory=dict)

    @field_validator("device")
    @classmethod
    def _check_device(cls, value: str) -> str:
        if not re.fullmatch(r"cpu|cuda(:\d+)?", value):
            raise InputError("device", came=f'"{value}"', expected='"cpu", "cuda" or "cuda:N"')
        return value
