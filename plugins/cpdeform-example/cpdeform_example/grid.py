"""The grid update: gravity, contact with the tools, walls and floor. K nodes of all worlds together, see `transfer.py`."""

from __future__ import annotations

import torch
from torch import Tensor

from cpdeform.core.rotation import rotate, rotate_inverse
from cpdeform.core.scene import WALL_NODES, Scene, Tool
from cpdeform_example.motion import surface_velocity
from cpdeform_example.shapes import distance_and_normal
from cpdeform_example.transfer import Stencil

SMALLEST_MASS = 1e-12
SMALLEST_INFLUENCE = 0.1
STICKY_FRICTION = 10.0
NORM_REGULARIZATION = 1e-8


def update_grid(scene: Scene, stencil: Stencil, momentum: Tensor, mass: Tensor, before: Tensor, after: Tensor) -> Tensor:
    """Velocities (K, 3) of the nodes, length/second.

    Args:
        scene: Gravity, floor and tools.
        stencil: The nodes.
        momentum: Their momentum (K, 3).
        mass: Their mass (K,).
        before: Tool poses (B, M, 8) at the start of the substep.
        after: Tool poses (B, M, 8) at its end.
    """
    occupied = (mass > SMALLEST_MASS).unsqueeze(-1)
    velocity = momentum / torch.where(occupied, mass.unsqueeze(-1), 1.0)
    velocity = velocity + scene.time_step * velocity.new_tensor(scene.gravity)
    # converted first: whole numbers times a Python float are float32 in torch
    node = stencil.numbers.to(velocity) * scene.node_distance
    for index, tool in enumerate(scene.tools):
        poses = before[stencil.worlds, index], after[stencil.worlds, index]
        velocity = contact(scene, tool, *poses, node, velocity)
    return torch.where(occupied, boundary(scene, stencil.numbers, velocity), 0.0)


def contact(scene: Scene, tool: Tool, before: Tensor, after: Tensor, node: Tensor, velocity: Tensor) -> Tensor:
    """Velocities (K, 3) after contact with one tool, whose poses (K, 8) are those of each node's world."""
    local = rotate_inverse(before[:, 3:7], node - before[:, :3])
    distance, local_normal = distance_and_normal(tool, local, before[:, 7:])
    # 1 inside. Clamped before the exponential, which could overflow inside a large tool.
    influence = torch.exp(-scene.softness * distance.clamp(min=0.0))
    touches = (distance <= 0.0) | ((scene.softness > 0.0) & (influence > SMALLEST_INFLUENCE))
    normal = rotate(before[:, 3:7], local_normal)
    tool_velocity = surface_velocity(local, before, after, scene.time_step)
    relative = velocity - tool_velocity
    approach = (relative * normal).sum(dim=-1, keepdim=True)
    tangent = relative - approach * normal
    norm = (tangent.square().sum(dim=-1, keepdim=True) + NORM_REGULARIZATION).sqrt()
    sliding = tangent * ((norm + tool.friction * approach).clamp(min=0.0) / norm)
    stopped = torch.where(approach < 0.0, sliding, relative)
    return torch.where(touches, tool_velocity + (1.0 - influence) * relative + influence * stopped, velocity)


def boundary(scene: Scene, numbers: Tensor, velocity: Tensor) -> Tensor:
    """Stop what leaves through walls and floor, at nodes (K, 3) moving with velocities (K, 3)."""
    low, high = numbers < WALL_NODES, numbers > scene.grid_size - WALL_NODES
    # the floor's layer is the wall's plus the ground height in whole nodes (PlasticineLab's quirk)
    floor = numbers[:, 1] < WALL_NODES + int(scene.ground_height / scene.node_distance)
    x, y, z = velocity.unbind(-1)
    x = _stop(x, low[:, 0], high[:, 0])
    lands = floor & (y < 0.0)
    factor = torch.where(lands, _floor_factor(scene.ground_friction, x, y, z), 1.0)
    x, y, z = factor * x, torch.where(lands | (high[:, 1] & (y > 0.0)), 0.0, y), factor * z
    return torch.stack([x, y, _stop(z, low[:, 2], high[:, 2])], dim=-1)


def _stop(component: Tensor, low: Tensor, high: Tensor) -> Tensor:
    return torch.where((low & (component < 0.0)) | (high & (component > 0.0)), 0.0, component)


def _floor_factor(friction: float, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """Share of the tangential velocity that a node keeps when it lands."""
    if friction == 0.0:
        return torch.ones_like(y)
    if friction >= STICKY_FRICTION:
        return torch.zeros_like(y)
    return (1.0 + friction * y / (x * x + z * z + NORM_REGULARIZATION).sqrt()).clamp(min=0.0)
