"""Every kind of tool and body: signed distance, half extents, mesh, volume and sample against each other."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from toy_cone import ShapeCone, ToolCone

from cpdeform.backends.scene_numbers import MOST_LENGTHS, tool_size
from cpdeform.core.clearance import tool_half_extents
from cpdeform.core.errors import InputError
from cpdeform.core.meshes.filling import even_points
from cpdeform.core.rotation import from_rotation_vector, rotate
from cpdeform.core.scene import (
    BodyBox,
    BodySphere,
    ToolBase,
    ToolBox,
    ToolCapsule,
    ToolChopsticks,
    ToolCylinder,
    ToolRollingPin,
    ToolSphere,
    ToolTorus,
)
from cpdeform.core.shapes.base import Shape
from cpdeform.core.shapes.box import ARC_POINTS, ShapeBox
from cpdeform.core.shapes.kinds import BODIES, TOOLS
from cpdeform.core.shapes.mesh import BodyMesh, ToolMesh
from cpdeform.core.signed_distance import local_distance, signed_distance
from cpdeform.core.tool_surface import surface_points
from cpdeform.report.shapes import tool_surface

ORIGIN = (0.0, 0.0, 0.0)
EXAMPLES: dict[str, ToolBase | BodyBox | BodySphere] = {
    "sphere": ToolSphere(position=ORIGIN, radius=0.1),
    "capsule": ToolCapsule(position=ORIGIN, radius=0.05, height=0.12),
    "rolling pin": ToolRollingPin(position=ORIGIN, radius=0.04, height=0.2),
    "chopsticks": ToolChopsticks(position=ORIGIN, radius=0.03, height=0.1, gap=0.09),
    "chopsticks that overlap": ToolChopsticks(position=ORIGIN, radius=0.05, height=0.1, gap=0.07),
    "box": ToolBox(position=ORIGIN, half_extents=(0.05, 0.1, 0.07)),
    "rounded box": ToolBox(position=ORIGIN, half_extents=(0.05, 0.1, 0.02), rounding=0.03),
    "cylinder": ToolCylinder(position=ORIGIN, radius=0.08, half_height=0.05),
    "torus": ToolTorus(position=ORIGIN, major_radius=0.08, tube_radius=0.03),
    "box of clay": BodyBox(position=(0.5, 0.4, 0.3), widths=(0.1, 0.2, 0.3)),
    "ball of clay": BodySphere(position=(0.5, 0.4, 0.3), radius=0.1),
    "cone": ToolCone(position=ORIGIN, radius=0.08, height=0.15),
}
SHAPES = {name: example.shape() for name, example in EXAMPLES.items()} | {
    "torus without a hole": ToolTorus(position=ORIGIN, major_radius=0.03, tube_radius=0.06).shape()
}
CLOSED = [name for name in SHAPES if name not in ("torus without a hole", "chopsticks that overlap")]
"""Shapes whose mesh is their surface and nothing inside it."""

EYE = torch.eye(3, dtype=torch.float64)
TURN = from_rotation_vector(torch.tensor([0.4, 1.1, -0.7], dtype=torch.float64))
every_shape = pytest.mark.parametrize("name", SHAPES)


def distance(shape: Shape, points: Tensor) -> Tensor:
    return shape.distance(*points.unbind(-1))


def surroundings(shape: Shape, count: int) -> tuple[Tensor, Tensor]:
    """Points (count, 3) that fill a box around a shape evenly, and the box's half edges (3,)."""
    half = 1.2 * shape.half_extents(EYE)
    return (2.0 * torch.as_tensor(even_points(count)) - 1.0) * half, half


def inside(shape: Shape) -> Tensor:
    points, _ = surroundings(shape, 2**16)
    return points[distance(shape, points) < 0.0]


def test_every_kind_has_an_example() -> None:
    """Meshes have tests of their own, in `test_mesh_shapes.py`."""
    assert {type(example) for example in EXAMPLES.values()} == {*TOOLS.values(), *BODIES.values(), ToolCone} - {ToolMesh, BodyMesh}


@pytest.mark.parametrize("name", CLOSED)
def test_distance_is_zero_on_the_mesh(name: str) -> None:
    surface = torch.as_tensor(SHAPES[name].surface(rows=400, columns=65)).reshape(-1, 3)
    assert len(surface) > 400 * 65 - 1
    # The mesh's circles are polygons of about 800 edges; an edge's middle lies by its angle squared / 8 of a radius inside. The
    # corners of a rounded box have few edges, along two directions.
    bound = 2.0 * 0.03 * (0.5 * np.pi / (ARC_POINTS - 1)) ** 2 / 8.0 if name == "rounded box" else 2e-6
    assert float(distance(SHAPES[name], surface).abs().max()) < bound


@every_shape
def test_gradient_has_length_one_and_equals_finite_differences(name: str) -> None:
    points, _ = surroundings(SHAPES[name], 500)
    found, gradient = SHAPES[name].distance_and_gradient(points)
    assert torch.equal(found, distance(SHAPES[name], points))
    assert float((gradient.norm(dim=-1) - 1.0).abs().max()) < 1e-12
    step = 1e-7
    differences = [
        (distance(SHAPES[name], points + step * axis) - distance(SHAPES[name], points - step * axis)) / (2.0 * step) for axis in EYE
    ]
    assert float((torch.stack(differences, dim=-1) - gradient).abs().max()) < 1e-5


@every_shape
@pytest.mark.parametrize("quaternion", [torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64), TURN], ids=["straight", "turned"])
def test_half_extents_are_those_of_the_mesh(name: str, quaternion: Tensor) -> None:
    surface = rotate(quaternion, torch.as_tensor(SHAPES[name].surface(rows=400, columns=257)))
    found = surface.abs().reshape(-1, 3).amax(dim=0)
    half = SHAPES[name].half_extents(rotate(quaternion, EYE).T.abs())
    assert bool((found <= half + 1e-7).all())
    # An edge of a cylinder or a cone lies up to half a cell of the mesh beyond its points.
    assert bool((found >= half - 1e-3).all())


@every_shape
def test_volume_is_where_the_distance_is_negative(name: str) -> None:
    points, half = surroundings(SHAPES[name], 2**16)
    share = float((distance(SHAPES[name], points) < 0.0).double().mean())
    assert share * 8.0 * float(half.prod()) == pytest.approx(SHAPES[name].volume, rel=5e-3)


@every_shape
@pytest.mark.parametrize("make", [np.random.default_rng, np.random.RandomState])
def test_sample_fills_the_shape_evenly(name: str, make: type[np.random.Generator]) -> None:
    shape, count = SHAPES[name], 4000
    sample = torch.as_tensor(shape.sample(count, make(5)))
    assert sample.shape == (count, 3)
    assert float(distance(shape, sample).max()) < 1e-9
    assert torch.equal(sample, torch.as_tensor(shape.sample(count, make(5))))
    expected = inside(shape)
    spread = expected.std(dim=0)
    assert bool(((sample.mean(dim=0) - expected.mean(dim=0)).abs() < 4.0 * spread / count**0.5).all())
    assert torch.allclose(sample.std(dim=0), spread, rtol=0.04)


@pytest.mark.parametrize("name", ["box of clay", "ball of clay"])
def test_bodies_are_their_shapes_about_their_centres(name: str) -> None:
    body = EXAMPLES[name]
    assert isinstance(body, (BodyBox, BodySphere))
    assert body.half_extents == pytest.approx(tuple(body.shape().half_extents(EYE).tolist()), rel=1e-6)
    assert body.volume == body.shape().volume
    particles = torch.as_tensor(body.sample(np.random.default_rng(0)) - np.asarray(body.position))
    assert len(particles) == body.particle_count
    assert float(distance(body.shape(), particles).max()) < 1e-12
    assert bool((particles.abs().amax(dim=0) > 0.9 * torch.tensor(body.half_extents)).all())


@pytest.mark.parametrize("kind", [kind for kind in TOOLS if kind != "Mesh"])
def test_kernels_get_a_kinds_lengths_in_order(kind: str) -> None:
    tool = next(example for example in EXAMPLES.values() if type(example) is TOOLS[kind])
    assert isinstance(tool, ToolBase)
    size = tool_size(tool)
    assert len(size) == MOST_LENGTHS
    own = {name for name in type(tool).model_fields if name not in (*ToolBase.model_fields, "kind", "gap")}
    lengths = [length for name in type(tool).model_fields if name in own for length in np.atleast_1d(getattr(tool, name))]
    assert list(size) == [*lengths, *[0.0] * (MOST_LENGTHS - len(lengths))]


def test_only_a_flat_tool_has_a_thinnest_axis() -> None:
    axes = {name: example.thinnest_axis for name, example in EXAMPLES.items() if isinstance(example, ToolBase)}
    assert {name: axis for name, axis in axes.items() if axis is not None} == {"box": 0, "rounded box": 2}


def test_shapes_with_tensors_of_gaps_broadcast() -> None:
    tool = ToolChopsticks(position=ORIGIN, radius=0.03, height=0.1)
    gaps, points = torch.tensor([[0.06], [0.1]]), torch.rand(7, 3)
    both = local_distance(tool, *points.unbind(-1), gap=gaps)
    assert torch.equal(both, torch.stack([local_distance(tool, *points.unbind(-1), gap=float(gap)) for gap in gaps]))
    assert not torch.equal(both[0], both[1])


@pytest.mark.parametrize(
    "ask",
    [
        lambda tool: signed_distance(tool, torch.zeros(8), torch.zeros(2, 3)),
        lambda tool: local_distance(tool, *torch.zeros(3, 2)),
        lambda tool: tool_half_extents(tool, TURN),
        surface_points,
        lambda tool: tool_surface(tool, np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0])),
    ],
)
def test_what_is_no_tool_is_refused(ask) -> None:
    with pytest.raises(InputError, match=r"tool: got ShapeBox, expected a tool of cpdeform\.core\.scene"):
        ask(ShapeBox((0.1, 0.1, 0.1)))


def test_a_kind_without_geometry_cannot_be_made() -> None:
    class ToolSpoon(ToolBase):
        kind: str = "Spoon"

    with pytest.raises(TypeError, match="shape"):
        ToolSpoon(position=ORIGIN)


def test_too_many_lengths_for_kernels_are_refused() -> None:
    class ToolStar(ToolCone):
        @property
        def kernel_lengths(self) -> tuple[float, ...]:
            return (1.0, 2.0, 3.0, 4.0, 5.0)

    star = ToolStar(position=ORIGIN, radius=0.1, height=0.1)
    assert isinstance(star.shape(), ShapeCone)
    with pytest.raises(InputError, match=r"Cone\.kernel_lengths: got 5 lengths, expected at most 4"):
        tool_size(star)
