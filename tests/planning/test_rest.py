"""Clay at rest: against free fall, the floor, plain waiting, and against itself when it is left alone for longer."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from cpdeform.core.errors import InputError
from cpdeform.core.plugins import AUTO, load_registry
from cpdeform.core.sampling import sample_particles
from cpdeform.core.scene import BodyBox, Material, Scene, ToolCylinder, ToolSphere
from cpdeform.planning.rest import rest, rest_scene, rest_state, settle_goal, tools_away
from cpdeform.planning.shape_metrics import GoalShape

FLOOR = 3 / 64
"""Height that clay comes to rest at: the floor's boundary layer is three nodes thick."""


def make_scene(*, height=FLOOR + 0.02, count=800, tools=(), yield_stress=50.0):
    body = BodyBox(position=(0.5, height + 0.04, 0.5), widths=(0.1, 0.08, 0.1), particle_count=count)
    return Scene(bodies=(body,), tools=tools, material=Material(yield_stress=yield_stress))


def make_simulator(scene, **options):
    registry = load_registry()
    return registry.create("simulator", registry.resolve("simulator", AUTO, device="cpu"), scene=scene, **options)


BALL = ToolSphere(radius=0.03, position=(0.5, 0.1, 0.5), action_scale=(0.01, 0.01, 0.01))
POST = ToolCylinder(radius=0.02, half_height=0.1, position=(0.2, 0.1, 0.2))


@pytest.fixture(scope="module")
def fallen():
    """A block that fell by 0.02, damped and plainly."""
    simulator = make_simulator(make_scene())
    start = simulator.initial_state()
    return simulator, start, rest(simulator, start, stray_share=0.01), rest(simulator, start, damped=False, step_limit=400)


def test_clay_rests_on_the_floor_and_stays(fallen):
    simulator, start, found, _ = fallen
    assert found.rests == (True,)
    assert found.moving_share[0] <= 0.01
    assert not bool(found.state.velocity.any())
    assert not bool(found.state.affine.any())
    heights = found.state.position[0, :, 1]
    assert float(heights.min()) == pytest.approx(FLOOR, abs=1 / 128)
    assert float((start.position[0, :, 1] - heights).mean()) == pytest.approx(0.02, abs=0.004)
    # Weight is borne by pressure: the vertical strain of clay at rest is a compression.
    assert float(found.state.elastic_strain[0, :, 1].mean()) < 0.0
    later = simulator.rollout(found.state, torch.zeros(1, 60, 0)).final_state
    motion = (later.position - found.state.position)[0].norm(dim=-1) * 64
    assert float(motion.median()) < 0.01


def test_damping_ends_at_the_rest_of_plain_waiting(fallen):
    simulator, _, damped, plain = fallen
    assert damped.steps[0] < 0.7 * plain.steps[0]
    assert plain.moving_share[0] < 0.05
    distance = (damped.state.position - plain.state.position)[0].norm(dim=-1) * 64
    assert float(distance.mean()) < 0.02
    assert GoalShape(plain.state.position[0], simulator.scene).iou(damped.state.position[0]) > 0.985


def test_falling_clay_does_not_rest():
    simulator = make_simulator(make_scene(height=0.5, count=200))
    found = rest(simulator, simulator.initial_state(), step_limit=12)
    assert (found.rests, found.steps, found.moving_share) == ((False,), (12,), (1.0,))
    scene = simulator.scene
    step = scene.time_step * scene.substeps
    # In free fall the 12th step covers g h^2 (12 - 1/2), and half a substep's motion more by the order of the update.
    expected = 30.0 * step**2 * 11.5 * 64
    assert found.residual[0] == pytest.approx(expected, rel=0.01)
    assert bool(found.state.velocity.any())


def test_a_crumb_falls_to_the_floor_while_the_body_rests():
    scene = make_scene(height=FLOOR)
    simulator = make_simulator(scene)
    start = simulator.initial_state()
    start.position[0, :8] = torch.tensor([0.2, FLOOR + 0.04, 0.2]) + 0.002 * torch.rand(8, 3)
    found = rest(simulator, start, stray_share=0.01, step_limit=120)  # the fall itself takes 28 steps
    assert float(found.state.position[0, :8, 1].max()) < FLOOR + 1 / 64


def test_tools_are_away_and_put_back():
    scene = make_scene(height=FLOOR, tools=(BALL, POST))
    bare = rest_scene(scene)
    assert [tool.kind for tool in bare.tools] == ["Cylinder"]
    simulator = make_simulator(scene)
    start = simulator.initial_state()  # the ball is inside the clay
    found, alone = (
        rest(simulator, start, step_limit=20),
        rest(make_simulator(bare), rest_state(start, scene), step_limit=20),
    )
    torch.testing.assert_close(found.state.position, alone.state.position, rtol=0.0, atol=1e-6)
    assert torch.equal(found.state.tool_pose, start.tool_pose)
    assert torch.equal(tools_away(start, scene)[:, 1], start.tool_pose[:, 1])
    # A tool that cannot rise goes to a corner of its bounds.
    low = BALL.model_copy(update={"lower_bound": (0.1, 0.05, 0.1), "upper_bound": (0.9, 0.06, 0.9)})
    pose = tools_away(start, make_scene(height=FLOOR, tools=(low, POST)))[0, 0]
    assert pose[:3].tolist() == pytest.approx([0.1, 0.06, 0.1])
    stuck = BALL.model_copy(update={"lower_bound": (0.48, 0.08, 0.48), "upper_bound": (0.52, 0.1, 0.52)})
    with pytest.raises(InputError, match=r"state: tools\.0: got clay within 0\.02 of every corner.*rest_scene"):
        tools_away(start, make_scene(height=FLOOR, tools=(stuck, POST)))


def test_worlds_rest_each_for_itself():
    scene = make_scene(height=FLOOR + 0.005, count=800)
    simulator = make_simulator(scene, batch_size=2)
    start = simulator.initial_state()
    start.position[1, :, 1] += 0.01
    both = rest(simulator, start, stray_share=0.02, step_limit=400)
    assert both.rests == (True, True)
    assert both.steps[0] != both.steps[1]
    for world in range(2):
        single = rest(simulator, start.select(world), stray_share=0.02, step_limit=400)
        assert single.steps[0] == pytest.approx(both.steps[world], abs=5)  # sums differ in the last digits
        difference = (single.state.position[0] - both.state.position[world]).norm(dim=-1) * 64
        assert float(difference.median()) < 0.01


def test_a_goal_is_put_down_rigidly():
    scene = make_scene(height=FLOOR + 0.03)
    goal = torch.as_tensor(sample_particles(scene))
    put_down = settle_goal(make_simulator(rest_scene(scene)), goal, stray_share=0.01)
    assert put_down.rests
    assert put_down.drop == pytest.approx(0.03, abs=0.004)
    expected = goal - torch.tensor([0.0, put_down.drop, 0.0], dtype=torch.float64)
    torch.testing.assert_close(put_down.position, expected, rtol=0.0, atol=1e-12)
    assert float((put_down.let_go - put_down.position)[:, 1].mean()) == pytest.approx(0.0, abs=1e-6)
    assert put_down.self_iou > 0.93
    # Two slabs with a gap between them are no shape that clay keeps.
    apart = goal + torch.tensor([0.0, 0.06, 0.0]) * (goal[:, 1:2] > goal[:, 1].median())
    assert settle_goal(make_simulator(rest_scene(scene)), apart, stray_share=0.01).self_iou < put_down.self_iou - 0.2


def test_particles_are_shared_out_among_bodies():
    bodies = tuple(
        BodyBox(position=(x, 0.2, 0.5), widths=(0.1, 0.1, 0.1), particle_count=n) for x, n in ((0.2, 30), (0.5, 10), (0.8, 60))
    )
    scene = Scene(bodies=bodies)
    assert [body.particle_count for body in rest_scene(scene, particle_count=1000).bodies] == [300, 100, 600]
    assert [body.particle_count for body in rest_scene(scene, particle_count=3).bodies] == [1, 1, 1]
    assert rest_scene(scene, particle_count=100).bodies == bodies
    with pytest.raises(InputError, match="particle_count: got 2, expected at least 3"):
        rest_scene(scene, particle_count=2)


@pytest.mark.parametrize("option", [{"step_limit": 0}, {"tolerance": 0.0}, {"tolerance": float("nan")}, {"stray_share": 1.0}])
def test_unusable_options_are_refused(option):
    simulator = make_simulator(make_scene(count=10))
    with pytest.raises(InputError, match=f"{next(iter(option))}: got"):
        rest(simulator, simulator.initial_state(), **option)


def test_a_goal_of_another_size_is_refused():
    simulator = make_simulator(make_scene(count=10))
    with pytest.raises(InputError, match=r"goal: got shape \(4, 3\).*particle_count=len\(goal\)"):
        settle_goal(simulator, torch.full((4, 3), 0.5))


def test_diverged_clay_does_not_rest():
    simulator = make_simulator(make_scene(count=50))
    start = simulator.initial_state()
    affine = start.affine.clone()
    affine[0, 0] = 1e30
    found = rest(simulator, dataclasses.replace(start, affine=affine), step_limit=8, stray_share=0.9)
    assert not torch.isfinite(found.state.position).all()
    assert found.rests == (False,)
    assert found.steps[0] < 8


def test_a_goal_whose_clay_diverges_is_told_of(monkeypatch):
    simulator = make_simulator(make_scene(count=50))
    goal = simulator.initial_state().position[0]

    def diverged(simulator, state, **options):
        found = rest(simulator, state, **options)
        return dataclasses.replace(found, state=dataclasses.replace(found.state, position=found.state.position * float("nan")))

    monkeypatch.setattr("cpdeform.planning.rest.rest", diverged)
    settled = settle_goal(simulator, goal, step_limit=1)
    assert (settled.self_iou, settled.drop, settled.rests) == (0.0, 0.0, False)
    torch.testing.assert_close(settled.position, goal)
