"""A scene as plain numbers, for backends whose kernels read arrays and structs."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.errors import InputError
from cpdeform.core.sampling import body_index
from cpdeform.core.scene import (
    WALL_NODES,
    Manipulator,
    ManipulatorBox,
    ManipulatorChopsticks,
    ManipulatorCylinder,
    ManipulatorRod,
    ManipulatorSphere,
    ManipulatorTorus,
    Scene,
    Vector3,
)

SPHERE, CAPSULE, BOX, CYLINDER, TORUS, ROLLING_PIN, CHOPSTICKS = range(7)
KIND_NUMBERS = {
    "Sphere": SPHERE,
    "Capsule": CAPSULE,
    "Box": BOX,
    "Cylinder": CYLINDER,
    "Torus": TORUS,
    "RollingPin": ROLLING_PIN,
    "Chopsticks": CHOPSTICKS,
}
"""Numbers of the manipulator kinds inside kernels."""


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
        tool_count: Number of manipulators.
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
    """Constants of a manipulator.

    Attributes:
        kind: One of `KIND_NUMBERS`.
        size: What its signed distance depends on, see `tool_size`.
        friction: Coulomb coefficient.
        action_offset: First of its components in an action.
        action_size: Number of its components.
        scale: Motion per substep at action 1, padded to seven: length units, radians.
        lower: Its position is clipped to stay above this corner, length units.
        upper: Its position is clipped to stay below this corner, length units.
    """

    kind: int
    size: tuple[float, ...]
    friction: float
    action_offset: int
    action_size: int
    scale: tuple[float, ...]
    lower: Vector3
    upper: Vector3


def tool_size(manipulator: Manipulator) -> tuple[float, ...]:
    """The lengths that a manipulator's signed distance depends on, padded to four.

    Sphere (radius); Capsule, RollingPin and Chopsticks (radius, height); Box (half extents, rounding); Cylinder (radius, half
    height); Torus (major radius, tube radius).

    Raises:
        InputError: The manipulator is of no known kind.
    """
    if isinstance(manipulator, ManipulatorSphere):
        return (manipulator.radius, 0.0, 0.0, 0.0)
    if isinstance(manipulator, (ManipulatorRod, ManipulatorChopsticks)):
        return (manipulator.radius, manipulator.height, 0.0, 0.0)
    if isinstance(manipulator, ManipulatorBox):
        return (*manipulator.half_extents, manipulator.rounding)
    if isinstance(manipulator, ManipulatorCylinder):
        return (manipulator.radius, manipulator.half_height, 0.0, 0.0)
    if isinstance(manipulator, ManipulatorTorus):
        return (manipulator.major_radius, manipulator.tube_radius, 0.0, 0.0)
    raise InputError("manipulator", came=type(manipulator).__name__, expected="a manipulator of cpdeform.core.scene")


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
        tool_count=len(scene.manipulators),
    )


def tool_numbers(scene: Scene) -> list[ToolNumbers]:
    """The constants of a scene's manipulators."""
    tools, offset = [], 0
    for manipulator in scene.manipulators:
        scale = [value / scene.substeps for value in manipulator.action_scale]
        tools.append(
            ToolNumbers(
                kind=KIND_NUMBERS[manipulator.kind],
                size=tool_size(manipulator),
                friction=manipulator.friction,
                action_offset=offset,
                action_size=manipulator.action_size,
                scale=(*scale, *[0.0] * (7 - len(scale))),
                lower=manipulator.lower_bound,
                upper=manipulator.upper_bound,
            )
        )
        offset += manipulator.action_size
    return tools


def material_numbers(scene: Scene) -> NDArray[np.float64]:
    """Shear modulus, Lame lambda and yield stress (N, 3) of each particle."""
    materials = [scene.material_of(index) for index in range(len(scene.bodies))]
    table = np.array([[item.shear_modulus, item.lame_lambda, item.yield_stress] for item in materials])
    numbers: NDArray[np.float64] = table[body_index(scene)]
    return numbers
