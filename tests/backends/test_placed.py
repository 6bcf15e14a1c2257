"""Placements as actions: rows that place the tools before a rollout, and their gradients."""

from __future__ import annotations

import math

import pytest
import torch
from backend_cases import BACKENDS, CASES, actions_for, backend_class, scene, stirred, tool

from cpdeform.core.clearance import CLEARANCE
from cpdeform.core.objective import ObjectiveAutograd
from cpdeform.core.rotation import conjugate, multiply
from cpdeform.core.scene import Scene
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.simulator import Simulator, Trajectory
from cpdeform.core.state import State
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.placed import ANGLE, LENGTH, Placing, SimulatorPlaced
from cpdeform.planning.pruner import PrunerNone

STEPS = 3


@pytest.fixture(params=BACKENDS)
def simulator(request: pytest.FixtureRequest) -> Simulator:
    return backend_class(request.param)(CASES["two tools"], dtype=torch.float64, batch_size=2)


def free(simulator: Simulator, *, batch_size: int = 1) -> State:
    """A stirred start whose tools are a little above the clay, so that none has to be moved out."""
    state = stirred(simulator, batch_size=batch_size)
    return state.with_tools(state.tool_pose + state.tool_pose.new_tensor([0.0, 0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]))


def descending(simulator: Simulator, *, batch_size: int = 1) -> torch.Tensor:
    """Actions that lead the tools into the clay."""
    actions = 0.2 * actions_for(simulator, batch_size=batch_size, steps=STEPS)
    offset = 0
    for some in simulator.scene.tools:
        actions[..., offset + 1] -= 0.7
        offset += some.action_size
    return actions


def test_rows_of_zeros_change_nothing(simulator: Simulator) -> None:
    placing, start, plan = Placing(scene=simulator.scene), free(simulator, batch_size=2), descending(simulator, batch_size=2)
    placed = SimulatorPlaced(simulator, placing).rollout(start, placing.before(plan))
    plain = simulator.rollout(start, plan)
    assert torch.equal(placed.positions, plain.positions)
    assert torch.equal(placed.tool_poses, plain.tool_poses)
    slope = torch.ones_like(plain.positions)
    found, expected = SimulatorPlaced(simulator, placing).vjp(placed, slope), simulator.vjp(plain, slope)
    rows, actions = placing.split(found.actions)
    assert torch.equal(actions, expected.actions)
    assert rows.shape == (2, placing.rows, simulator.scene.action_size)
    torch.testing.assert_close(found.initial_state.tool_pose[..., :3], expected.initial_state.tool_pose[..., :3])
    assert torch.equal(found.initial_state.position, expected.initial_state.position)


def test_the_gradient_of_the_rows_is_that_of_finite_differences(simulator: Simulator) -> None:
    placing = Placing(scene=simulator.scene)
    placed, start = SimulatorPlaced(simulator, placing), free(simulator)
    actions = placing.before(descending(simulator))
    generator = torch.Generator().manual_seed(3)
    actions[:, : placing.rows] = 0.2 * torch.randn(actions[:, : placing.rows].shape, generator=generator).to(actions)
    weights = torch.randn(start.position.shape, generator=generator, dtype=torch.float64)

    def loss(tried: torch.Tensor) -> float:
        return float((weights * placed.rollout(start, tried).positions[:, -1]).sum())

    trajectory = placed.rollout(start, actions)
    for some, pose in zip(simulator.scene.tools, trajectory.tool_poses[0, 0], strict=True):
        assert float(signed_distance(some, pose, start.position[0]).min()) > CLEARANCE
    slope = torch.zeros_like(trajectory.positions)
    slope[:, -1] = weights
    gradient = placed.vjp(trajectory, slope).actions[0, : placing.rows].flatten()
    # Two tools, each moved along its way and turned.
    for number in (1, 3, 7, 9):
        step = torch.zeros_like(actions)
        step.flatten()[number] = 1e-5
        difference = (loss(actions + step) - loss(actions - step)) / 2e-5
        assert difference == pytest.approx(float(gradient[number]), rel=2e-3, abs=1e-7 * float(gradient.abs().max()))
        assert difference != 0.0


def two_kinds() -> Scene:
    """A tool that moves and turns, one that only moves, and one that stays."""
    turning = tool("Box", action_scale=(0.01,) * 6, rotation_wxyz=(1.0, 0.0, 0.0, 0.0))
    return scene(
        turning,
        tool("Sphere", position=(0.3, 0.3, 0.5), action_scale=(0.01,) * 3),
        tool("Sphere", position=(0.7, 0.3, 0.5), action_scale=()),
    )


def test_a_number_of_one_moves_a_tool_by_the_length_and_turns_it_by_the_angle() -> None:
    placing = Placing(scene=two_kinds())
    # Twelve numbers for two movable tools in rows of nine.
    assert (placing.rows, placing.scene.action_size) == (2, 9)
    poses = torch.stack([torch.tensor([*some.position, 1.0, 0.0, 0.0, 0.0, 0.0]) for some in placing.scene.tools]).double()
    rows = torch.zeros(1, 2, 9, dtype=torch.float64)
    rows.flatten()[[0, 4, 8]] = 1.0
    found = placing.placed(poses[None], rows)[0]
    torch.testing.assert_close(found[:, :3] - poses[:, :3], LENGTH * torch.eye(3, dtype=torch.float64)[[0, 2, 1]] * _rows(1, 1, 0))
    turn = multiply(found[0, 3:7], conjugate(poses[0, 3:7]))
    torch.testing.assert_close(2.0 * torch.atan2(turn[2], turn[0]), torch.tensor(ANGLE, dtype=torch.float64))
    assert math.isclose(float(found[0, 3:7].norm()), 1.0, abs_tol=1e-12)
    assert torch.equal(found[1:, 3:], poses[1:, 3:])
    # Numbers that are left over do nothing.
    rows[0, 1, 3:] = 1.0
    assert torch.equal(placing.placed(poses[None], rows)[0], found)


def _rows(*factors: int) -> torch.Tensor:
    return torch.tensor(factors, dtype=torch.float64)[:, None]


def test_a_tool_stays_within_its_bounds() -> None:
    bounded = tool("Sphere", position=(0.5, 0.2, 0.5), upper_bound=(0.504, 1.0, 1.0))
    placing = Placing(scene=scene(bounded))
    poses = torch.tensor([[[0.5, 0.2, 0.5, 1.0, 0.0, 0.0, 0.0, 0.0]]])
    rows = torch.ones(1, placing.rows, placing.scene.action_size)
    torch.testing.assert_close(placing.placed(poses, rows)[0, 0, :3], torch.tensor([0.504, 0.2 + LENGTH, 0.5 + LENGTH]))


def test_a_tool_that_would_be_placed_in_the_clay_begins_outside() -> None:
    simulator = backend_class("warp")(CASES["two tools"], dtype=torch.float64)
    placing, start = Placing(scene=simulator.scene, length=0.05), free(simulator)
    actions = placing.before(descending(simulator))
    actions[0, 0, 1] = -1.0
    first = simulator.scene.tools[0]
    inside = placing.placed(start.tool_pose, actions[:, : placing.rows])
    assert float(signed_distance(first, inside[0, 0], start.position[0]).min()) < -CLEARANCE
    placed = SimulatorPlaced(simulator, placing).rollout(start, actions)
    assert float(signed_distance(first, placed.tool_poses[0, 0, 0], start.position[0]).min()) >= 0.99 * CLEARANCE
    # The trajectory tells the rows that place it there.
    rows, plan = placing.split(placed.actions)
    torch.testing.assert_close(placing.placed(start.tool_pose, rows), placed.tool_poses[:, 0])
    assert torch.equal(rows[..., 3:], actions[:, : placing.rows, 3:])
    assert torch.equal(plan, placing.split(actions)[1])
    again = SimulatorPlaced(simulator, placing).rollout(start, placed.actions)
    torch.testing.assert_close(again.positions, placed.positions)


class Height(ObjectiveAutograd):
    """How high the first tool begins."""

    def loss(self, positions: torch.Tensor, tool_poses: torch.Tensor) -> torch.Tensor:
        return tool_poses[:, 0, 0, 1]


def test_a_descent_into_the_clay_stays_on_its_surface() -> None:
    """A plan that sinks has its tool moved out, some day to another side, where the loss leaps."""
    simulator = backend_class("warp")(CASES["two tools"], dtype=torch.float64)
    placing, start = Placing(scene=simulator.scene, length=0.05), free(simulator)
    optimizer = TrajectoryOptimizer(iterations=12, learning_rate=0.1, pruner=PrunerNone(), backtrack=None)
    asked: list[torch.Tensor] = []

    class Told(SimulatorPlaced):
        def rollout(self, state: State, actions: torch.Tensor) -> Trajectory:
            asked.append(placing.placed(state.tool_pose, placing.split(actions)[0])[0, 0])
            return super().rollout(state, actions)

    found = optimizer.minimize(Told(simulator, placing), start, placing.before(descending(simulator)), Height())
    first = simulator.scene.tools[0]
    depths = [float(signed_distance(first, pose, start.position[0]).min()) for pose in asked]
    assert depths[0] > 0.01
    assert min(depths) < 0.0
    # Of twelve steps of 0.005, four lead to the surface; the others do not add up.
    assert min(depths) > -0.0055
    begun = placing.placed(start.tool_pose, placing.split(found.actions)[0])[0, 0]
    assert float(signed_distance(first, begun, start.position[0]).min()) > 0.0


def test_without_a_placing_there_are_no_rows() -> None:
    simulator = backend_class("warp")(CASES["two tools"], dtype=torch.float64)
    plain, start, plan = SimulatorPlaced(simulator, None), free(simulator), descending(simulator)
    assert plain.rows == 0
    assert torch.equal(plain.rollout(start, plan).positions, simulator.rollout(start, plan).positions)
    assert plain.memory_estimate(STEPS) == simulator.memory_estimate(STEPS)
    placing = Placing(scene=simulator.scene)
    assert SimulatorPlaced(simulator, placing).memory_estimate(STEPS + placing.rows) == simulator.memory_estimate(STEPS)
