"""A stage of the run record as an HDF5 file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import h5py
import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.placer import Candidate, Proposal
from cpdeform.core.reading.arrays import ArrayFile, open_arrays
from cpdeform.core.reading.arrays_hdf5 import has_attribute, read_attribute, read_texts
from cpdeform.core.reading.json_text import parse_json
from cpdeform.core.reading.limits import ReadingLimits
from cpdeform.core.state import State
from cpdeform.planning.result import StageResult, Status
from cpdeform.run.migration import array_name
from cpdeform.run.record_files import replacing_hdf5, to_json, write_dataset

MARGIN = 1e-3
"""How far outside of the domain a recorded position may lie for its rounding, length units."""

LENGTH = "length (domain edge = 1)"
POSE_UNITS = "position: length (domain edge = 1); unit quaternion wxyz: 1; gap: length"
STATE_FIELDS = {
    "position": ("world, particle, xyz", LENGTH),
    "velocity": ("world, particle, xyz", "length/second"),
    "affine": ("world, particle, row, column", "1/second"),
    "elastic_strain": ("world, particle, xx yy zz xy xz yz", "1"),
    "tool_pose": ("world, tool, xyz wxyz gap", POSE_UNITS),
}


def write_stage(path: Path, result: StageResult) -> None:
    """Write a stage atomically."""
    with replacing_hdf5(path) as file:
        file.attrs["index"] = result.index
        file.attrs["status"] = result.status.value
        file.attrs["best"] = -1 if result.best is None else result.best
        file.attrs["loss_before"] = result.loss_before
        file.attrs["loss"] = result.loss
        file.attrs["gradient_evaluations"] = result.gradient_evaluations
        file.attrs["rollouts"] = result.rollouts
        file.attrs["seconds"] = json.dumps(to_json(result.seconds))
        for name, state in (("state_before", result.state_before), ("state", result.state)):
            group = file.create_group(name)
            for field, (shape, units) in STATE_FIELDS.items():
                write_dataset(group, field, getattr(state, field), shape=shape, units=units)
        write_dataset(
            file,
            "priorities",
            result.priorities,
            shape="particle",
            units="transport cost of a potential (length for p = 1), length of a displacement",
        )
        if result.candidates:
            _write_candidates(file.create_group("placements"), result.candidates)
        if result.actions is not None and result.positions is not None and result.tool_poses is not None:
            write_dataset(file, "actions", result.actions, shape="step, action", units="1, in [-1, 1]")
            write_dataset(file, "positions", result.positions.float(), shape="time (step + 1), particle, xyz", units=LENGTH)
            write_dataset(file, "tool_poses", result.tool_poses, shape="time (step + 1), tool, xyz wxyz gap", units=POSE_UNITS)


def _write_candidates(group: h5py.Group, candidates: tuple[Candidate, ...]) -> None:
    placements = [candidate.proposal for candidate in candidates]
    particles = [-1 if placement.contact_particle is None else placement.contact_particle for placement in placements]
    write_dataset(
        group, "pose", torch.stack([item.pose for item in placements]), shape="candidate, tool, xyz wxyz gap", units=POSE_UNITS
    )
    actions = torch.stack([candidate.actions for candidate in candidates])
    write_dataset(group, "actions", actions, shape="candidate, step, action", units="1, in [-1, 1]")
    numbers = {
        "score": ([placement.score for placement in placements], "transport cost (length for p = 1)"),
        "loss": ([candidate.loss for candidate in candidates], "objective"),
    }
    for name, (values, units) in numbers.items():
        write_dataset(group, name, torch.tensor(values, dtype=torch.float64), shape="candidate", units=units)
    write_dataset(group, "contact_particle", torch.tensor(particles), shape="candidate", units="index of a particle, -1 for none")
    labels = group.create_dataset("label", data=[placement.label for placement in placements], dtype=h5py.string_dtype())
    labels.attrs["shape"], labels.attrs["units"] = "candidate", "text"


def read_stage(
    path: Path, *, argument: str | None = None, sizes: Mapping[str, int] | None = None, limits: ReadingLimits | None = None
) -> StageResult:
    """Read a stage; its `history` is empty, since ``metrics.jsonl`` holds the iterations.

    Args:
        path: The file.
        argument: What it is, for messages; defaults to its path.
        sizes: Sizes that are known: particles N, tools M, action components A.
        limits: How large it may be.

    Raises:
        InputError: The file cannot be read, or a part is missing or is not what a stage has.
    """
    argument = argument or f"stage {path}"
    with open_arrays(path, argument=argument, expected="a stage of a run record", limits=limits, sizes=sizes) as file:
        state_before, state = _read_state(file, "state_before"), _read_state(file, "state")
        candidates = _read_candidates(file) if "placements" in file else ()
        best, poses = read_attribute(file, "best", int), array_name(file, "tool_poses")
        result = StageResult(
            index=read_attribute(file, "index", int),
            status=Status(read_attribute(file, "status", str)),
            state_before=state_before,
            state=state,
            priorities=_tensor(file, "priorities", ("N",), finite=False),
            candidates=candidates,
            best=None if best < 0 else best,
            actions=_tensor(file, "actions", ("T", "A")) if "actions" in file else None,
            positions=_positions(file, "positions", ("T + 1", "N", 3)) if "positions" in file else None,
            tool_poses=_tensor(file, poses, ("T + 1", "M", 8)) if poses in file else None,
            loss_before=read_attribute(file, "loss_before", float),
            loss=read_attribute(file, "loss", float),
            gradient_evaluations=read_attribute(file, "gradient_evaluations", int),
            history=(),
            seconds=_read_seconds(file),
            rollouts=read_attribute(file, "rollouts", int) if has_attribute(file, "rollouts") else 0,
        )
    _check_stage(result, argument)
    return result


def _tensor(file: ArrayFile, name: str, shape: Sequence[int | str], *, kinds: str = "f", finite: bool = True) -> Tensor:
    return torch.from_numpy(file.read(name, shape=shape, kinds=kinds, finite=finite))


def _positions(file: ArrayFile, name: str, shape: Sequence[int | str]) -> Tensor:
    """Read positions; simulators keep clay in the unit cube, and index their grids by where it is."""
    positions = _tensor(file, name, shape)
    if positions.numel() and not (float(positions.min()) > -MARGIN and float(positions.max()) < 1.0 + MARGIN):
        came = f"positions from {float(positions.min()):.4g} to {float(positions.max()):.4g}"
        raise InputError(f"{file.argument}: {name}", came=came, expected="positions in the domain, from 0 to 1")
    return positions


def _read_state(file: ArrayFile, name: str) -> State:
    return State(
        position=_positions(file, f"{name}/position", (1, "N", 3)),
        velocity=_tensor(file, f"{name}/velocity", (1, "N", 3)),
        affine=_tensor(file, f"{name}/affine", (1, "N", 3, 3)),
        elastic_strain=_tensor(file, f"{name}/elastic_strain", (1, "N", 6)),
        tool_pose=_tensor(file, array_name(file, f"{name}/tool_pose"), (1, "M", 8)),
    )


def _read_candidates(file: ArrayFile) -> tuple[Candidate, ...]:
    poses = _tensor(file, "placements/pose", ("C", "M", 8))
    actions = _tensor(file, "placements/actions", ("C", "T", "A"))
    score, loss = (_tensor(file, f"placements/{name}", ("C",), finite=False).tolist() for name in ("score", "loss"))
    particles = _tensor(file, "placements/contact_particle", ("C",), kinds="iu").tolist()
    count = file.header("priorities").shape[0]
    if any(not -1 <= particle < count for particle in particles):
        argument = f"{file.argument}: placements/contact_particle"
        raise InputError(argument, came=f"{min(particles)} to {max(particles)}", expected=f"-1 to {count - 1}")
    labels = read_texts(file, "placements/label", count=len(poses))
    return tuple(
        Candidate(Proposal(pose, score, label, None if particle < 0 else particle), loss, plan)
        for pose, plan, score, loss, particle, label in zip(poses, actions, score, loss, particles, labels, strict=True)
    )


def _read_seconds(file: ArrayFile) -> dict[str, float]:
    argument = f"{file.argument}: seconds"
    seconds = parse_json(read_attribute(file, "seconds", str), argument=argument)
    if not isinstance(seconds, dict) or not all(type(value) in (int, float) for value in seconds.values()):
        raise InputError(argument, came=type(seconds).__name__, expected="a number of seconds for each part")
    return seconds


def _check_stage(stage: StageResult, argument: str) -> None:
    """Raise `InputError` where parts of a stage that are right by themselves do not fit together."""
    if min(stage.index, stage.gradient_evaluations, stage.rollouts) < 0:
        came = f"index {stage.index}, gradient_evaluations {stage.gradient_evaluations}, rollouts {stage.rollouts}"
        raise InputError(argument, came=came, expected="numbers of at least 0")
    if stage.best is not None and stage.best >= len(stage.candidates):
        raise InputError(f"{argument}: best", came=str(stage.best), expected=f"one of {len(stage.candidates)} candidates")
    plan = (stage.actions, stage.positions, stage.tool_poses)
    if stage.status.executed and any(part is None for part in plan):
        raise InputError(argument, came="a finished stage without a plan", expected="actions, positions, tool_poses and best")
    if stage.actions is not None and stage.positions is not None and len(stage.positions) != len(stage.actions) + 1:
        came = f"{len(stage.positions)} times for {len(stage.actions)} steps"
        raise InputError(f"{argument}: positions", came=came, expected="one time more than steps")
