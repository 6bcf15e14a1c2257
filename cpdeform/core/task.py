"""Tasks: a scene, a goal and a schedule, read from YAML files."""

from __future__ import annotations

import importlib.resources
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from cpdeform.core.bounded import MOST_STAGES, MOST_STEPS, Name, Whole
from cpdeform.core.errors import InputError, PluginError, UnknownNameError
from cpdeform.core.goal import load_correspondence, load_goal, load_goal_grid, write_goal_points
from cpdeform.core.old_names import current_scene, current_task
from cpdeform.core.plugins import Registry, describe, load_registry, redirect_prints
from cpdeform.core.reading.models import validate
from cpdeform.core.reading.yaml_text import read_yaml
from cpdeform.core.scene import FrozenModel, Scene

__all__ = [
    "Task",
    "changed_task",
    "limited_task",
    "list_variants",
    "load_goal",
    "load_task",
    "merge",
    "read_task",
    "task_path",
    "validate",
]


class Task(FrozenModel):
    """A shape to be made.

    Attributes:
        name: Name with variant, e.g. ``"writer-v2"``.
        summary: One line for listings.
        scene: What is simulated.
        goal: File of the goal particles, see `load_goal`.
        step_count: Environment steps T of one stage in which the tools act.
        rest_steps: Environment steps that follow, in which the tools hold still. The shape is judged when they are over: clay that
            was pushed slides on, and a shape that is right only in passing is no result.
        stage_count: Number of stages that the task is meant for.
        metric: What the result is judged by.
        limits: Physical limits that plans keep to, such as slower tools: changes of the scene, nested as `merge` takes them. The
            scene itself stays the benchmark's; see `limited_task`.
    """

    name: Name
    summary: str = Field(default="", max_length=10_000)
    scene: Scene
    goal: Path
    step_count: Whole = Field(default=10, ge=1, le=MOST_STEPS)
    rest_steps: Whole = Field(default=0, ge=0, le=MOST_STEPS)
    stage_count: Whole = Field(default=1, ge=1, le=MOST_STAGES)
    metric: Literal["incremental_iou", "wasserstein"] = "wasserstein"
    limits: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _take_old_names(cls, content: Any) -> Any:
        return current_task(content)

    @classmethod
    def from_points(
        cls, points: ArrayLike, *, scene: Scene | str, path: Path | str, name: str | None = None, **fields: Any
    ) -> Task:
        """A task whose goal is a cloud of points.

        Args:
            points: Goal particles (M, 3) in the scene's domain, length units; M need not be the clay's number of particles.
            scene: The scene, or the name of a task that has it.
            path: The goal file (.npz) to write.
            name: Name of the task; defaults to the file's.
            fields: Other fields of `Task`, such as ``step_count``.

        Raises:
            InputError: The points are not finite (M, 3) or not in the domain, or a field does not fit.

        Example:
            A plate, by points at random:

            >>> import numpy as np
            >>> points = np.random.default_rng(0).uniform((0.3, 0.05, 0.3), (0.7, 0.1, 0.7), (500, 3))
            >>> task = Task.from_points(points, scene="pinch", path="plate.npz", stage_count=3)
            >>> task.name, task.stage_count, task.load_goal().shape
            ('plate', 3, (500, 3))
        """
        found, path = load_task(scene).scene if isinstance(scene, str) else scene, Path(path)
        write_goal_points(path, np.asarray(points, dtype=np.float64), scene=found)
        content = {"name": name or path.stem, "scene": found, "goal": path, **fields}
        return validate(cls, content, source=f"task {content['name']}")

    @classmethod
    def from_mesh(
        cls,
        mesh: Path | str,
        *,
        scene: Scene | str,
        path: Path | str,
        up: Literal["x", "y", "z"] | None = None,
        name: str | None = None,
        **fields: Any,
    ) -> Task:
        """A task whose goal is the shape of a mesh: scaled to the clay's volume, standing where the clay is, filled evenly.

        Args:
            mesh: An STL, OBJ, PLY or GLB file; see `cpdeform.core.meshes.reading.read_mesh` for what is repaired and what refused.
            scene: The scene, or the name of a task that has it.
            path: The goal file (.npz) to write.
            up: The axis that points upwards in the mesh's file; defaults to z for STL and PLY, y for OBJ and GLB.
            name: Name of the task; defaults to the goal file's.
            fields: Other fields of `Task`, such as ``step_count``.

        Raises:
            InputError: The mesh cannot be used, or does not fit into the domain at the clay's volume.
            MissingExtraError: The extra `meshes` is not installed.

        Example:
            The goal has as many particles as the clay and stands on the floor where the clay is:

            >>> import trimesh
            >>> _ = trimesh.creation.cylinder(radius=2.0, height=1.0).export("coin.stl")
            >>> task = Task.from_mesh("coin.stl", scene="pinch", path="coin.npz")
            >>> len(task.load_goal()) == task.scene.particle_count
            True
        """
        from cpdeform.core.meshes.goal import mesh_goal
        from cpdeform.core.meshes.reading import read_mesh

        found = load_task(scene).scene if isinstance(scene, str) else scene
        shape, _ = read_mesh(Path(mesh), up=up)
        points = mesh_goal(shape, found, argument=f"mesh {mesh}")
        return cls.from_points(points, scene=found, path=path, name=name, **fields)

    @property
    def rollout_steps(self) -> int:
        """Environment steps of one stage, action and rest together."""
        return self.step_count + self.rest_steps

    def load_goal(self) -> NDArray[np.float64]:
        """Read the goal particles.

        Returns:
            Positions (M, 3), length units.

        Raises:
            InputError: The file is missing or unreadable, or holds something else than finite positions in the domain.
        """
        return load_goal(self.goal, scene=self.scene)

    def load_goal_grid(self) -> NDArray[np.float64] | None:
        """Read the goal's own node masses, if its file holds them, as one imported from a grid does.

        Returns:
            Node masses (G, G, G); None where the goal is given by its particles alone.

        Raises:
            InputError: The file is missing or unreadable, or the masses do not fit the scene's grid.
        """
        return load_goal_grid(self.goal, scene=self.scene)

    def goal_corresponds(self) -> bool:
        """Whether the goal's file says that its particles are the body's, one to one, moved, and their number does not deny it.

        Raises:
            InputError: The file is missing or unreadable.
        """
        return load_correspondence(self.goal) and len(self.load_goal()) == self.scene.particle_count


def merge(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Overlay nested mappings; a list is changed entry by entry where `changes` maps indices to changes."""
    result = dict(base)
    for key, value in changes.items():
        current = result.get(key)
        if isinstance(value, Mapping) and isinstance(current, Mapping):
            result[key] = merge(current, value)
        elif isinstance(value, Mapping) and isinstance(current, (list, tuple)):
            result[key] = _merge_list(key, current, value)
        else:
            result[key] = value
    return result


def _merge_list(name: str, base: list[Any] | tuple[Any, ...], changes: Mapping[str, Any]) -> list[Any]:
    items = list(base)
    for key, value in changes.items():
        digits = str(key)
        index = int(digits) if digits.isascii() and digits.isdigit() and len(digits) < 10 else -1
        if not 0 <= index < len(items):
            raise InputError(f"{name}.{key}", came=f'"{key}"', expected=f"an index from 0 to {len(items) - 1}")
        items[index] = merge(items[index], value) if isinstance(value, Mapping) and isinstance(items[index], Mapping) else value
    return items


def _read_mapping(path: Path) -> dict[str, Any]:
    """Content of a task file, not validated beyond being a mapping."""
    argument = f"task file {path}"
    content = read_yaml(path, argument=argument)
    if not isinstance(content, dict):
        raise InputError(argument, came=type(content).__name__, expected="a mapping with the fields of a task")
    try:
        renamed: dict[str, Any] = current_task(content)
    except InputError as error:
        raise InputError(f"{argument}: {error.argument}", came=error.came, expected=error.expected, remedy=error.remedy) from error
    return renamed


def read_task(path: Path, *, variant: str | None = None) -> Task:
    """Read a task file.

    The file holds the fields of `Task`; a relative `goal` is relative to the file. Under `variants`, names map to changes of
    these fields; without a variant's name the first one applies.

    Args:
        path: A YAML file.
        variant: Name of a variant.

    Raises:
        InputError: The file is missing, is not YAML, or has a field that is unknown, missing or out of range.
        UnknownNameError: There is no such variant.
    """
    content = _read_mapping(path)
    if "settings" in content:
        raise InputError(
            f"task file {path}: settings",
            came="settings of a run",
            expected="scene, goal and schedule alone",
            remedy="Give them with --set or in a strategy; limits of the tools go under `limits`.",
        )
    variants = content.pop("variants", None) or {}
    if not isinstance(variants, dict):
        raise InputError(f"task file {path}: variants", came=type(variants).__name__, expected="a mapping of names to changes")
    variants = {str(key): changes or {} for key, changes in variants.items()}
    base = content.get("name", path.stem)
    if variant is None and variants:
        variant = next(iter(variants))
    if variant is not None:
        if variant not in variants:
            raise UnknownNameError(f"variant of task {base}", variant, variants)
        if not isinstance(variants[variant], dict):
            came = type(variants[variant]).__name__
            raise InputError(f"task file {path}: variants.{variant}", came=came, expected="a mapping of fields to changes")
        content = merge(content, variants[variant])
        content["name"] = f"{base}-{variant}"
    content.setdefault("name", base)
    return validate(Task, beside(content, path.parent), source=f"task file {path}")


def beside(content: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Fields of a task whose files, where they are relative, lie in a folder: the goal's, and those of shapes from meshes."""
    result = dict(content)
    if isinstance(result.get("goal"), str):
        result["goal"] = folder / result["goal"]
    if isinstance(result.get("scene"), Mapping):
        scene = dict(result["scene"])
        for name in ("bodies", "tools"):
            if isinstance(scene.get(name), (list, tuple)):
                scene[name] = [_shape_beside(item, folder) for item in scene[name]]
        result["scene"] = scene
    return result


def _shape_beside(item: Any, folder: Path) -> Any:
    return {**item, "file": folder / item["file"]} if isinstance(item, Mapping) and isinstance(item.get("file"), str) else item


def limited_task(task: Task) -> Task:
    """The task with its limits on the scene in force; `limits` is empty then.

    Raises:
        InputError: A limit does not fit the scene.
    """
    if not task.limits:
        return task
    content = task.model_dump(exclude={"limits"})
    return validate(Task, merge(content, {"scene": task.limits}), source=f"task {task.name}: limits")


def changed_task(
    task: Task,
    *,
    scene: Mapping[str, Any] | None = None,
    goal: Path | None = None,
    step_count: int | None = None,
    rest_steps: int | None = None,
) -> Task:
    """The task with changes.

    Args:
        task: The task.
        scene: Changes of its scene, nested as `merge` takes them.
        goal: Another file of its goal.
        step_count: Another number of environment steps of a stage.
        rest_steps: Another number of steps of rest after them.

    Raises:
        InputError: A change does not fit.
    """
    changes = {"scene": current_scene(scene) or None, "goal": goal, "step_count": step_count, "rest_steps": rest_steps}
    changes = {field: change for field, change in changes.items() if change is not None}
    if not changes:
        return task
    return validate(Task, merge(task.model_dump(), changes), source=f"task {task.name} with --set")


def list_variants(path: Path) -> list[str]:
    """Names of the variants in a task file, in its order.

    Raises:
        InputError: The file is missing or is no YAML mapping.
    """
    content = _read_mapping(path)
    variants = content.get("variants") or {}
    return [str(name) for name in variants] if isinstance(variants, dict) else []


def task_path(name: str, *, registry: Registry) -> Path:
    """Path of a registered task's file.

    Raises:
        UnknownNameError: No plugin registers the name.
        PluginError: The plugin's package cannot be imported.
    """
    package, _, file = registry.find("task", name).spec.target.partition(":")
    try:
        with redirect_prints():
            return Path(str(importlib.resources.files(package) / file))
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise PluginError(f'task "{name}": cannot import {package}: {describe(error)}') from error


def load_task(name: str | Path, *, registry: Registry | None = None) -> Task:
    """Load a task by name (``"writer"``, ``"writer-v3"``) or from a YAML file (``"my_vase.yaml"``).

    Args:
        name: Registered name, with a variant or without (then the first variant), or path of a YAML file.
        registry: Where to look names up; defaults to the installed plugins.

    Raises:
        UnknownNameError: No plugin registers the name.
        InputError: The file cannot be used.
    """
    if isinstance(name, Path) or name.endswith((".yaml", ".yml")):
        return read_task(Path(name))
    registry = registry or load_registry()
    known = registry.names("task")
    base, dash, variant = name.rpartition("-")
    if name not in known and dash and base in known:
        return read_task(task_path(base, registry=registry), variant=variant)
    return read_task(task_path(name, registry=registry))
