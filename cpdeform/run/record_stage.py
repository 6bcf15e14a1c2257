"""A stage of the run record as an HDF5 file."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import h5py
import torch
from torch import Tensor

from cpdeform.core.placer import Candidate, Proposal
from cpdeform.core.state import State
from cpdeform.planning.result import StageResult, Status
from cpdeform.run.record_files import read_tensor, replacing, to_json, write_dataset

LENGTH = "length (domain edge = 1)"
POSE_UNITS = "position: length (domain edge = 1); unit quaternion wxyz: 1; gap: length"
STATE_FIELDS = {
    "position": ("world, particle, xyz", LENGTH),
    "velocity": ("world, particle, xyz", "length/second"),
    "affine": ("world, particle, row, column", "1/second"),
    "elastic_strain": ("world, particle, xx yy zz xy xz yz", "1"),
    "manipulator_pose": ("world, tool, xyz wxyz gap", POSE_UNITS),
}


def write_stage(path: Path, result: StageResult) -> None:
    """Write a stage atomically."""
    with replacing(path) as temporary, h5py.File(temporary, "w") as file:
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
        if result.actions is not None and result.positions is not None and result.manipulator_poses is not None:
            write_dataset(file, "actions", result.actions, shape="step, action", units="1, in [-1, 1]")
            write_dataset(file, "positions", result.positions.float(), shape="time (step + 1), particle, xyz", units=LENGTH)
            write_dataset(
                file, "manipulator_poses", result.manipulator_poses, shape="time (step + 1), tool, xyz wxyz gap", units=POSE_UNITS
            )


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


def read_stage(path: Path) -> StageResult:
    """Read a stage; its `history` is empty, since ``metrics.jsonl`` holds the iterations.

    Raises:
        OSError: The file cannot be read.
        KeyError: A part is missing.
    """
    with h5py.File(path, "r") as file:
        best = int(file.attrs["best"])
        return StageResult(
            index=int(file.attrs["index"]),
            status=Status(file.attrs["status"]),
            state_before=_read_state(file["state_before"]),
            state=_read_state(file["state"]),
            priorities=read_tensor(file, "priorities"),
            candidates=_read_candidates(file["placements"]) if "placements" in file else (),
            best=None if best < 0 else best,
            actions=_read_optional(file, "actions"),
            positions=_read_optional(file, "positions"),
            manipulator_poses=_read_optional(file, "manipulator_poses"),
            loss_before=float(file.attrs["loss_before"]),
            loss=float(file.attrs["loss"]),
            gradient_evaluations=int(file.attrs["gradient_evaluations"]),
            history=(),
            seconds=json.loads(file.attrs["seconds"]),
            rollouts=int(file.attrs.get("rollouts", 0)),
        )


def _read_state(group: h5py.Group) -> State:
    return State(**{field.name: read_tensor(group, field.name) for field in dataclasses.fields(State)})


def _read_optional(file: h5py.File, name: str) -> Tensor | None:
    return read_tensor(file, name) if name in file else None


def _read_candidates(group: h5py.Group) -> tuple[Candidate, ...]:
    poses, actions = read_tensor(group, "pose"), read_tensor(group, "actions")
    labels = group["label"].asstr()[()]
    rows = zip(poses, actions, group["score"][()], group["loss"][()], group["contact_particle"][()], labels, strict=True)
    return tuple(
        Candidate(Proposal(pose, float(score), str(label), None if particle < 0 else int(particle)), float(loss), plan)
        for pose, plan, score, loss, particle, label in rows
    )
