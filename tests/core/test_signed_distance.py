"""Signed distances against closed forms, sampled surfaces, rigid motions and finite differences."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from cpdeform.core.clearance import tool_half_extents
from cpdeform.core.errors import InputError
from cpdeform.core.rotation import from_rotation_vector, multiply, rotate
from cpdeform.core.scene import (
    Tool,
    ToolBox,
    ToolCapsule,
    ToolChopsticks,
    ToolCylinder,
    ToolRollingPin,
    ToolSphere,
    ToolTorus,
)
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.tool_surface import surface_points

ORIGIN = (0.0, 0.0, 0.0)
TOOLS: dict[str, Tool] = {
    "sphere": ToolSphere(position=ORIGIN, radius=0.3),
    "capsule": ToolCapsule(position=ORIGIN, radius=0.1, height=0.4),
    "box": ToolBox(position=ORIGIN, half_extents=(0.1, 0.2, 0.3)),
    "rounded": ToolBox(position=ORIGIN, half_extents=(0.1, 0.2, 0.3), rounding=0.05),
    "cylinder": ToolCylinder(position=ORIGIN, radius=0.2, half_height=0.3),
    "rolling pin": ToolRollingPin(position=ORIGIN, radius=0.1, height=0.4),
    "torus": ToolTorus(position=ORIGIN, major_radius=0.3, tube_radius=0.1),
}
IDENTITY = torch.tensor([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)
every_tool = pytest.mark.parametrize("name", TOOLS)


def at(tool: Tool, *point: float) -> float:
    return float(signed_distance(tool, IDENTITY, torch.tensor([point], dtype=torch.float64))[0])


def cloud(count: int, seed: int = 0) -> Tensor:
    return torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) * 1.2 - 0.6


@pytest.mark.parametrize(
    ("name", "point", "distance"),
    [
        ("sphere", (0.0, 0.5, 0.0), 0.2),
        ("sphere", (0.0, 0.0, 0.0), -0.3),
        ("capsule", (0.0, 0.5, 0.0), 0.2),
        ("capsule", (0.3, 0.1, 0.0), 0.2),
        ("capsule", (0.3, 0.6, 0.0), 0.4),
        ("capsule", (0.0, 0.1, 0.0), -0.1),
        ("box", (0.2, 0.0, 0.0), 0.1),
        ("box", (0.4, 0.6, 0.0), 0.5),
        ("box", (0.05, 0.0, 0.0), -0.05),
        ("rounded", (0.2, 0.0, 0.0), 0.05),
        ("rounded", (0.0, 0.0, 0.0), -0.15),
        ("cylinder", (0.0, 0.4, 0.1), 0.1),
        ("cylinder", (0.3, 0.0, 0.4), 0.3),
        ("cylinder", (0.5, 0.7, 0.0), 0.5),
        ("cylinder", (0.0, 0.25, 0.0), -0.05),
        ("torus", (0.0, 0.0, 0.0), 0.2),
        ("torus", (0.0, 0.0, 0.35), -0.05),
        ("torus", (0.6, 0.4, 0.0), 0.4),
    ],
)
def test_closed_forms(name: str, point: tuple[float, float, float], distance: float) -> None:
    assert math.isclose(at(TOOLS[name], *point), distance, abs_tol=1e-12)


@every_tool
def test_gradient_has_length_one(name: str) -> None:
    points = cloud(500).requires_grad_()
    signed_distance(TOOLS[name], IDENTITY, points).sum().backward()
    assert points.grad is not None
    assert torch.allclose(points.grad.norm(dim=-1), torch.ones(500, dtype=torch.float64), atol=1e-9)


@every_tool
def test_distance_is_that_to_the_nearest_surface_point(name: str) -> None:
    tool, points = TOOLS[name], cloud(100)
    surface = surface_points(tool, resolution=48)
    assert surface.shape[0] > 1000
    nearest = torch.cdist(points, surface).amin(dim=1)
    distance = signed_distance(tool, IDENTITY, points)
    assert bool((nearest >= distance.abs() - 1e-9).all())
    assert bool((nearest <= distance.abs() + 0.02).all())


@every_tool
def test_sign_tells_inside(name: str) -> None:
    """The volume where the distance is negative is the tool's."""
    tool = TOOLS[name]
    volumes = {
        "sphere": 4 / 3 * math.pi * 0.3**3,
        "capsule": math.pi * 0.1**2 * 0.4 + 4 / 3 * math.pi * 0.1**3,
        "box": 0.2 * 0.4 * 0.6,
        "rounded": 0.2 * 0.4 * 0.6 + 0.1 * (0.08 + 0.12 + 0.24) + math.pi * 0.05**2 * 1.2 + 4 / 3 * math.pi * 0.05**3,
        "cylinder": math.pi * 0.2**2 * 0.6,
        "rolling pin": math.pi * 0.1**2 * 0.4 + 4 / 3 * math.pi * 0.1**3,
        "torus": 2 * math.pi**2 * 0.3 * 0.1**2,
    }
    inside = signed_distance(tool, IDENTITY, cloud(200_000)) < 0.0
    assert math.isclose(float(inside.double().mean()) * 1.2**3, volumes[name], rel_tol=0.05)


@every_tool
@settings(deadline=None, max_examples=25)
@given(turn=st.tuples(*[st.floats(-3.0, 3.0)] * 3), shift=st.tuples(*[st.floats(-1.0, 1.0)] * 3))
def test_rigid_motion_changes_nothing(name: str, turn: tuple[float, ...], shift: tuple[float, ...]) -> None:
    tool, points = TOOLS[name], cloud(20)
    first = from_rotation_vector(torch.tensor([0.3, -0.2, 0.9], dtype=torch.float64))
    motion, offset = from_rotation_vector(torch.tensor(turn, dtype=torch.float64)), torch.tensor(shift, dtype=torch.float64)
    pose = torch.cat([torch.tensor([0.1, 0.2, 0.0], dtype=torch.float64), first, torch.zeros(1, dtype=torch.float64)])
    moved = torch.cat([rotate(motion, pose[:3]) + offset, multiply(motion, first), pose[7:]])
    before = signed_distance(tool, pose, points)
    after = signed_distance(tool, moved, rotate(motion, points) + offset)
    assert torch.allclose(before, after, atol=1e-9)


@every_tool
def test_gradients_match_finite_differences(name: str) -> None:
    quaternion = from_rotation_vector(torch.tensor([0.3, -0.2, 0.9], dtype=torch.float64))
    pose = torch.cat([torch.tensor([0.05, 0.02, -0.03], dtype=torch.float64), quaternion, torch.zeros(1, dtype=torch.float64)])

    def distance(pose: Tensor, points: Tensor) -> Tensor:
        return signed_distance(TOOLS[name], pose, points)

    assert torch.autograd.gradcheck(distance, (pose.requires_grad_(), cloud(8, seed=3).requires_grad_()))


@every_tool
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_everywhere(name: str, dtype: torch.dtype) -> None:
    values = torch.tensor([0.0, -0.0, 1e-40, 1e-30, 0.1, 0.2, -0.2, 0.3, 10.0], dtype=dtype)
    points = torch.cartesian_prod(values, values, values).requires_grad_()
    pose = IDENTITY.clone().to(dtype).requires_grad_()
    distance = signed_distance(TOOLS[name], pose, points)
    distance.sum().backward()
    assert points.grad is not None
    assert pose.grad is not None
    assert bool(torch.isfinite(distance).all())
    assert bool(torch.isfinite(points.grad).all())
    assert bool(torch.isfinite(pose.grad).all())
    assert float(points.grad.norm(dim=-1).max()) <= 1.0 + 1e-5


@every_tool
def test_same_values_with_and_without_gradient(name: str) -> None:
    points = cloud(50)
    assert torch.equal(
        signed_distance(TOOLS[name], IDENTITY, points), signed_distance(TOOLS[name], IDENTITY, points.requires_grad_()).detach()
    )


CHOPSTICKS = ToolChopsticks(position=ORIGIN, radius=0.1, height=0.4, gap=0.5)


@pytest.mark.parametrize(
    ("point", "distance"),
    [
        ((0.0, -0.2, 0.0), 0.2),  # midway between the rods
        ((0.3, 0.0, 0.0), -0.1),  # a rod's upper end, the origin's height
        ((-0.3, -0.4, 0.0), -0.1),  # the other rod's lower end
        ((0.3, 0.3, 0.0), 0.2),
        ((-0.3, -0.8, 0.0), 0.3),
        ((0.8, -0.2, 0.0), 0.4),
    ],
)
def test_chopsticks_are_two_rods_as_far_apart_as_the_pose_says(point: tuple[float, float, float], distance: float) -> None:
    pose = IDENTITY.clone()
    pose[7] = 0.6
    found = signed_distance(CHOPSTICKS, pose, torch.tensor([point], dtype=torch.float64))
    assert float(found[0]) == pytest.approx(distance, abs=1e-12)


def test_gradient_reaches_the_gap() -> None:
    pose = IDENTITY.clone()
    pose[7] = 0.6
    points = cloud(8, seed=4)
    assert torch.autograd.gradcheck(lambda pose: signed_distance(CHOPSTICKS, pose, points), (pose.requires_grad_(),))


def test_half_extents_hold_the_chopsticks() -> None:
    quaternion = from_rotation_vector(torch.tensor([0.4, 1.1, -0.7], dtype=torch.float64))
    surface = rotate(quaternion, surface_points(CHOPSTICKS, resolution=48)).abs().amax(dim=0)
    assert bool((surface <= tool_half_extents(CHOPSTICKS, quaternion) + 1e-9).all())


def test_leading_axes_broadcast() -> None:
    poses = IDENTITY.repeat(4, 3, 1)
    poses[..., 0] = torch.arange(12, dtype=torch.float64).reshape(4, 3) / 10
    distance = signed_distance(TOOLS["box"], poses, cloud(7))
    assert distance.shape == (4, 3, 7)
    assert torch.allclose(distance[2, 1], signed_distance(TOOLS["box"], poses[2, 1], cloud(7)))


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(InputError, match="pose: got shape"):
        signed_distance(TOOLS["box"], torch.zeros(7), cloud(2))
    with pytest.raises(InputError, match="points: got shape"):
        signed_distance(TOOLS["box"], IDENTITY, torch.zeros(3))


@every_tool
def test_half_extents_bound_the_surface_tightly(name: str) -> None:
    quaternion = from_rotation_vector(torch.tensor([0.4, 1.1, -0.7], dtype=torch.float64))
    surface = rotate(quaternion, surface_points(TOOLS[name], resolution=48)).abs().amax(dim=0)
    half = tool_half_extents(TOOLS[name], quaternion)
    assert bool((surface <= half + 1e-9).all())
    assert bool((surface >= 0.93 * half).all())
