"""The scene as the kernels read it: constants, tools and material on a device."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from cpdeform.backends.warp.kernels_types import KIND_NUMBERS, build_types
from cpdeform.core.sampling import body_index
from cpdeform.core.scene import (
    WALL_NODES,
    Manipulator,
    ManipulatorBox,
    ManipulatorChopsticks,
    ManipulatorCylinder,
    ManipulatorRod,
    ManipulatorSphere,
    Scene,
)


def tool_size(manipulator: Manipulator) -> tuple[float, ...]:
    """The lengths that a manipulator's signed distance depends on, in the order of `kernels_distance`, padded to four."""
    if isinstance(manipulator, ManipulatorSphere):
        return (manipulator.radius, 0.0, 0.0, 0.0)
    if isinstance(manipulator, (ManipulatorRod, ManipulatorChopsticks)):
        return (manipulator.radius, manipulator.height, 0.0, 0.0)
    if isinstance(manipulator, ManipulatorBox):
        return (*manipulator.half_extents, manipulator.rounding)
    if isinstance(manipulator, ManipulatorCylinder):
        return (manipulator.radius, manipulator.half_height, 0.0, 0.0)
    return (manipulator.major_radius, manipulator.tube_radius, 0.0, 0.0)


def make_parameters(scene: Scene, real: Any) -> Any:
    """The constants of a scene as the struct `Parameters`."""
    types = build_types(real)
    lower, upper = scene.domain
    distance = scene.node_distance
    parameters = types.Parameters()
    parameters.time_step = scene.time_step
    parameters.node_distance = distance
    parameters.inverse_distance = float(scene.grid_size)
    parameters.particle_mass = scene.particle_volume
    parameters.stress_scale = -scene.time_step * scene.particle_volume * 4.0 / distance**2
    parameters.gravity = types.vec3(*scene.gravity)
    parameters.softness = scene.softness
    parameters.ground_friction = scene.ground_friction
    # whole nodes: PlasticineLab truncates the ground height to its grid
    parameters.ground_nodes = WALL_NODES + int(scene.ground_height / distance)
    parameters.lower = types.vec3(*lower)
    parameters.upper = types.vec3(*upper)
    parameters.grid_size = scene.grid_size
    parameters.tool_count = len(scene.manipulators)
    return parameters


def make_tools(scene: Scene, real: Any, device: str) -> Any:
    """The manipulators of a scene as an array of the struct `Tool`; one unused entry where there is none."""
    types = build_types(real)
    tools, offset = [], 0
    for manipulator in scene.manipulators:
        tool = types.Tool()
        tool.kind = KIND_NUMBERS[manipulator.kind]
        tool.size = types.vec4(*tool_size(manipulator))
        tool.friction = manipulator.friction
        tool.action_offset = offset
        tool.action_size = manipulator.action_size
        scale = [value / scene.substeps for value in manipulator.action_scale]
        tool.scale = types.vec7(*scale, *[0.0] * (7 - len(scale)))
        tool.lower = types.vec3(*manipulator.lower_bound)
        tool.upper = types.vec3(*manipulator.upper_bound)
        offset += manipulator.action_size
        tools.append(tool)
    return wp.array(tools or [types.Tool()], dtype=types.Tool, device=device)


def make_constants(scene: Scene, real: Any, device: str) -> Any:
    """Shear modulus, Lame lambda and yield stress (N,) of each particle."""
    materials = [scene.material_of(index) for index in range(len(scene.bodies))]
    table = np.array([[item.shear_modulus, item.lame_lambda, item.yield_stress] for item in materials])
    return wp.array(table[body_index(scene)], dtype=build_types(real).vec3, device=device)
