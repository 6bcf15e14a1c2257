"""Least clearances of a recorded plan: what a robot that executes it would have to keep free."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable, Iterator, Sequence

import torch
from torch import Tensor

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

WAY_SIDE = 0.08
"""How far a tool goes aside before it rises, where it would scrape along the clay otherwise, length units."""

WAY_DIRECTIONS = 8
"""Horizontal directions to go aside that are looked at."""

WORTH_GOING_ASIDE = 1e-3
"""How much farther from the clay a tool has to keep by going aside for not to rise straight, length units."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Clearances:
    """The least distances of a plan, length units; negative where bodies overlap, None where there is nothing to keep from.

    Attributes:
        clearance_start: Between the tools and the clay where a stage begins.
        clearance_tools: Between the tools, over all steps.
        clearance_floor: Height of the tools' surfaces above the lowest particle of the run's clay, over all steps.
        clearance_way: Between the tools and the clay on the way from one stage's end to the next one's start; see `way`. A tool
            that ends in contact has to leave the clay first: that does not count, unless it goes deeper on its way out.
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

    A tool that would scrape along the clay goes aside first, the way that keeps it farthest from the clay, and comes down beside
    its place in the same manner.

    Args:
        tool: The tool.
        end: Where it is (8,).
        start: Where it has to be (8,); it turns while it is above the clay.
        clay: Particles (N, 3), length units.
    """
    height = min(max(float(clay[:, 1].max()) + _radius(tool) + WAY_HEIGHT, float(end[1]), float(start[1])), 1.0)
    up, down = (_rising(tool, pose, height, clay) for pose in (end, start))
    share = torch.linspace(0.0, 1.0, WAY_STEPS, dtype=end.dtype)[:, None]
    across = torch.where(share < 0.5, up[-1], down[-1])
    across[:, :3] = (1.0 - share) * up[-1, :3] + share * down[-1, :3]
    return torch.cat([up, across, down.flip(0)])


def _rising(tool: Tool, pose: Tensor, height: float, clay: Tensor) -> Tensor:
    """Poses (`WAY_STEPS`, 8) from one beside the clay up to a height: straight, or aside first where that keeps farther off."""
    # A leg goes straight up at most `WAY_SIDE` from here; clay that is farther off cannot be what decides between legs.
    beside = clay[(clay[:, ::2] - pose[:3:2]).norm(dim=-1) < _radius(tool) + 2.0 * WAY_SIDE]
    share = torch.linspace(0.0, 1.0, WAY_STEPS, dtype=pose.dtype)
    best = pose.repeat(WAY_STEPS, 1)
    best[:, 1] += share * (height - pose[1])
    if not len(beside):
        return best
    farthest = _least_to_clay(tool, best[1:], beside) + WORTH_GOING_ASIDE
    for number in range(WAY_DIRECTIONS):
        angle = 2.0 * math.pi * number / WAY_DIRECTIONS
        leg = pose.repeat(WAY_STEPS, 1)
        aside = WAY_SIDE * (3.0 * share).clamp(max=1.0)
        leg[:, 0] += math.cos(angle) * aside
        leg[:, 2] += math.sin(angle) * aside
        leg[:, 1] += (1.5 * share - 0.5).clamp(min=0.0) * (height - pose[1])
        distance = _least_to_clay(tool, leg[1:], beside)
        if distance > farthest:
            best, farthest = leg, distance
    return best


def _executed(stage: StageResult) -> tuple[Tensor, Tensor]:
    """Particles (T+1, N, 3) and tool poses (T+1, M, 8) of an executed stage, float64."""
    assert stage.positions is not None
    assert stage.tool_poses is not None
    return stage.positions.double(), stage.tool_poses.double()


def _movable(scene: Scene, poses: Tensor) -> list[tuple[Tool, Tensor]]:
    """The movable tools with their poses (8,) out of (M, 8)."""
    return [(tool, poses[index]) for index, tool in enumerate(scene.tools) if tool.movable]


def _radius(tool: Tool) -> float:
    """Distance of a tool's farthest point from its middle, length units."""
    return float(surface_points(tool).norm(dim=-1).max())


def _least_to_clay(tool: Tool, poses: Tensor, clay: Tensor) -> float:
    """Least distance of a tool from the clay over its poses (K, 8)."""
    return min(_to_clay(tool, pose, clay) for pose in poses)


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
            yield _after_contact([_to_clay(tool, pose, clay[-1]) for pose in way(tool, end, start, clay[-1])])


def _after_contact(distances: Sequence[float]) -> float:
    """The least distance of a tool from the clay on its way, once it has left the clay it ended in."""
    free = next((number for number, distance in enumerate(distances) if distance > 0.0), 0)
    leaving = distances[:free]
    return min([*distances[free:], *(leaving if leaving and min(leaving) < leaving[0] else ())])
