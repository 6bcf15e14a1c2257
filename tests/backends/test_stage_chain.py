"""Several stages as one rollout: the same as one after the other, with gradients through the change of tools between them."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from backend_cases import BACKENDS, CASES, actions_for, backend_class, stirred

from cpdeform.core.clearance import CLEARANCE, push_out
from cpdeform.core.errors import CapabilityError, InputError
from cpdeform.core.scene import ToolBox, ToolSphere
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.simulator import Simulator, differentiable_rollout
from cpdeform.planning.chain import SimulatorChain
from cpdeform.planning.stage_start import begin_stage, moved_out

STEPS = 2


@pytest.fixture(params=BACKENDS)
def simulator(request: pytest.FixtureRequest) -> Simulator:
    return backend_class(request.param)(CASES["two tools"], dtype=torch.float64, batch_size=2)


def poses_of(simulator: Simulator) -> torch.Tensor:
    """Two places for the tools (2, M, 8), the second one a little off the first and turned."""
    first = simulator.initial_state(batch_size=1).tool_pose[0]
    second = first.clone()
    second[:, :3] += second.new_tensor([0.004, 0.006, -0.003])
    second[:, 3:7] = torch.nn.functional.normalize(second[:, 3:7] + second.new_tensor([0.0, 0.05, 0.02, 0.0]), dim=-1)
    return torch.stack([first, second])


def far_enough(simulator: Simulator, poses: torch.Tensor) -> torch.Tensor:
    """The poses, raised until no tool has to be moved out."""
    return poses + poses.new_tensor([0.0, 0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


def test_a_chain_is_its_stages_one_after_the_other_and_so_is_its_gradient(simulator: Simulator) -> None:
    poses = far_enough(simulator, poses_of(simulator))
    chain = SimulatorChain(simulator, poses=poses)
    start, plan = stirred(simulator, batch_size=2), actions_for(simulator, batch_size=2, steps=2 * STEPS)
    whole = chain.rollout(start, plan)
    actions = plan.clone().requires_grad_()
    position = start.position.clone().requires_grad_()
    state = dataclasses.replace(start, position=position)
    weights = torch.linspace(-1.0, 1.0, whole.positions.numel(), dtype=torch.float64).view_as(whole.positions)
    total = torch.zeros((), dtype=torch.float64)
    for number, some in enumerate(actions.split(STEPS, dim=1)):
        placed = state.with_tools(
            begin_stage(simulator.scene, state.map(torch.Tensor.detach), poses[number], some.detach()).tool_pose
        )
        stage = differentiable_rollout(simulator, placed, some)
        window = slice(number * STEPS, (number + 1) * STEPS + number)
        counted = stage.positions if number else stage.positions[:, :-1]
        assert torch.equal(whole.positions[:, window], counted)
        total = total + (weights[:, window] * counted).sum()
        state = stage.final_state
    total.backward()
    assert torch.equal(whole.final_state.position, state.position)
    found = chain.vjp(whole, weights)
    assert torch.allclose(found.actions, actions.grad, rtol=1e-9, atol=1e-12)
    assert torch.allclose(found.initial_state.position, position.grad, rtol=1e-8, atol=1e-11)
    assert float(found.actions[:, :STEPS].abs().max()) > 0.0
    assert not found.initial_state.tool_pose.any()


def test_the_first_stage_is_led_by_what_comes_of_it_in_the_second(simulator: Simulator) -> None:
    """Central differences of a loss at the end of both stages by one of the first stage's actions."""
    chain = SimulatorChain(simulator, poses=far_enough(simulator, poses_of(simulator)))
    start, plan = stirred(simulator), actions_for(simulator, steps=2 * STEPS)

    def loss(actions: torch.Tensor) -> float:
        return float(chain.rollout(start, actions).positions[:, -1].square().sum())

    trajectory = chain.rollout(start, plan)
    # The way out of the clay counts as fixed, and would be missing in the gradient.
    for part, poses in zip(trajectory.checkpoints, far_enough(simulator, poses_of(simulator)), strict=True):
        assert torch.equal(part.tool_poses[0, 0], poses)
    slope = torch.zeros_like(trajectory.positions)
    slope[:, -1] = 2.0 * trajectory.positions[:, -1]
    gradient = chain.vjp(trajectory, slope).actions
    component = int(gradient[0, 0].abs().argmax())
    step = torch.zeros_like(plan)
    step[0, 0, component] = 1e-6
    difference = (loss(plan + step) - loss(plan - step)) / 2e-6
    assert difference == pytest.approx(float(gradient[0, 0, component]), rel=1e-3)


def test_steps_of_rest_have_no_gradient_in_any_stage() -> None:
    simulator = backend_class("warp")(CASES["two tools"], dtype=torch.float64)
    chain = SimulatorChain(simulator, poses=poses_of(simulator), rest_steps=1)
    trajectory = chain.rollout(stirred(simulator), actions_for(simulator, steps=2 * STEPS))
    gradient = chain.vjp(trajectory, torch.ones_like(trajectory.positions)).actions
    for stage in gradient.split(STEPS, dim=1):
        assert not stage[:, -1].any()
        assert stage[:, 0].any()


def test_a_tool_inside_the_clay_is_moved_out_against_its_motion() -> None:
    simulator = backend_class("warp")(CASES["two tools"], dtype=torch.float64)
    clay, tool = simulator.initial_state(batch_size=1).position[0], simulator.scene.tools[0]
    pose = simulator.initial_state(batch_size=1).tool_pose[0, 0].clone()
    pose[:3] = clay.mean(dim=0)
    assert float(signed_distance(tool, pose, clay).min()) < -CLEARANCE
    found = moved_out(tool, pose, torch.tensor([0.0, -0.01, 0.0]), clay)
    gap = float(signed_distance(tool, found, clay).min())
    assert CLEARANCE <= gap < 4.0 * CLEARANCE
    assert torch.equal(found[[0, 2, 3, 4, 5, 6, 7]], pose[[0, 2, 3, 4, 5, 6, 7]])
    assert float(found[1]) > float(pose[1])
    assert torch.equal(moved_out(tool, found, torch.tensor([0.0, -0.01, 0.0]), clay), found)


@pytest.mark.parametrize(
    ("place", "motion", "way"),
    [
        # In the middle of a slab upwards is nearer than back, at its side back.
        ((0.5, 0.33, 0.5), (0.01, 0.0, 0.0), (0.0, 1.0, 0.0)),
        ((0.36, 0.31, 0.5), (0.01, 0.0, 0.0), (-1.0, 0.0, 0.0)),
        # Back from a rise would be down through the floor; a tool at rest goes up.
        ((0.5, 0.33, 0.5), (0.0, 0.01, 0.0), (0.0, 1.0, 0.0)),
        ((0.5, 0.33, 0.5), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ],
)
def test_the_shorter_way_out_is_taken(place, motion, way) -> None:
    axes = [torch.linspace(low, high, count) for low, high, count in ((0.35, 0.65, 61), (0.3, 0.36, 13), (0.35, 0.65, 61))]
    clay = torch.cartesian_prod(*axes)
    tool = ToolSphere(radius=0.03, position=place, action_scale=(0.01, 0.01, 0.01))
    pose = torch.tensor([*place, 1.0, 0.0, 0.0, 0.0, 0.0])
    found = moved_out(tool, pose, torch.tensor(motion), clay)
    assert float(signed_distance(tool, found, clay).min()) >= CLEARANCE - 1e-6
    gone = found[:3] - pose[:3]
    torch.testing.assert_close(gone / gone.norm(), torch.tensor(way), atol=1e-5, rtol=0.0)
    assert float(gone.norm()) < 0.065
    # Where its bounds let it go neither way, it stays.
    bounded = tool.model_copy(update={"lower_bound": place, "upper_bound": place})
    assert torch.equal(moved_out(bounded, pose, torch.tensor(motion), clay), pose)


def wall() -> torch.Tensor:
    """Clay of a wall 0.04 thick and 0.3 high, in the plane x = 0.5."""
    axes = [torch.linspace(low, high, count) for low, high, count in ((0.48, 0.52, 17), (0.1, 0.4, 76), (0.3, 0.7, 101))]
    return torch.cartesian_prod(*axes)


@pytest.mark.parametrize("motion", [(0.0, 0.0, 0.01), (0.01, 0.005, 0.0), (0.0, 0.0, 0.0), (-0.01, 0.0, 0.0)])
@pytest.mark.parametrize("depth", [1e-5, 1e-3, 0.01])
def test_a_tool_that_grazes_a_wall_leaves_it_by_the_way_it_came_in(motion, depth) -> None:
    clay, half_extents = wall(), (0.015, 0.1, 0.1)
    tool = ToolBox(half_extents=half_extents, position=(0.3, 0.25, 0.5), action_scale=(0.01, 0.01, 0.01))
    pose = torch.tensor([0.48 - half_extents[0] + depth, 0.25, 0.5, 1.0, 0.0, 0.0, 0.0, 0.0])
    gone = moved_out(tool, pose, torch.tensor(motion), clay)[:3] - pose[:3]
    torch.testing.assert_close(gone, torch.tensor([-depth - CLEARANCE, 0.0, 0.0]), atol=2e-6, rtol=0.0)


def test_a_tool_near_the_clay_stays_where_it_is() -> None:
    clay = wall()
    tool = ToolSphere(radius=0.03, position=(0.3, 0.25, 0.5), action_scale=(0.01, 0.01, 0.01))
    pose = torch.tensor([0.48 - tool.radius - 0.1 * CLEARANCE, 0.25, 0.5, 1.0, 0.0, 0.0, 0.0, 0.0])
    assert torch.equal(moved_out(tool, pose, torch.tensor([0.0, 0.0, 0.01]), clay), pose)


def test_no_tool_is_pushed_down() -> None:
    clay, radius = wall(), 0.03
    clay = clay[clay[:, 1] > 0.2]
    pose = torch.tensor([0.5, 0.2 - radius + 0.002, 0.5, 1.0, 0.0, 0.0, 0.0, 0.0])
    tool = ToolSphere(radius=radius, position=(0.5, 0.2, 0.5), action_scale=(0.01, 0.01, 0.01))
    # Below the wall down is the only way off its surface, in between two of its points sideways.
    assert float(push_out(tool, pose, clay, clearance=CLEARANCE, touching=0.0)[1]) >= float(pose[1])


def test_what_cannot_be_chained_is_refused() -> None:
    class SimulatorOld(backend_class("warp")):
        def vjp(self, trajectory, grad_positions, grad_tools=None):
            return super().vjp(trajectory, grad_positions, grad_tools)

    simulator = SimulatorOld(CASES["two tools"], dtype=torch.float64)
    with pytest.raises(CapabilityError, match="SimulatorOld cannot polish several stages together"):
        SimulatorChain(simulator, poses=poses_of(simulator))
    other = backend_class("warp")(CASES["two tools"], dtype=torch.float64)
    with pytest.raises(InputError, match="poses: got no stage"):
        SimulatorChain(other, poses=poses_of(other)[:0])
    chain = SimulatorChain(other, poses=poses_of(other))
    with pytest.raises(InputError, match="actions: got 3 environment steps, expected a multiple of the 2 stages"):
        chain.rollout(stirred(other), actions_for(other, steps=3))
