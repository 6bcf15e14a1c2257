"""A scene as plain numbers, for backends whose kernels read arrays and structs."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.errors import InputError
from cpdeform.core.sampling import body_index
from cpdeform.core.scene import WALL_NODES, Scene, Tool, Vector3
from cpdeform.core.shapes.kinds import TOOLS

KIND_NUMBERS = {kind: number for number, kind in enumerate(TOOLS)}
"""Numbers of the tool kinds inside kernels."""

SPHERE, CAPSULE, BOX = KIND_NUMBERS["Sphere"], KIND_NUMBERS["Capsule"], KIND_NUMBERS["Box"]
CYLINDER, TORUS = KIND_NUMBERS["Cylinder"], KIND_NUMBERS["Torus"]
ROLLING_PIN, CHOPSTICKS, MESH = KIND_NUMBERS["RollingPin"], KIND_NUMBERS["Chopsticks"], KIND_NUMBERS["Mesh"]

MOST_LENGTHS = 4
"""Lengths that kernels have room for in a tool's record."""


@dataclasses.dataclass(frozen=True)
class SceneNumbers:
    """Constants of a scene.

    Attributes:
        time_step: Seconds per substep.
        node_distance: Distance dx between nodes, length units.
        inverse_distance: 1 / dx.
        particle_mass: Also the particle volume, density is 1.
        stress_scale: -dt volume 4 / dx^2.
        softness: Decay rate of a tool's influence, 1/length.
        ground_friction: See `Scene.ground_friction`.
        gravity: Acceleration, length/second^2.
        lower: Positions are clipped to stay above this corner, length units.
        upper: Positions are clipped to stay below this corner, length units.
        grid_size: Nodes along each axis.
        ground_nodes: Nodes below this number are the floor's boundary layer.
        tool_count: Number of tools.
    """

    time_step: float
    node_distance: float
    inverse_distance: float
    particle_mass: float
    stress_scale: float
    softness: float
    ground_friction: float
    gravity: Vector3
    lower: Vector3
    upper: Vector3
    grid_size: int
    ground_nodes: int
    tool_count: int


@dataclasses.dataclass(frozen=True)
class ToolNumbers:
    """Constants of a tool.

    Attributes:
        kind: One of `KIND_NUMBERS`.
        size: What its signed distance depends on, see `tool_size`.
        friction: Coulomb coefficient.
        action_offset: First of its components in an action.
        action_size: Number of its components.
        scale: Motion per substep at action 1, padded to seven: length units, radians.
        lower: Its position is clipped to stay above this corner, length units.
        upper: Its position is clipped to stay below this corner, length units.
        grid_first: Where its numbers begin in `tool_grids`; 0 for a tool without a grid.
    """

    kind: int
    size: tuple[float, ...]
    friction: float
    action_offset: int
    action_size: int
    scale: tuple[float, ...]
    lower: Vector3
    upper: Vector3
    grid_first: int = 0


def kind_number(tool: Tool) -> int:
    """The number of a tool's kind inside kernels.

    Raises:
        InputError: The kind is not in the list of `cpdeform.core.shapes.kinds`.
    """
    if tool.kind not in KIND_NUMBERS:
        expected = f"a kind that kernels have a number for: {', '.join(KIND_NUMBERS)}"
        raise InputError("tool", came=f"one of kind {tool.kind}", expected=expected)
    return KIND_NUMBERS[tool.kind]


def tool_size(tool: Tool) -> tuple[float, ...]:
    """The lengths that a tool's signed distance depends on, see `ToolBase.kernel_lengths`, padded to four.

    Raises:
        InputError: There are more.
    """
    lengths = tool.kernel_lengths
    if len(lengths) > MOST_LENGTHS:
        raise InputError(f"{tool.kind}.kernel_lengths", came=f"{len(lengths)} lengths", expected=f"at most {MOST_LENGTHS}")
    return (*lengths, *[0.0] * (MOST_LENGTHS - len(lengths)))


def scene_numbers(scene: Scene) -> SceneNumbers:
    """The constants of a scene."""
    lower, upper = scene.domain
    distance = scene.node_distance
    return SceneNumbers(
        time_step=scene.time_step,
        node_distance=distance,
        inverse_distance=float(scene.grid_size),
        particle_mass=scene.particle_volume,
        stress_scale=-scene.time_step * scene.particle_volume * 4.0 / distance**2,
        softness=scene.softness,
        ground_friction=scene.ground_friction,
        gravity=scene.gravity,
        lower=lower,
        upper=upper,
        grid_size=scene.grid_size,
        # whole nodes: PlasticineLab truncates the ground height to its grid
        ground_nodes=WALL_NODES + int(scene.ground_height / distance),
        tool_count=len(scene.tools),
    )


def tool_numbers(scene: Scene) -> list[ToolNumbers]:
    """The constants of a scene's tools."""
    tools, offset, first = [], 0, 0
    for tool in scene.tools:
        scale = [value / scene.substeps for value in tool.action_scale]
        tools.append(
            ToolNumbers(
                kind=kind_number(tool),
                size=tool_size(tool),
                friction=tool.friction,
                action_offset=offset,
                action_size=tool.action_size,
                scale=(*scale, *[0.0] * (7 - len(scale))),
                lower=tool.lower_bound,
                upper=tool.upper_bound,
                grid_first=first,
            )
        )
        offset += tool.action_size
        grid = tool.kernel_grid
        first += 0 if grid is None else grid.size
    return tools


def tool_grids(scene: Scene) -> NDArray[np.float64]:
    """The numbers (K,) of all tools' grids, see `ToolBase.kernel_grid`, one after the other; a single 0 where there are none."""
    grids = [tool.kernel_grid for tool in scene.tools]
    return np.concatenate(
        [np.zeros(1) if not any(grid is not None for grid in grids) else np.zeros(0)]
        + [grid.reshape(-1) for grid in grids if grid is not None]
    )


def material_numbers(scene: Scene) -> NDArray[np.float64]:
    """Shear modulus, Lame lambda and yield stress (N, 3) of each particle."""
    materials = [scene.material_of(index) for index in range(len(scene.bodies))]
    table = np.array([[item.shear_modulus, item.lame_lambda, item.yield_stress] for item in materials])
    numbers: NDArray[np.float64] = table[body_index(scene)]
    return numbers
