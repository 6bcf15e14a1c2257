"""What the search over tool positions accepts."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from cpdeform.core.errors import CapabilityError, InputError
from cpdeform.core.placer import Stage
from cpdeform.core.scene import BodyBox, Scene, Tool, ToolBox, ToolCylinder, ToolSphere
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.state import initial_state
from cpdeform.placement.grid import GridOptions, ToolGrid, movable_tools
from cpdeform.testing.placer import transport_of

MOVES = (0.01, 0.01, 0.01)


def ball(**options: Any) -> ToolSphere:
    return ToolSphere(**{"position": (0.5, 0.7, 0.5), "radius": 0.05, "action_scale": MOVES} | options)


def stage(*tools: Tool, count: int = 2000, dtype: torch.dtype = torch.float64) -> Stage:
    body = BodyBox(position=(0.5, 0.4, 0.5), widths=(0.2, 0.2, 0.2), particle_count=count)
    scene = Scene(bodies=(body,), tools=tools)
    state = initial_state(scene, dtype=dtype)
    priorities = torch.zeros(count, dtype=dtype)
    return Stage(0, scene, state, state.position[0], transport_of(priorities), torch.Generator().manual_seed(0))


def distances(stage: Stage, tool: int, position: torch.Tensor) -> torch.Tensor:
    pose = stage.state.tool_pose[0, tool].clone()
    pose[:3] = position
    return signed_distance(stage.scene.tools[tool], pose, stage.state.position[0])


def lattice(size: int = 9) -> torch.Tensor:
    axis = torch.linspace(0.2, 0.8, size, dtype=torch.float64)
    return torch.cartesian_prod(axis, axis, axis)


@pytest.mark.parametrize("clearance", [0.0, 0.02])
@pytest.mark.parametrize("largest_gap", [float("inf"), 0.03])
def test_feasible_equals_the_naive_test(clearance: float, largest_gap: float) -> None:
    turned = ToolBox(
        position=(0.5, 0.7, 0.5),
        half_extents=(0.02, 0.08, 0.05),
        rotation_wxyz=(0.8, 0.0, 0.6, 0.0),
        action_scale=MOVES,
        lower_bound=(0.3, 0.0, 0.0),
    )
    here = stage(turned)
    found = ToolGrid(here, 0, GridOptions(clearance=clearance)).feasible(lattice(), largest_gap=largest_gap)
    expected = []
    for position in lattice():
        gap = float(distances(here, 0, position).min())
        if position[0] >= 0.3 and clearance <= gap <= largest_gap:
            expected.append(position)
    assert len(expected) > 10
    assert torch.equal(found, torch.stack(expected))


def test_fixed_tools_are_not_overlapped_from_outside_or_inside() -> None:
    pillar = ToolCylinder(position=(0.25, 0.5, 0.5), radius=0.15, half_height=0.5)
    for radius in (0.02, 0.3):
        here = stage(ball(radius=radius), pillar)
        found = ToolGrid(here, 0, GridOptions()).feasible(lattice(13))
        across = (found[:, [0, 2]] - torch.tensor([0.25, 0.5])).norm(dim=-1)
        above = (found[:, 1] - 0.5).abs() - 0.5
        assert bool(((across >= 0.15 + radius - 2e-3) | (above >= radius - 2e-3)).all())


def test_a_tool_does_not_swallow_a_fixed_one() -> None:
    pin = ToolSphere(position=(0.275, 0.275, 0.275), radius=0.005)
    found = ToolGrid(stage(ball(radius=0.12), pin), 0, GridOptions()).feasible(lattice())
    assert float((found - 0.275).norm(dim=-1).min()) >= 0.125 - 1e-3
    assert found.shape[0] > 10


def test_search_ends_at_the_cheapest_touching_position() -> None:
    here = stage(ball())
    grid = ToolGrid(here, 0, GridOptions())
    top = here.state.position[0, here.state.position[0, :, 1].argmax()]

    def height(positions: torch.Tensor) -> torch.Tensor:
        return -positions[:, 1]

    found = grid.search(top, height)
    assert found is not None
    gap = float(distances(here, 0, found.position).min())
    assert 0.0 <= gap <= 5e-4
    assert gap == pytest.approx(grid.smallest_gap(found.position))
    assert found.cost == pytest.approx(-float(found.position[1]))


def test_ties_go_to_the_contact_point() -> None:
    here = stage(ball())
    grid = ToolGrid(here, 0, GridOptions())
    point = here.state.position[0, here.state.position[0, :, 1].argmax()]
    found = grid.search(point, lambda positions: torch.zeros_like(positions[:, 0]))
    assert found is not None
    assert float((found.position - point).norm()) - 0.05 < 1e-3


def test_nothing_is_found_where_bounds_keep_the_tool_inside_the_body() -> None:
    here = stage(ball(lower_bound=(0.45, 0.35, 0.45), upper_bound=(0.55, 0.45, 0.55)))
    grid = ToolGrid(here, 0, GridOptions())
    assert grid.search(here.state.position[0, 0], lambda positions: positions[:, 0]) is None


def test_memory_pieces_do_not_change_the_distances(monkeypatch: pytest.MonkeyPatch) -> None:
    here = stage(ball())
    grid = ToolGrid(here, 0, GridOptions())
    whole = grid.reduce(lattice(4), grid.particles, lambda distance: distance.amin(dim=-1))
    monkeypatch.setattr("cpdeform.placement.grid.CHUNK_DISTANCES", 5000)
    assert torch.equal(grid.reduce(lattice(4), grid.particles, lambda distance: distance.amin(dim=-1)), whole)


def test_movable_tools_are_found() -> None:
    assert movable_tools(stage(ball(action_scale=()), ball())) == [1]
    assert movable_tools(stage(ball(), ball())) == [0, 1]
    with pytest.raises(CapabilityError, match="no movable tool"):
        movable_tools(stage(ball(action_scale=())))


@pytest.mark.parametrize(
    ("name", "value"),
    [("grid_size", 1), ("refinements", -1), ("clearance", -0.1), ("clearance", float("nan")), ("margin", -1.0), ("max_gap", -1.0)],
)
def test_options_are_checked(name: str, value: float) -> None:
    with pytest.raises(InputError, match=f"{name}: got"):
        GridOptions(**{name: value})  # type: ignore[arg-type]
