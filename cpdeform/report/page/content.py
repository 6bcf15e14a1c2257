"""What the page of a run shows: a JSON document, and arrays that it refers to by name."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from cpdeform.planning.result import StageResult
from cpdeform.report.page.encoding import encode_frames, encode_levels, spatial_order
from cpdeform.report.page.shapes import Array, describe_goal, describe_tools
from cpdeform.report.pictures import CLAY
from cpdeform.report.surface import particle_spacing
from cpdeform.run.clearance import WAY_POSES, way
from cpdeform.run.command import command_of
from cpdeform.run.record import RunRecord
from cpdeform.run.record_files import to_json
from cpdeform.run.resume import recorded_configuration

POSE_DIGITS = 5
WAY_EVERY = 3
"""Of the poses on a way between stages, the page gets every so many."""

PRIORITY_COLOURS = "viridis"
ERROR_COLOURS = ("#e8dcc8", "#f0b27a", "#d1495b", "#6a0f2b")
COLOUR_STOPS = 17


@dataclasses.dataclass(frozen=True)
class Page:
    """The content of a run's page.

    Attributes:
        content: A JSON document.
        arrays: What it refers to, by name; made when it is called, since those of a stage take a while.
    """

    content: dict[str, Any]
    arrays: Mapping[str, Callable[[], bytes]]


@dataclasses.dataclass(frozen=True)
class ReplayedCandidate:
    """What a candidate that lost would have done.

    Attributes:
        number: Its number in the stage.
        positions: Particles (T+1, N, 3), length units.
        poses: Tools (T+1, M, 8).
    """

    number: int
    positions: Array
    poses: Array


def make_page(
    record: RunRecord,
    *,
    figures: Sequence[Mapping[str, Any]] = (),
    replays: Mapping[int, Sequence[ReplayedCandidate]] | None = None,
) -> Page:
    """Gather what the page of a run shows.

    Args:
        record: The run, which may still go on.
        figures: Rows of the table of figures, see `cpdeform.report.page.figures`.
        replays: Candidates that lost and were rolled out, by the number of their stage.
    """
    positions = _start(record)
    order = spatial_order(positions)
    arrays: dict[str, Callable[[], bytes]] = {}
    goal = record.goal.double().numpy()
    names = _stage_names(record)
    stages = [
        _stage(stage, name, order, arrays, (replays or {}).get(stage.index, ()))
        for stage, name in zip(record.stages, names, strict=True)
    ]
    for described, stage, before in zip(stages[1:], record.stages[1:], record.stages, strict=False):
        described["way"] = _way(record, before, stage)
    content = {
        "name": record.task.name,
        "summary": record.task.summary,
        "status": record.status,
        "recorded": record.run.get("recorded_at"),
        "advice": record.run.get("advice", ""),
        "command": command_of(record),
        "particles": len(positions),
        "spacing": particle_spacing(positions),
        "ground": record.task.scene.ground_height,
        "bounds": _bounds(record, positions, goal),
        "colours": _colours(),
        "tools": describe_tools(record.task.scene.tools, arrays),
        "goal": describe_goal(goal, positions, arrays),
        "stages": stages,
        "stageCount": _stage_count(record),
        "curves": [line for line in record.metrics if line.get("kind") == "iteration"],
        "figures": list(figures),
        "facts": _facts(record),
        "configuration": recorded_configuration(record).model_dump(mode="json"),
        "task": record.task.model_dump(mode="json", exclude={"goal"}),
    }
    return Page(to_json(content), arrays)


def _start(record: RunRecord) -> Array:
    """Particles (N, 3) before the first stage."""
    from cpdeform.core.sampling import sample_particles

    if record.stages:
        return np.asarray(record.stages[0].state_before.position[0].double().numpy())
    return np.asarray(sample_particles(record.task.scene))


def _stage_names(record: RunRecord) -> list[str]:
    """What arrays of each stage begin with: another name once the stage has been revised, since arrays are kept by their names."""
    names = []
    for stage in record.stages:
        revisions = sum(
            line.get("kind") == "revision" and line["stage"] - line["stages"] < stage.index <= line["stage"]
            for line in record.metrics
        )
        names.append(f"stage-{stage.index}" + (f"-revision-{revisions}" if revisions else ""))
    return names


def _stage(
    stage: StageResult, name: str, order: Any, arrays: dict[str, Callable[[], bytes]], replays: Sequence[ReplayedCandidate]
) -> dict[str, Any]:
    """Describe a stage, and add its arrays."""
    positions = stage.state_before.position if stage.positions is None else stage.positions
    poses = stage.state_before.tool_pose if stage.tool_poses is None else stage.tool_poses
    arrays[f"{name}-positions"] = lambda: encode_frames(positions.double().numpy()[:, order])
    levels, low, high = encode_levels(stage.priorities.double().numpy()[order])
    known = bool(stage.priorities.isfinite().all())
    if known:
        arrays[f"{name}-priorities"] = lambda: levels
    return {
        "index": stage.index,
        "status": stage.status.value,
        "frames": len(positions),
        "positions": f"{name}-positions",
        "priorities": {"array": f"{name}-priorities", "low": low, "high": high} if known else None,
        "poses": _poses(poses.double().numpy()),
        "lossBefore": stage.loss_before,
        "loss": stage.loss,
        "best": stage.best,
        "candidates": _candidates(stage, name, order, arrays, replays),
        "evaluations": stage.gradient_evaluations,
        "rollouts": stage.rollouts,
        "seconds": stage.seconds,
    }


def _way(record: RunRecord, before: StageResult, stage: StageResult) -> list[Any]:
    """Poses (P, M, 8) of the tools on their way from one stage to the next; empty where they stay."""
    tools = record.task.scene.tools
    if before.tool_poses is None or stage.tool_poses is None or not tools:
        return []
    ends, starts, clay = before.tool_poses[-1].double(), stage.tool_poses[0].double(), stage.state_before.position[0].double()
    ways = [
        way(tool, end, start, clay) if tool.movable else end.expand(WAY_POSES, -1)
        for tool, end, start in zip(tools, ends, starts, strict=True)
    ]
    poses = np.stack(ways, axis=1)
    return _poses(np.concatenate([poses[:-1:WAY_EVERY], poses[-1:]]))


def _candidates(
    stage: StageResult, prefix: str, order: Any, arrays: dict[str, Callable[[], bytes]], replays: Sequence[ReplayedCandidate]
) -> list[dict[str, Any]]:
    """Describe all candidates of a stage; those that were rolled out get positions, the others only the tools' placement."""
    known = {replay.number: replay for replay in replays}
    described = []
    for number, candidate in enumerate(stage.candidates):
        proposal, replay = candidate.proposal, known.get(number)
        entry: dict[str, Any] = {
            "label": proposal.label,
            "score": proposal.score,
            "loss": candidate.loss,
            "poses": _poses(proposal.pose.double().numpy()[None]),
            "positions": None,
            "frames": 1,
        }
        if replay is not None:
            name = f"{prefix}-candidate-{number}"
            arrays[name] = _frames(replay.positions, order)
            entry |= {"poses": _poses(replay.poses), "positions": name, "frames": len(replay.positions)}
        described.append(entry)
    return described


def _frames(positions: Array, order: Any) -> Callable[[], bytes]:
    return lambda: encode_frames(positions[:, order])


def _poses(poses: Array) -> list[Any]:
    rounded: list[Any] = np.round(poses, POSE_DIGITS).tolist()
    return rounded


def _bounds(record: RunRecord, start: Array, goal: Array) -> dict[str, list[float]]:
    """The box that clay and goal are in, length units."""
    clouds = [start, goal, *(stage.state.position[0].double().numpy() for stage in record.stages)]
    everything = np.concatenate(clouds)
    everything = everything[np.isfinite(everything).all(axis=1)]
    return {"low": everything.min(axis=0).tolist(), "high": everything.max(axis=0).tolist()}


def _colours() -> dict[str, list[str]]:
    """Stops of the colour scales, the same as in the pictures."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    stops = np.linspace(0.0, 1.0, COLOUR_STOPS)
    priority = [to_hex(colormaps[PRIORITY_COLOURS](stop)) for stop in stops]
    return {"height": list(CLAY), "priority": priority, "error": list(ERROR_COLOURS)}


def _stage_count(record: RunRecord) -> int:
    planned = recorded_configuration(record).stages or record.task.stage_count
    resumed = record.run.get("resumed_from") or {}
    return int(resumed.get("stages", 0)) + planned


def _facts(record: RunRecord) -> list[list[str]]:
    """Where and how the run was made, as rows of a name and a value."""
    run = record.run
    memory = run.get("memory") or {}
    resumed = run.get("resumed_from")
    facts = {
        "recorded": run.get("recorded_at"),
        **run.get("names", {}),
        "seed": run.get("seed"),
        "seconds": None if run.get("seconds") is None else f"{run['seconds']:.1f}",
        "gradient evaluations": run.get("gradient_evaluations"),
        "rollouts without gradient": run.get("rollouts"),
        "peak memory": None if not memory.get("peak_bytes") else f"{memory['peak_bytes'] / 1e6:.0f} MB, {memory['worlds']} worlds",
        "resumed from": None if not resumed else resumed.get("directory"),
        "machine": f"{run.get('platform')}, {run.get('cpu_count')} cores" if run.get("platform") else None,
        "versions": ", ".join(f"{name} {version}" for name, version in (run.get("versions") or {}).items() if version),
    }
    return [[name, str(value)] for name, value in facts.items() if value not in (None, "")]
