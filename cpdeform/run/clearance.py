"""Least clearances of a recorded plan: what a robot that executes it would have to keep free."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Iterator, Sequence

import torch
from torch import Tensor

from cpdeform.core.rotation import rotate
from cpdeform.core.scene import Scene, Tool
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.tool_surface import ToolSurfaces, surface_points
from cpdeform.planning.result import StageResult
from cpdeform.run.record_reader import RunRecord

WAY_STEPS = 16
"""Poses that each of the three parts of a way is looked at in."""

WAY_POSES = 3 * WAY_STEPS
"""Poses of a whole way."""

WAY_HEIGHT = 0.02
"""How far above the clay tools pass over it, length units."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Clearances:
    """The least distances of a plan, length units; negative where bodies overlap, None where there is nothing to keep from.

    Attributes:
        clearance_start: Between the tools and the clay where a stage begins.
        clearance_tools: Between the tools, over all steps.
        clearance_floor: Height of the tools' surfaces above the lowest particle of the run's clay, over all steps.
        clearance_way: Between the tools and the clay on the way from one stage's end to the next one's start: straight up, over
            the clay, and straight down. Where a stage ends in contact it is zero or less.
    """

    clearance_start: float | None
    clearance_tools: float | None
    clearance_floor: float | None
    clearance_way: float | None


def measure_clearances(record: RunRecord) -> Clearances:
    """The least clearances of all executed stages of a run.

    Tools that do not move count as something to keep from, not as something that has to.

    Args:
        record: The run.
    """
    stages = [stage for stage in record.stages if stage.tool_poses is not None and stage.positions is not None]
    if not stages:
        return Clearances(clearance_start=None, clearance_tools=None, clearance_floor=None, clearance_way=None)
    scene = record.task.scene
    floor = min(float(stage.state_before.position[0, :, 1].min()) for stage in stages)
    surfaces, movable = ToolSurfaces(scene), [index for index, tool in enumerate(scene.tools) if tool.movable]
    paths = torch.cat([_executed(stage)[1] for stage in stages])
    return Clearances(
        clearance_start=min(_at_the_starts(scene, stages), default=None),
        clearance_tools=_least(surfaces.gaps(index, paths) for index in movable),
        clearance_floor=_least(surfaces.lowest(index, paths) - floor for index in movable),
        clearance_way=min(_on_the_way(scene, stages), default=None),
    )


def way(tool: Tool, end: Tensor, start: Tensor, clay: Tensor) -> Tensor:
    """Poses (`WAY_POSES`, 8) on the way from one stage's end to the next one's start: up, over the clay, down.

    Args:
        tool: The tool.
        end: Where it is (8,).
        start: Where it has to be (8,); it turns while it is above the clay.
        clay: Particles (N, 3), length units.
    """
    surface = rotate(end[3:7], surface_points(tool).to(end))
    half = float(surface.norm(dim=-1).max())
    height = max(float(clay[:, 1].max()) + half + WAY_HEIGHT, float(end[1]), float(start[1]))
    above, over = end.clone(), start.clone()
    above[1] = over[1] = min(height, 1.0)
    share = torch.linspace(0.0, 1.0, WAY_STEPS, dtype=end.dtype)[:, None]
    across = torch.where(share < 0.5, above, over)
    across[:, :3] = (1.0 - share) * above[:3] + share * over[:3]
    return torch.cat([(1.0 - share) * end + share * above, across, (1.0 - share) * over + share * start])


def _executed(stage: StageResult) -> tuple[Tensor, Tensor]:
    """Particles (T+1, N, 3) and tool poses (T+1, M, 8) of an executed stage, float64."""
    assert stage.positions is not None
    assert stage.tool_poses is not None
    return stage.positions.double(), stage.tool_poses.double()


def _movable(scene: Scene, poses: Tensor) -> list[tuple[Tool, Tensor]]:
    """The movable tools with their poses (8,) out of (M, 8)."""
    return [(tool, poses[index]) for index, tool in enumerate(scene.tools) if tool.movable]


def _to_clay(tool: Tool, pose: Tensor, clay: Tensor) -> float:
    return float(signed_distance(tool, pose, clay).min())


def _least(distances: Iterable[Tensor]) -> float | None:
    """The least of all numbers; None where there is none."""
    return min((float(found.min()) for found in distances if found.numel()), default=None)


def _at_the_starts(scene: Scene, stages: Sequence[StageResult]) -> Iterator[float]:
    """Distance of each movable tool from the clay where each stage begins."""
    for stage in stages:
        clay, poses = _executed(stage)
        for tool, pose in _movable(scene, poses[0]):
            yield _to_clay(tool, pose, clay[0])


def _on_the_way(scene: Scene, stages: Sequence[StageResult]) -> Iterator[float]:
    """Least distance from the clay of each movable tool between each stage and the next."""
    for stage, after in itertools.pairwise(stages):
        clay, ends = _executed(stage)
        _, starts = _executed(after)
        pairs = zip(_movable(scene, ends[-1]), _movable(scene, starts[0]), strict=True)
        for (tool, end), (_, start) in pairs:
            for pose in way(tool, end, start, clay[-1]):
                yield _to_clay(tool, pose, clay[-1])
