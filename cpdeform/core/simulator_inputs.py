"""Whether the numbers of a state and of actions are such that a rollout can begin with them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.scene import Scene
from cpdeform.core.state import State

ACTION_SLACK = 1e-4
"""How far an action may be outside [-1, 1]: more than rounding, less than anybody means."""

POSITION_SLACK = 0.1
"""How far a particle may be outside the domain, in node distances; the first substep puts it back."""

QUATERNION_SLACK = 1e-2
"""How far the length of a quaternion may be from 1, as in a scene. Rounding over thousands of steps stays far below."""

TOOL_REACH = 100.0
"""How far a tool may be outside the unit cube, length units; one that is not needed may be put away."""

LARGEST_GAP = 1.0
"""The largest gap of a tool, length units."""

_DIVERGED = "A rollout that diverges ends so: lower the action scale, the stiffness or the time step of the scene."


class _Bounds(NamedTuple):
    """What the numbers of a tensor must keep to.

    Attributes:
        name: Name for the error.
        values: Numbers (B, ...), the world first.
        low: Least of them.
        high: Largest of them.
        axes: Names of the axes.
        expected: Text for the error.
        remedy: Text for the error.
    """

    name: str
    values: Tensor
    low: float
    high: float
    axes: tuple[str, ...]
    expected: str
    remedy: str

    def hold(self) -> bool:
        """One pass; nan makes both ends nan, so that no comparison holds."""
        if not self.values.numel():
            return True
        least, largest = torch.stack(torch.aminmax(self.values)).tolist()
        return bool(self.low <= least and largest <= self.high and math.isfinite(least) and math.isfinite(largest))


def check_values(scene: Scene, state: State, actions: Tensor) -> None:
    """Raise `InputError` unless a state and actions of the right shapes hold sensible numbers.

    All must be finite, actions in [-1, 1], particles inside the domain, tools near it, and quaternions of unit length. This costs
    one pass over the state, 0.06 ms for 3,000 particles on a CPU, once a rollout.

    Args:
        scene: Whose domain it is.
        state: Start of B worlds.
        actions: Actions (B, T, A).

    Raises:
        InputError: A number is none of these; it is named with its world and index.
    """
    with torch.no_grad():
        for bounds in _all_bounds(scene, state, actions):
            if not bounds.hold():
                raise _error(bounds)


def _all_bounds(scene: Scene, state: State, actions: Tensor) -> Iterator[_Bounds]:
    lower, upper = scene.domain
    slack = POSITION_SLACK * scene.node_distance
    particle, tool = ("world", "particle", "component"), ("world", "tool", "component")
    domain = f"positions inside the domain, from {min(lower):g} to {max(upper):g} length units"
    whole = "Lengths are in edges of the domain."
    yield _Bounds("state.position", state.position, min(lower) - slack, max(upper) + slack, particle, domain, whole)
    if lower[1] > min(lower):
        height, floor = state.position[..., 1], f"positions above the floor at y = {lower[1]:g} length units"
        yield _Bounds("state.position", height, lower[1] - slack, max(upper) + slack, particle[:2], floor, whole)
    for name in ("velocity", "affine", "elastic_strain"):
        values = getattr(state, name)
        yield _Bounds(f"state.{name}", values, -math.inf, math.inf, particle, "finite numbers", _DIVERGED)
    pose, name = state.tool_pose, "state.tool_pose"
    near = f"positions of tools from {-TOOL_REACH:g} to {1.0 + TOOL_REACH:g} length units"
    yield _Bounds(name, pose[..., :3], -TOOL_REACH, 1.0 + TOOL_REACH, tool, near, whole)
    lengths = torch.linalg.vector_norm(pose[..., 3:7], dim=-1)
    unit = "unit quaternions (w, x, y, z), whose length is 1"
    yield _Bounds(name, lengths, 1.0 - QUATERNION_SLACK, 1.0 + QUATERNION_SLACK, tool[:2], unit, "Divide them by their length.")
    yield _Bounds(name, pose[..., 7], -LARGEST_GAP, LARGEST_GAP, tool[:2], "gaps of at most one length unit", whole)
    scale = "The scene's action_scale says how far a tool moves at 1; clamp what a policy gives, or take its tanh."
    limit = 1.0 + ACTION_SLACK
    yield _Bounds("actions", actions, -limit, limit, ("world", "step", "component"), "finite numbers in [-1, 1]", scale)


def _error(bounds: _Bounds) -> InputError:
    """Name the first number out of bounds; those that are not finite first, and how many of them there are."""
    bad = ~torch.isfinite(bounds.values)
    remedy, expected = bounds.remedy, bounds.expected
    if bool(bad.any()):
        count = f"{int(bad.sum())} of {bad.numel()} numbers not finite, the first"
        if bounds.name != "actions":
            expected, remedy = "finite numbers", _DIVERGED
    else:
        bad, count = (bounds.values < bounds.low) | (bounds.values > bounds.high), ""
    index = torch.nonzero(bad)[0].tolist()
    value = float(bounds.values[tuple(index)])
    place = ", ".join(f"{axis} {at}" for axis, at in zip(bounds.axes, index, strict=False))
    came = f"{count} {value:g} ({place})".strip()
    return InputError(bounds.name, came=came, expected=expected, remedy=remedy)
