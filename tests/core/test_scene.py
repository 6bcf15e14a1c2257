from __future__ import annotations

import math

import numpy as np
import pytest
from pydantic import ValidationError

from cpdeform.core.scene import Material, Scene, ToolBox, ToolCapsule
from cpdeform.core.state import initial_state

BALL = {"kind": "sphere", "position": (0.5, 0.5, 0.5), "radius": 0.1, "particle_count": 500}
BLOCK = {"kind": "box", "position": (0.3, 0.2, 0.3), "widths": (0.1, 0.2, 0.3), "particle_count": 300}
PEN = {"kind": "Capsule", "position": (0.5, 0.8, 0.5), "radius": 0.03, "height": 0.1, "action_scale": (0.01, 0.01, 0.01)}


def test_material_constants():
    material = Material(youngs_modulus=5000.0, poisson_ratio=0.2)
    assert material.shear_modulus == pytest.approx(5000.0 / 2.4)
    assert material.lame_lambda == pytest.approx(5000.0 * 0.2 / (1.2 * 0.6))


def test_derived_numbers():
    fixed = {**PEN, "action_scale": ()}
    turning = {**PEN, "action_scale": (0.0, 0.0, 0.0, 0.1, 0.1, 0.1)}
    scene = Scene(bodies=(BALL, BLOCK), tools=(PEN, fixed, turning), material={"yield_stress": 10.0})
    assert (scene.particle_count, scene.action_size) == (800, 9)
    assert [tool.movable for tool in scene.tools] == [True, False, True]
    assert scene.node_distance == 1.0 / 64
    assert scene.particle_volume == (0.5 / 64) ** 2
    assert scene.gravity == (0.0, -30.0, 0.0)
    assert scene.domain == ((0.0, 0.0, 0.0), (1.0 - 3 / 64,) * 3)
    assert scene.material_of(0).yield_stress == 10.0
    assert Scene.model_validate_json(scene.model_dump_json()) == scene


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"bodies": ()}, "at least 1 item"),
        ({"bodies": ({**BALL, "position": (0.95, 0.5, 0.5)},)}, "along x, expected one inside the domain"),
        ({"bodies": ({**BALL, "radius": 0.0},)}, "greater than"),
        ({"bodies": ({**BALL, "particle_count": 0},)}, "greater than 0"),
        ({"bodies": ({**BALL, "kind": "cone"},)}, "tag 'cone'"),
        ({"bodies": ({**BALL, "colour": "red"},)}, "not permitted"),
        ({"tools": ({**PEN, "action_scale": (0.1,)},)}, "action_scale: got 1 components"),
        ({"tools": ({**PEN, "action_scale": (-0.1, 0.0, 0.0)},)}, "greater than or equal to 0"),
        ({"tools": ({**PEN, "rotation_wxyz": (1.0, 1.0, 0.0, 0.0)},)}, "unit quaternion"),
        ({"tools": ({**PEN, "lower_bound": (1.0, 1.0, 1.0), "upper_bound": (0.0, 0.0, 0.0)},)}, "at most upper_bound"),
        ({"tools": ({**PEN, "friction": math.inf},)}, "finite number"),
        ({"tools": ({**PEN, "kind": "Hammer"},)}, "Hammer"),
        ({"grid_size": 4}, "greater than or equal to 8"),
        ({"time_step": 0.0}, "greater than"),
        ({"time_step": math.nan}, "finite number"),
        ({"substeps": 0}, "greater than or equal to 1"),
        ({"time_step": True}, "valid number"),
        ({"time_step": "5"}, "valid number"),
        ({"substeps": True}, "valid integer"),
        ({"substeps": 1.5}, "valid integer"),
        ({"substeps": 10**19}, "less than or equal to"),
        ({"time_step": 10**400}, "finite number"),
        ({"bodies": ({**BALL, "particle_count": 2e9},)}, "less than or equal to"),
        ({"bodies": ({**BALL, "particle_count": 9_000_000},) * 2}, "18000000 particles of all bodies"),
        ({"bodies": ({**BALL, "position": ("0.5", 0.5, 0.5)},)}, "valid number"),
        ({"tools": ({**PEN, "position": (1e300, 0.5, 0.5)},)}, "less than or equal to"),
        ({"material": {"poisson_ratio": 0.5}}, "less than 0.5"),
    ],
)
def test_refuses(changes, message):
    with pytest.raises(ValidationError, match=message):
        Scene.model_validate({"bodies": (BALL,), "tools": (PEN,), **changes})


def test_scenes_are_immutable():
    scene = Scene(bodies=(BALL,))
    with pytest.raises(ValidationError, match="frozen"):
        scene.grid_size = 32


def test_initial_state():
    box = ToolBox(position=(0.1, 0.2, 0.3), rotation_wxyz=(0.6, 0.0, 0.8, 0.0), half_extents=(0.1, 0.1, 0.1))
    scene = Scene(bodies=(BALL,), tools=(box, ToolCapsule(**{k: v for k, v in PEN.items() if k != "kind"})))
    state = initial_state(scene, batch_size=2)
    assert (state.batch_size, state.particle_count) == (2, 500)
    assert not state.velocity.any()
    assert not state.elastic_strain.any()
    assert state.tool_pose[1, 0].tolist() == pytest.approx([0.1, 0.2, 0.3, 0.6, 0.0, 0.8, 0.0, 0.0])


def test_a_number_without_a_fraction_is_a_whole_number():
    scene = Scene(bodies=({**BALL, "particle_count": 1e3},), substeps=np.int64(7), time_step=np.float32(0.5))
    assert (scene.bodies[0].particle_count, scene.substeps, scene.time_step) == (1000, 7, 0.5)
    assert type(scene.bodies[0].particle_count) is int
    assert Scene.model_validate_json(scene.model_dump_json()) == scene
