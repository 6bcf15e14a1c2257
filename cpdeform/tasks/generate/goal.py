"""Random goals for the scenes of tasks: always at rest, and the same for the same seed, bit for bit.

Seeds below 1000 are for tuning a method, those from 1000 on for reporting only: what a method was tuned on says nothing about it.
"""

from __future__ import annotations

import dataclasses
import math
import zlib
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from cpdeform.core.errors import InputError
from cpdeform.core.goal import write_goal
from cpdeform.core.meshes.filling import fill_evenly
from cpdeform.core.plugins import AUTO, Registry, load_registry
from cpdeform.core.scene import Scene
from cpdeform.core.simulator import Simulator
from cpdeform.core.task import Task
from cpdeform.planning.rest import rest, rest_scene, rest_state, settle_goal
from cpdeform.tasks.generate.layouts import is_rope, random_cubes, random_rope
from cpdeform.tasks.generate.motions import dent_motion, pen_motion, script_motion
from cpdeform.tasks.generate.random_solids import random_solid
from cpdeform.tasks.scripts import Leg, perform_state
from cpdeform.tasks.single_stage import SCRIPTS

FIRST_REPORTING_SEED = 1000
"""Seeds from here on are for reporting only."""

KEPT_IOU = 0.9
"""Volume IoU with itself, let go as clay, that a solid has at least; one that sags is drawn again."""

ATTEMPTS = 20


@dataclasses.dataclass(frozen=True, kw_only=True)
class GeneratedGoal:
    """A goal.

    Attributes:
        task: Name of the task that it is for.
        seed: Its seed.
        kind: What it is, such as ``"flat heart"`` or ``"the letters LVO"``.
        position: Particles (N, 3), length units, at rest.
        corresponds: Whether particle i is particle i of the clay, moved.
        self_iou: Volume IoU with itself, let go as clay; 1 for what tools have made, which is at rest as it is.
    """

    task: str
    seed: int
    kind: str
    position: NDArray[np.float64]
    corresponds: bool
    self_iou: float

    @property
    def for_reporting(self) -> bool:
        """Whether the seed is one that methods must not be tuned on."""
        return self.seed >= FIRST_REPORTING_SEED

    def write(self, path: Path) -> None:
        """Write the goal file, whose bytes depend on the goal alone.

        Raises:
            InputError: The file cannot be written.
        """
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_goal(path, self.position, corresponds=self.corresponds)
        except OSError as error:
            came = f"a path that cannot be written ({error.strerror or error})"
            raise InputError(f"goal file {path}", came=came, expected="a writable path") from error


def generate_goal(task: Task, *, seed: int, backend: str = AUTO, registry: Registry | None = None) -> GeneratedGoal:
    """Draw a random goal for a task's scene.

    What kind of goal it is follows from the task: a variation of the shipped script for those of a single stage, a bent rope, cubes
    at other places, strokes or letters of a pen, dents of a ball, and for all others a solid of the clay's volume.

    Args:
        task: Its scene is what the goal is for.
        seed: Seeds below 1000 are for tuning, from 1000 on for reporting only.
        backend: Registered name of a simulator that computes in float64; ``"auto"`` is the fastest that is installed.
        registry: Where the name is looked up; defaults to the installed plugins.

    Raises:
        InputError: `seed` is negative, or no goal was found for the scene.
    """
    if seed < 0:
        raise InputError("seed", came=str(seed), expected="0 or more; from 1000 on for reporting only")
    registry = registry or load_registry()
    backend = registry.resolve("simulator", backend, device="cpu")
    base = task.name.rpartition("-")[0] or task.name
    name = task.name if task.name in SCRIPTS else base
    # A stream of its own for each task: seed 3 of one scene has nothing to do with seed 3 of another.
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    maker = _Maker(task.scene, backend, registry)
    kind, position, corresponds, self_iou = maker.make(name, rng)
    return GeneratedGoal(task=task.name, seed=seed, kind=kind, position=position, corresponds=corresponds, self_iou=self_iou)


Drawn = tuple[str, NDArray[np.float64], bool, float]
"""Kind, particles (N, 3), whether they correspond, IoU with itself."""


class _Maker:
    """Draws goals for a scene."""

    def __init__(self, scene: Scene, backend: str, registry: Registry) -> None:
        self._scene, self._backend, self._registry = scene, backend, registry

    def make(self, name: str, rng: np.random.Generator) -> Drawn:
        """A goal for the task of that name."""
        scene, tool = self._scene, self._scene.tools[0] if self._scene.tools else None
        if name in SCRIPTS:
            return self._performed("a variation of the script", script_motion(scene, name, rng))
        if len(scene.bodies) > 1:
            return self._put_down("cubes", random_cubes(scene, rng))
        if is_rope(scene):
            return self._put_down("rope", random_rope(scene, rng))
        if tool is not None and tool.kind == "Capsule":
            return self._performed(*pen_motion(scene, rng))
        if tool is not None and tool.kind == "Sphere" and len(scene.tools) == 1:
            return self._performed(*dent_motion(scene, rng))
        return self._solid(rng)

    def _simulator(self, scene: Scene) -> Simulator:
        options = self._registry.option_names("simulator", self._backend)
        # The sums of several threads differ in the last digits with their number.
        single = {"threads": 1} if options is None or "threads" in options else {}
        made: Simulator = self._registry.create("simulator", self._backend, scene=scene, dtype=torch.float64, **single)
        return made

    def _performed(self, kind: str, legs: list[Leg]) -> Drawn:
        state = perform_state(legs, self._simulator(self._scene))
        found = rest(self._simulator(rest_scene(self._scene)), rest_state(state, self._scene))
        if not bool(torch.isfinite(found.state.position).all()):
            remedy = "Use more particles: thin clay breaks under a tool."
            raise InputError("scene", came="clay that a simulated motion blew up", expected="clay that stays finite", remedy=remedy)
        return kind, np.asarray(found.state.position[0].numpy()), True, 1.0

    def _put_down(self, kind: str, position: NDArray[np.float64]) -> Drawn:
        goal = settle_goal(self._simulator(rest_scene(self._scene)), torch.as_tensor(position))
        return kind, np.asarray(goal.position.numpy()), True, goal.self_iou

    def _solid(self, rng: np.random.Generator) -> Drawn:
        for _ in range(ATTEMPTS):
            kind, solid = random_solid(self._scene, rng)
            position = fill_evenly(solid, self._scene.particle_count)
            goal = settle_goal(self._simulator(rest_scene(self._scene)), torch.as_tensor(position))
            if goal.rests and goal.self_iou >= KEPT_IOU and math.isfinite(goal.drop):
                return kind, np.asarray(goal.position.numpy()), False, goal.self_iou
        raise InputError(
            "scene",
            came=f"clay that sags in {ATTEMPTS} shapes",
            expected="clay that keeps its shape",
            remedy="Use more particles, or clay with a higher yield stress.",
        )
