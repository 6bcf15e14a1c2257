"""The landscape study: what descent makes of every start on a board, beside the transport priority there."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from cpdeform.core.clearance import exit_distances
from cpdeform.core.errors import InputError
from cpdeform.core.placer import Stage
from cpdeform.core.plugins import Registry
from cpdeform.core.reading.json_text import read_json
from cpdeform.placement.grid import movable_tools
from cpdeform.planning.algorithm import Planner
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.pruner import PrunerNone
from cpdeform.planning.stage_parts import stage_generator
from cpdeform.planning.still import still_trajectory
from cpdeform.run.record_files import to_json, write_json
from cpdeform.run.resolve import resolve

ROWS, SETTINGS_FILE = "rows", "landscape.json"
REACH = 0.5
"""How far above the clay a tool may have to be to be free of it, length units."""

EDGE = 0.02
"""Part of the board's width that the outermost starts stay away from its edges."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LandscapeSettings:
    """What to compute.

    Attributes:
        out: Directory of the rows and figures.
        task: Registered name or path of a YAML file; of a single movable tool that comes from above.
        size: Starts along x and along z.
        seed: Seed of the first actions.
        values: Further fields of `cpdeform.run.configuration.RunConfiguration`, nested.
    """

    out: Path
    task: str = "writer"
    size: int = 20
    seed: int = 0
    values: Mapping[str, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Start:
    """A start and what came of it.

    Attributes:
        row: Number of its row, along z.
        column: Number of its column, along x.
        x: Where the tool touches, length units.
        z: Where the tool touches, length units.
        priority: Transport priority of the particle of the board's top nearest to that place.
        loss_ratio: Best loss of the descent from there over the loss of leaving the clay as it is; nan where there was no room or
            no finite loss.
    """

    row: int
    column: int
    x: float
    z: float
    priority: float
    loss_ratio: float


def compute(
    settings: LandscapeSettings, *, registry: Registry, resume: bool = True, on_row: Callable[[int], None] = lambda row: None
) -> Iterator[list[Start]]:
    """The starts, row by row; rows that are there already with the same settings are read.

    Args:
        settings: What to compute.
        registry: Where names are looked up.
        resume: Read rows instead of computing them again.
        on_row: Told of each row that is computed, before it is.

    Raises:
        InputError: The task has several movable tools, or an option cannot be used.
    """
    values = {**settings.values, "task": settings.task, "seed": settings.seed, "placer": "transport"}
    resolved = resolve(values, registry=registry)
    planner = resolved.planner()
    key = to_json({"size": settings.size, "configuration": resolved.configuration.model_dump(mode="json")})
    if not resume or _read(settings.out / SETTINGS_FILE) != key:
        for path in (settings.out / ROWS).glob("row-*.json"):
            path.unlink()
        (settings.out / ROWS).mkdir(parents=True, exist_ok=True)
        write_json(settings.out / SETTINGS_FILE, key)
    board = None
    for row in range(settings.size):
        path = settings.out / ROWS / f"row-{row:03d}.json"
        found = _read(path)
        if found is None:
            on_row(row)
            board = board or _Board.of(planner, settings)
            found = [to_json(dataclasses.asdict(start)) for start in board.row(row)]
            write_json(path, {"starts": found})
        else:
            found = found["starts"]
        yield [_start(start) for start in found]


def _start(content: Mapping[str, Any]) -> Start:
    """A start as a row's file has it: null for a number that is not finite."""
    values: dict[str, Any] = {name: float("nan") if value is None else value for name, value in content.items()}
    return Start(**values)


def _read(path: Path) -> Any:
    """The content of a JSON file; None where there is none or it is damaged."""
    with contextlib.suppress(OSError, ValueError, InputError):
        return read_json(path, argument=str(path)) if path.is_file() else None
    return None


@dataclasses.dataclass(frozen=True)
class _Board:
    """The task at its start, with its transport solved.

    Attributes:
        planner: Simulator and loss.
        settings: What to compute.
        stage: The first stage.
        tool: Index of the movable tool.
        loss: Loss of leaving the clay as it is.
    """

    planner: Planner
    settings: LandscapeSettings
    stage: Stage
    tool: int
    loss: float

    @classmethod
    def of(cls, planner: Planner, settings: LandscapeSettings) -> _Board:
        task, simulator = planner.task, planner.simulator
        state = simulator.initial_state(batch_size=1)
        goal = torch.as_tensor(task.load_goal()).to(state.position)
        transport = planner.ot_solver.solve(state.position[0], goal)
        begin = planner.objective.evaluate(still_trajectory(state, task.rollout_steps, scene=task.scene))
        stage = Stage(0, task.scene, state, goal, transport, torch.Generator(), step_count=task.step_count)
        movable = movable_tools(stage)
        if len(movable) != 1:
            expected = "a task with one movable tool, such as writer"
            raise InputError("--tasks", came=f"{task.name} with {len(movable)}", expected=expected)
        return cls(planner, settings, stage, movable[0], float(begin.loss[0]))

    def row(self, row: int) -> list[Start]:
        """Compute a row of starts."""
        size, position = self.settings.size, self.stage.state.position[0]
        lower, upper = position.amin(dim=0), position.amax(dim=0)
        share = torch.linspace(EDGE, 1.0 - EDGE, size) if size > 1 else torch.tensor([0.5])
        x = (lower[0] + share.to(lower) * (upper[0] - lower[0])).tolist()
        z = float(lower[2] + share[row] * (upper[2] - lower[2]))
        contacts = [self._top(place, z) for place in x]
        poses = [self._above(place, z, contact) for place, contact in zip(x, contacts, strict=True)]
        losses = self._descend(poses)
        priorities = self.stage.priorities
        return [
            Start(row, column, x[column], z, float(priorities[contacts[column]]), losses[column] / self.loss)
            for column in range(size)
        ]

    def _top(self, x: float, z: float) -> int:
        """The highest particle within half a cell of a place, or else the nearest one."""
        position = self.stage.state.position[0]
        aside = torch.linalg.vector_norm(position[:, [0, 2]] - position.new_tensor([x, z]), dim=-1)
        near = aside <= 0.5 / self.planner.task.scene.grid_size
        return int(torch.where(near, position[:, 1], -torch.inf).argmax()) if bool(near.any()) else int(aside.argmin())

    def _above(self, x: float, z: float, contact: int) -> Tensor | None:
        """Poses (M, 8) with the tool just free of the clay above a place; None where that is out of its bounds."""
        position, poses = self.stage.state.position[0], self.stage.state.tool_pose[0].clone()
        tool, up = self.planner.task.scene.tools[self.tool], position.new_tensor([0.0, 1.0, 0.0])
        start = position.new_tensor([x, float(position[contact, 1]), z])
        height = exit_distances(tool, poses[self.tool, 3:7], start.unsqueeze(0), up, position, reach=REACH)[0]
        poses[self.tool, :3] = start + height * up
        lower, upper = poses.new_tensor(tool.lower_bound), poses.new_tensor(tool.upper_bound)
        inside = torch.isfinite(height) & (poses[self.tool, :3] >= lower).all() & (poses[self.tool, :3] <= upper).all()
        return poses if bool(inside) else None

    def _descend(self, poses: list[Tensor | None]) -> list[float]:
        """Best losses of descents from some poses; nan for those without room or a finite loss."""
        placed = [pose for pose in poses if pose is not None]
        if not placed:
            return [float("nan")] * len(poses)
        task, optimizer = self.planner.task, self._optimizer()
        state = self.stage.state.fork(len(placed)).with_tools(torch.stack(placed))
        # Every start gets the same first actions, so that the place alone makes the difference.
        first = optimizer.initial_actions((1, task.step_count, task.scene.action_size), stage_generator(self.settings.seed, 0))
        actions = torch.nn.functional.pad(first, (0, 0, 0, task.rest_steps)).expand(len(placed), -1, -1)
        found = optimizer.minimize(
            self.planner.simulator, state, actions.to(state.position), self.planner.objective, rest_steps=task.rest_steps
        )
        losses = iter(torch.where(torch.isfinite(found.loss), found.loss, torch.nan).tolist())
        return [float("nan") if pose is None else next(losses) for pose in poses]

    def _optimizer(self) -> TrajectoryOptimizer:
        """The optimiser of the run's search, without pruning."""
        for phase in self.planner.phases:
            optimizer = getattr(phase, "optimizer", None)
            if isinstance(optimizer, TrajectoryOptimizer):
                return dataclasses.replace(optimizer, pruner=PrunerNone(), patience=optimizer.iterations)
        raise InputError("strategy", came="one without a descent", expected="one with a descent, such as cpdeform")
