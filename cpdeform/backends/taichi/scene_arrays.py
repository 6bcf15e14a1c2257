"""The scene as the kernels read it: constants, tools and material as tensors, in the order that `kernels_types` declares."""

from __future__ import annotations

import torch
from torch import Tensor

from cpdeform.backends.scene_numbers import material_numbers, scene_numbers, tool_grids, tool_numbers
from cpdeform.backends.taichi.kernels_types import GRIDS, TOOL_VALUES
from cpdeform.core.scene import Scene


def make_values(scene: Scene) -> Tensor:
    """The constants of a scene, float64, but for the whole numbers; after them, from `GRIDS` on, the numbers of meshes."""
    numbers = scene_numbers(scene)
    return torch.tensor(
        [
            numbers.time_step,
            numbers.node_distance,
            numbers.inverse_distance,
            numbers.particle_mass,
            numbers.stress_scale,
            numbers.softness,
            numbers.ground_friction,
            *numbers.gravity,
            *numbers.lower,
            *numbers.upper,
            *tool_grids(scene),
        ],
        dtype=torch.float64,
    )


def make_numbers(scene: Scene, *, worlds: int, blocks: int, lanes: int) -> Tensor:
    """The whole numbers, int32, of a scene and of its launches in `worlds` worlds; the box of nodes is the whole grid."""
    numbers = scene_numbers(scene)
    n = numbers.grid_size
    launch = [worlds, scene.particle_count, blocks, lanes]
    return torch.tensor([n, numbers.ground_nodes, numbers.tool_count, *launch, 0, 0, 0, n, n, n], dtype=torch.int32)


def make_tools(scene: Scene) -> Tensor:
    """The tools (M, 22), float64; one unused row where there is none."""
    rows = [
        [
            *tool.size,
            tool.friction,
            *tool.scale,
            *tool.lower,
            *tool.upper,
            tool.kind,
            tool.action_offset,
            tool.action_size,
            GRIDS + tool.grid_first,
        ]
        for tool in tool_numbers(scene)
    ]
    return torch.tensor(rows or [[0.0] * TOOL_VALUES], dtype=torch.float64)


def make_materials(scene: Scene) -> Tensor:
    """Shear modulus, Lame lambda and yield stress (N, 3) of each particle, float64."""
    return torch.as_tensor(material_numbers(scene))
