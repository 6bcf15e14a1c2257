"""A new task from meshes or a picture: shapes repaired and scaled, a scene around them, a task file with comments."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np

from cpdeform.core.errors import InputError
from cpdeform.core.goal import write_goal_points
from cpdeform.core.meshes.filling import fill_evenly
from cpdeform.core.meshes.goal import fitted_to_clay
from cpdeform.core.meshes.grid import make_grid, write_shape
from cpdeform.core.meshes.mesh import Array, Axis, Mesh
from cpdeform.core.meshes.reading import read_mesh
from cpdeform.core.meshes.relief import PICTURES, Relief, read_relief
from cpdeform.core.scene import Scene
from cpdeform.core.task import Task, read_task
from cpdeform.tasks.new_text import task_text

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_+-]{0,63}")

PARTICLES = 10_000
LONGEST_GOAL = 0.4
TALLEST_GOAL = 0.3
"""Edges of the goal's box that its clay is measured for, where no start says how much clay there is, domain edges."""
LONGEST_START = 0.3
"""Longest edge of a start mesh's box, domain edges."""
LONGEST_TOOL = 0.12
BOARD_HEIGHT = 0.1
DEPTH = 0.035
"""Height of a relief's board and depth of its black, domain edges: as in the task `writer`."""
SUNK = 0.01
"""How far below the lowest clay a tool may reach, domain edges: clay is pressed down a little where it lies."""
FREE = 0.02
"""Room between clay and tools at the start, domain edges."""


@dataclasses.dataclass(frozen=True)
class NewTask:
    """What was made.

    Attributes:
        path: The task file.
        task: The task in it.
        notes: What was repaired and chosen, one sentence each.
    """

    path: Path
    task: Task
    notes: tuple[str, ...]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Request:
    """What a new task is made from.

    Attributes:
        name: Its name, and the beginning of its files' names.
        goal: A mesh, or a picture that becomes a relief in a board.
        start: A mesh that the clay starts as; defaults to a block of the goal's proportions, a board for a picture.
        tool: A mesh that the tool is made from; defaults to two blocks that turn, a pen for a picture.
        up: The axis that points upwards in the meshes; defaults to what is usual in each format.
        folder: Where the files are written; made if missing.
        particles: Number of particles of clay.
        overwrite: Allow files that exist.
    """

    name: str
    goal: Path
    start: Path | None = None
    tool: Path | None = None
    up: Axis | None = None
    folder: Path = Path()
    particles: int = PARTICLES
    overwrite: bool = False

    def file(self, part: str) -> Path:
        """Where a part goes."""
        return self.folder / f"{self.name}{part}"


def new_task(request: Request) -> NewTask:
    """Make a task and its files: ``NAME.yaml``, ``NAME-goal.npz`` and, from meshes, ``NAME-start.npz`` and ``NAME-tool.npz``.

    Args:
        request: What it is made from.

    Raises:
        InputError: A name or file cannot be used, or the goal does not fit into the domain at the clay's volume.
        MissingExtraError: The extra `meshes` is not installed.
    """
    _check(request)
    picture = request.goal.suffix.lower() in PICTURES
    if picture and request.start is not None:
        raise InputError("start", came=str(request.start), expected="none with a picture, whose clay is a board")
    notes: list[str] = []
    relief = read_relief(request.goal) if picture else None
    goal = None if picture else _read(request.goal, request, notes)
    body = _board(relief, request) if relief is not None else _body(goal, request, notes)
    scene = _scene(body, [], request.folder)
    if relief is not None:
        lower = np.subtract(body["position"], 0.5 * np.asarray(body["widths"]))
        points = fill_evenly(Relief(lower, np.asarray(body["widths"]), relief, DEPTH), request.particles)
    else:
        assert goal is not None
        fitted = fitted_to_clay(goal, scene, argument=f"goal {request.goal}")
        notes.append(f"The goal is scaled to the clay's volume: {_size(fitted.extents)} (domain edges).")
        points = fill_evenly(fitted, request.particles)
    tools = _tools(scene, request, notes, pen=picture)
    write_goal_points(request.file("-goal.npz"), points, scene=scene)
    path = request.file(".yaml")
    path.write_text(task_text(request.name, request.goal.name, body, tools, picture=picture), encoding="utf-8")
    return NewTask(path, read_task(path), tuple(notes))


def _check(request: Request) -> None:
    if not NAME.fullmatch(request.name):
        raise InputError("NAME", came=f'"{request.name}"', expected="up to 64 letters, digits, _, + or -, a letter or digit first")
    try:
        request.folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        came = f"{request.folder} ({error.strerror or error})"
        raise InputError("folder", came=came, expected="a directory that can be written") from error
    if not request.overwrite:
        for part in (".yaml", "-goal.npz", "-start.npz", "-tool.npz"):
            if request.file(part).exists():
                remedy = "Take another name, or replace it with --overwrite."
                raise InputError("NAME", came=f"{request.file(part)}, which exists", expected="a new name", remedy=remedy)


def _read(path: Path, request: Request, notes: list[str]) -> Mesh:
    mesh, found = read_mesh(path, up=request.up)
    notes += [f"{path.name}: {note}" for note in found]
    return mesh


def _body(goal: Mesh | None, request: Request, notes: list[str]) -> dict[str, Any]:
    """The clay: a start mesh's shape, or a block of the goal's proportions and volume."""
    if request.start is not None:
        mesh = _read(request.start, request, notes)
        mesh = mesh.scaled(LONGEST_START / float(mesh.extents.max()))
        path = request.file("-start.npz")
        write_shape(path, make_grid(mesh))
        notes.append(f"The clay starts as {request.start.name}, {_size(mesh.extents)} (domain edges).")
        content = {"kind": "mesh", "file": path.name, "position": _standing(mesh.extents)}
        return {**content, "particle_count": request.particles}
    assert goal is not None
    extents = goal.extents
    factor = min(LONGEST_GOAL / float(max(extents[0], extents[2])), TALLEST_GOAL / float(extents[1]))
    widths = factor * extents * (goal.volume() / float(np.prod(extents))) ** (1.0 / 3.0)
    rounded = [round(float(edge), 5) for edge in widths]
    return {"kind": "box", "position": _standing(widths), "widths": rounded, "particle_count": request.particles}


def _board(relief: Array, request: Request) -> dict[str, Any]:
    rows, columns = relief.shape
    longest = LONGEST_GOAL / max(rows, columns)
    widths = [round(columns * longest, 5), BOARD_HEIGHT, round(rows * longest, 5)]
    return {"kind": "box", "position": _standing(np.asarray(widths)), "widths": widths, "particle_count": request.particles}


def _standing(extents: Array) -> list[float]:
    """Centre of a body of these edges that rests on the floor in the middle of the domain."""
    floor = Scene.model_validate({"bodies": [{"kind": "sphere", "position": [0.5] * 3, "radius": 0.1}]}).resting_height
    return [0.5, round(floor + 0.5 * float(extents[1]), 5), 0.5]


def _scene(body: dict[str, Any], tools: list[dict[str, Any]], folder: Path = Path()) -> Scene:
    from cpdeform.core.task import beside

    return Scene.model_validate(beside({"scene": {"bodies": [body], "tools": tools}}, folder)["scene"])


def _tools(scene: Scene, request: Request, notes: list[str], *, pen: bool) -> list[dict[str, Any]]:
    """The tools at their starts: a mesh or a pen above the clay, or a block at either side."""
    body = scene.bodies[0]
    top = body.position[1] + body.half_extents[1] + FREE
    if request.tool is not None:
        mesh = _read(request.tool, request, notes)
        mesh = mesh.scaled(LONGEST_TOOL / float(mesh.extents.max())).centred()
        path = request.file("-tool.npz")
        write_shape(path, make_grid(mesh))
        notes.append(f"The tool is {request.tool.name}, {_size(mesh.extents)} (domain edges).")
        place = [0.5, round(top + 0.5 * float(mesh.extents[1]), 5), 0.5]
        lowest = _above_floor(scene, 0.5 * float(mesh.extents[1]))
        return [{"kind": "Mesh", "file": path.name, "position": place, **lowest, "friction": 0.9, "action_scale": _turning()}]
    if pen:
        place = [0.5, round(top + 0.05, 5), 0.5]
        capsule = {"kind": "Capsule", "radius": 0.02, "height": 0.06, "position": place, **_above_floor(scene, 0.05)}
        return [{**capsule, "friction": 0.0, "action_scale": [0.01, 0.01, 0.01]}]
    half = [0.015, round(max(0.06, body.half_extents[1] + 0.02), 5), 0.05]
    blocks = []
    for side in (-1.0, 1.0):
        x = 0.5 + side * (body.half_extents[0] + FREE + half[0] + 0.01)
        block = {
            "kind": "Box",
            "half_extents": half,
            "rounding": 0.01,
            "position": [round(x, 5), round(body.position[1] + 0.02, 5), 0.5],
            **_above_floor(scene, half[1] + 0.01),
        }
        blocks.append({**block, "friction": 0.9, "action_scale": _turning()})
    return blocks


def _above_floor(scene: Scene, half_height: float) -> dict[str, Any]:
    """Bounds of a tool that stands upright on the floor at the lowest; a hand or an arm would be in the floor below that."""
    return {"lower_bound": [0.0, round(scene.resting_height - SUNK + half_height, 5), 0.0]}


def _turning() -> list[float]:
    return [0.01, 0.01, 0.01, 0.015, 0.015, 0.015]


def _size(extents: Array) -> str:
    return " x ".join(f"{edge:.3g}" for edge in extents)
