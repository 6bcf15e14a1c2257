"""Where a stage's tools begin: outside the clay, if the stages before have moved it to where they were."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from cpdeform.core.clearance import CLEARANCE, exit_distances, push_out
from cpdeform.core.scene import Scene, Tool
from cpdeform.core.state import State

FARTHEST = 0.3
"""How far a tool is moved out of the clay at most, length units."""

TOUCHING = 0.0
"""Distance from the clay below which a tool is moved out of it, length units. It is less than the clearance that a tool was given,
so that a small change of the stages before moves none, and one that was moved out is not moved again."""


def begin_stage(scene: Scene, state: State, poses: Tensor, actions: Tensor) -> State:
    """A stage's start: tools at their poses, those that would be inside the clay moved out of it.

    Args:
        scene: The tools.
        state: Clay of B worlds.
        poses: Poses (M, 8), or (B, M, 8) where the worlds differ.
        actions: The stage's actions (B, T, A).
    """
    placed = poses.to(state.position).expand(state.batch_size, -1, -1).clone()
    for world in range(state.batch_size):
        offset = 0
        for index, tool in enumerate(scene.tools):
            if tool.movable:
                motion = actions[world, 0, offset : offset + tool.action_size][:3] * actions.new_tensor(tool.action_scale[:3])
                placed[world, index] = moved_out(tool, placed[world, index], motion, state.position[world])
            offset += tool.action_size
    return state.with_tools(placed)


def moved_out(tool: Tool, pose: Tensor, motion: Tensor, particles: Tensor) -> Tensor:
    """A tool's pose (8,), moved out of the clay by the shortest of three ways: against its motion, upwards, or off its surface.

    Most often a tool touches by a hair, as the stages before have changed a little: then it goes as little off the surface. By the
    other two ways alone one beside a wall would be lifted over it, and the loss would leap.

    Args:
        tool: The tool.
        pose: Pose (8,).
        motion: Where the tool goes first (up to 3 numbers), length units.
        particles: The clay (N, 3), length units.

    Returns:
        The pose; unchanged where the tool is free already, or where there is no way out within `FARTHEST` and its bounds.
    """
    back = torch.nn.functional.pad(-motion.detach(), (0, 3 - len(motion)))
    up = back.new_tensor([0.0, 1.0, 0.0])
    length = float(torch.linalg.vector_norm(back))
    # A tool that begins to rise would go back through the floor.
    directions = [back / length, up] if length > 0.0 and float(back[1]) >= 0.0 else [up]
    lower, upper = pose.new_tensor(tool.lower_bound), pose.new_tensor(tool.upper_bound)
    way = {"reach": FARTHEST, "clearance": CLEARANCE, "least_depth": -TOUCHING}
    places = [
        pose[:3] + exit_distances(tool, pose[3:7], pose[None, :3], direction, particles, **way)[0] * direction
        for direction in directions
    ]
    places.append(push_out(tool, pose, particles, clearance=CLEARANCE, touching=TOUCHING))
    found, shortest = pose, math.inf
    for place in places:
        gone = float(torch.linalg.vector_norm(place - pose[:3]))
        if gone < shortest and bool(((place >= lower) & (place <= upper)).all()):
            found, shortest = torch.cat([place, pose[3:]]), gone
    return found
