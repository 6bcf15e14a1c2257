"""A kind of tool in one file works in Python, and simulators whose kernels lack it say so."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from toy_cone import SceneWithCones, ToolCone

from cpdeform.backends.scene_numbers import tool_numbers
from cpdeform.core.clearance import tool_half_extents
from cpdeform.core.errors import CapabilityError, InputError, MissingExtraError
from cpdeform.core.placer import Stage
from cpdeform.core.plugins import load_registry
from cpdeform.core.scene import Scene
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.state import initial_state
from cpdeform.placement.transport import PlacerTransport
from cpdeform.report.render import fit_camera, render
from cpdeform.report.shapes import tool_surface
from cpdeform.testing.placer import transport_of

CONE = ToolCone(position=(0.5, 0.4, 0.5), radius=0.05, height=0.12, action_scale=(0.01, 0.01, 0.01))
BODY = {"kind": "box", "position": (0.5, 0.1, 0.5), "widths": (0.2, 0.1, 0.2), "particle_count": 500}


def make_scene() -> SceneWithCones:
    return SceneWithCones.model_validate({"bodies": [BODY], "tools": [CONE.model_dump()]})


def test_distance_and_half_extents() -> None:
    (pose,) = initial_state(make_scene(), dtype=torch.float64).tool_pose[0]
    points = torch.tensor([[0.5, 0.5, 0.5], [0.5, 0.3, 0.5], [0.6, 0.34, 0.5], [0.5, 0.35, 0.5]], dtype=torch.float64)
    assert signed_distance(CONE, pose, points).tolist() == pytest.approx([0.04, 0.04, 0.05, -0.01])
    # Half a turn about z: the axes change their directions only.
    turn = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    assert tool_half_extents(CONE, turn).tolist() == pytest.approx([0.05, 0.06, 0.05])


def test_a_placer_puts_it_onto_the_body() -> None:
    scene = make_scene()
    state = initial_state(scene, dtype=torch.float64)
    priorities = -(state.position[0] - torch.tensor([0.5, 0.15, 0.5])).norm(dim=-1)
    stage = Stage(0, scene, state, state.position[0], transport_of(priorities), torch.Generator().manual_seed(0))
    (placement, *_) = PlacerTransport().ask(stage)
    gap = signed_distance(CONE, placement.pose[0], state.position[0]).min()
    assert 0.0 <= float(gap) <= 6e-4


def test_picture() -> None:
    pose = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    surface = tool_surface(CONE, pose, rows=200, columns=200)
    camera = fit_camera(np.array([[-0.1, -0.1, -0.1], [0.1, 0.1, 0.1]]), azimuth=0.0, elevation=0.0, aspect=1.0)
    particle, colour = np.array([[0.0, 0.09, 0.0]]), np.array([[1.0, 0.0, 0.0]])
    picture = render(camera, width=100, particles=particle, colours=colour, spacing=1e-3, tools=[surface])
    rows, columns = np.nonzero(picture[..., 3] > 0.3)
    widths = [np.ptp(columns[rows == row]) for row in np.unique(rows[rows > 25])]
    # Narrow at its tip, which is above, and as wide as high by 0.1 to 0.12 at its base.
    assert max(widths[:3]) < 12
    assert widths[-1] / len(widths) == pytest.approx(0.1 / 0.12, rel=0.1)
    assert np.corrcoef(widths, np.arange(len(widths)))[0, 1] > 0.99


@pytest.mark.parametrize("name", load_registry().names("simulator"))
def test_simulators_that_lack_it_say_so(name: str) -> None:
    registry = load_registry()
    try:
        simulator = registry.load("simulator", name)
    except MissingExtraError as error:
        pytest.skip(str(error))
    with pytest.raises(CapabilityError, match=r"has no tool of kind Cone \(tools\.0\); it has Sphere, Capsule"):
        simulator(make_scene())


def test_kernels_have_no_number_for_it() -> None:
    with pytest.raises(InputError, match=r"tool: got one of kind Cone, expected a kind that kernels have a number for: Sph"):
        tool_numbers(make_scene())


def test_tutorial_backend_does_not_take_it_for_another() -> None:
    shapes = pytest.importorskip("cpdeform_example.shapes")
    with pytest.raises(InputError, match="tool: got ToolCone, expected one of the kinds Sphere"):
        shapes.distance_and_normal(CONE, torch.zeros(2, 3), torch.zeros(2, 1))


def test_a_scene_that_does_not_list_it_refuses_it() -> None:
    with pytest.raises(ValueError, match="Cone"):
        Scene.model_validate({"bodies": [BODY], "tools": [CONE.model_dump()]})
