"""The configuration of a run: what the command line sets and the run record keeps."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from cpdeform.core.bounded import (
    MOST_COUNT,
    MOST_STAGES,
    MOST_STEPS,
    Count,
    Length,
    NonNegativeFloat,
    PositiveFloat,
    Seed,
    Whole,
    Workers,
)
from cpdeform.core.errors import InputError
from cpdeform.core.old_names import current_options
from cpdeform.core.plugins import AUTO
from cpdeform.core.scene import FrozenModel
from cpdeform.planning.objectives.contact import ContactKind
from cpdeform.planning.objectives.shape import COLLISION_WEIGHT

DEFAULT_EXECUTOR = "processes"


class OptimizerConfiguration(FrozenModel):
    """Options of `cpdeform.planning.optimizer.TrajectoryOptimizer`; see there. `pruner` is a name of `make_pruner`."""

    iterations: Count = 40
    learning_rate: PositiveFloat = 0.1
    patience: Count = 15
    tolerance: NonNegativeFloat = 1e-3
    initial_noise: NonNegativeFloat = 0.01
    pruner: Literal["halving", "none"] = "halving"
    backtrack: Count | None = 4
    leap: NonNegativeFloat | None = None
    warm_up: Count = 1
    annealed: bool = False


class PrioritiesConfiguration(FrozenModel):
    """How transport priorities are computed, on all particles and once per stage.

    Attributes:
        kind: ``"potential"``: the dual potentials of the cost |x - y| (the paper); ``"displacement"``: the distance that transport
            of the cost |x - y|^2 moves each particle, from a solver with an option `exponent`. See
            `cpdeform.core.priorities.transport_priorities`. Defaults to what the placer declares (`Placer.transport_problem`).
        blur: Entropic blur of the transport problem, length units, at least a millionth of the domain's edge; defaults to what the
            placer declares. The larger, the quicker and the smoother; up to half a centimetre the potentials' peak stays at the
            particles that have to move, displacements allow for two.
    """

    kind: Literal["potential", "displacement"] | None = None
    blur: Length | None = None


class ObjectiveConfiguration(FrozenModel):
    """What a plan's loss is.

    Attributes:
        kind: ``"transport"``: transport cost between the last step's particles and the goal (the paper); ``"shape"``: the same and
            the share of misplaced mass at several scales, see `cpdeform.planning.objectives.shape`; ``"plasticinelab"``: density,
            distance and contact terms of node masses, summed over all steps.
        density_weight: (``"shape"``) Weight of the misplaced mass, dimensionless.
        collision_weight: (``"shape"``) Weight of tools below the floor or inside each other, dimensionless.
        points: Particles that the transport loss is computed on, a fixed random subset; None for all.
        blur: Entropic blur of the transport loss, length units; at least a millionth of the domain's edge.
        refresh: Solve from scratch every so many evaluations, warm-started between.
        contact_weight: Weight of PlasticineLab's contact term, which draws tools to the body; defaults to 0 for ``"transport"``
            and 1 for ``"plasticinelab"``.
        coast_steps: (``"transport"``) Environment steps for which particles are taken to go on as fast as in the last one; see
            `ObjectiveTransport`.
        axis_scale: (``"transport"``) Positive factors of the coordinates x, y, z, dimensionless, before distances are taken; see
            `ObjectiveTransport`.
        contact: Kind of the contact term of ``"plasticinelab"``; see `cpdeform.planning.objectives.contact.contact_loss`.
    """

    kind: Literal["transport", "shape", "plasticinelab"] = "transport"
    points: Count | None = 10000
    blur: Length = 2e-3
    refresh: Count = 50
    contact_weight: NonNegativeFloat | None = None
    coast_steps: NonNegativeFloat = 0.0
    axis_scale: tuple[PositiveFloat, PositiveFloat, PositiveFloat] = (1.0, 1.0, 1.0)
    contact: ContactKind = "plasticinelab"
    density_weight: NonNegativeFloat = 1.0
    collision_weight: NonNegativeFloat = COLLISION_WEIGHT


class RefinementConfiguration(FrozenModel):
    """How a stage's best plan is refined, by another objective than the one that found it.

    Attributes:
        kind: ``"density"``: the share of misplaced mass, see `cpdeform.planning.objectives.density`; ``"iou"``: PlasticineLab's
            soft IoU, see `cpdeform.planning.objectives.soft_iou`; ``"transport"``: the transport cost of all particles as it is,
            without what the search's loss adds to it (factors of the coordinates, coasting).
        iterations: The most gradient evaluations, and never more than the search's; 0 for no refinement.
        learning_rate: Adam's step size, in units of action.
        patience: Stop when nothing improved for this many iterations.
    """

    kind: Literal["density", "iou", "transport"] = "density"
    iterations: Whole = Field(default=0, ge=0, le=MOST_COUNT)
    learning_rate: PositiveFloat = 0.03
    patience: Count = 15


class RunConfiguration(FrozenModel):
    """Everything that defines a run, under the names of the command line and of `--set`.

    Attributes:
        task: Registered name or path of a YAML file.
        backend: Registered name of the simulator, or ``"auto"``: the fastest one that is installed.
        ot: Registered name of the transport solver, or ``"auto"``.
        placer: Registered name of the placer; defaults to what the strategy sets, else ``"transport"``.
        device: Where tensors live, ``"cpu"`` or ``"cuda"``.
        seed: Seed of first actions and random placements.
        stages: Number of stages; defaults to the task's own.
        steps: Environment steps of a stage; defaults to the task's own.
        rest_steps: Environment steps of rest after them; defaults to the task's own.
        goal: File of the goal instead of the task's own, e.g. one written by `cpdeform task import-grid`.
        strategy: Registered name of the strategy, or ``"auto"``: ``"sculpt"`` for tasks of several stages, ``"cpdeform"`` for those
            of one, see `cpdeform.run.strategy_choice`; ``"paper"`` is Algorithm 1 to the letter. What it sets, the user overrides.
        workers: Processes that batches of candidates are spread over; the threads of each are its share of the cores, unless
            ``simulator_options.threads`` says otherwise.
        executor: Registered name of what computes the batches where there are several workers: ``"processes"`` of this machine, or
            ``"ray"``.
        optimizer: Options of the optimiser.
        objective: Options of the loss.
        priorities: Options of the transport priorities.
        refinement: Options of the refinement of each stage's plan.
        scene: Changes of the task's scene, e.g. ``{"ground_friction": 2.0, "bodies": {"0": {"particle_count": 3000}}}``.
        simulator_options: Further keyword options of the simulator.
        ot_options: Further keyword options of the transport solver that gives the priorities.
        placer_options: Keyword options of the placer.
        strategy_options: Keyword options of the strategy.
        executor_options: Keyword options of the executor, such as ``{"address": "10.0.0.1:6379"}``.
    """

    task: str = "writer"
    backend: str = AUTO
    ot: str = AUTO
    placer: str = "transport"
    device: str = "cpu"
    seed: Seed = 0
    stages: Whole | None = Field(default=None, ge=1, le=MOST_STAGES)
    steps: Whole | None = Field(default=None, ge=1, le=MOST_STEPS)
    rest_steps: Whole | None = Field(default=None, ge=0, le=MOST_STEPS)
    goal: Path | None = None
    strategy: str = AUTO
    workers: Workers = 1
    executor: str = DEFAULT_EXECUTOR
    optimizer: OptimizerConfiguration = OptimizerConfiguration()
    objective: ObjectiveConfiguration = ObjectiveConfiguration()
    priorities: PrioritiesConfiguration = PrioritiesConfiguration()
    refinement: RefinementConfiguration = RefinementConfiguration()
    scene: dict[str, Any] = Field(default_factory=dict)
    simulator_options: dict[str, Any] = Field(default_factory=dict)
    ot_options: dict[str, Any] = Field(default_factory=dict)
    placer_options: dict[str, Any] = Field(default_factory=dict)
    strategy_options: dict[str, Any] = Field(default_factory=dict)
    executor_options: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _take_old_names(cls, content: Any) -> Any:
        return current_options(content)

    @field_validator("device")
    @classmethod
    def _check_device(cls, value: str) -> str:
        if not re.fullmatch(r"cpu|cuda(:\d+)?", value):
            raise InputError("device", came=f'"{value}"', expected='"cpu", "cuda" or "cuda:N"')
        return value
