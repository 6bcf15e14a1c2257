"""The transport objective with a transparent solver: what it solves, when it starts warm, where gradients go."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.ot import OTCapabilities, OTResult, OTSolver
from cpdeform.core.scene import BodyBox, Scene, ToolSphere
from cpdeform.core.simulator import Trajectory
from cpdeform.core.state import initial_state
from cpdeform.planning.objectives.contact import contact_loss
from cpdeform.planning.objectives.transport import ObjectiveTransport

SCENE = Scene(
    bodies=(BodyBox(position=(0.5, 0.4, 0.5), widths=(0.3, 0.3, 0.3), particle_count=12),),
    tools=(ToolSphere(position=(0.5, 0.7, 0.5), radius=0.05, action_scale=(0.01, 0.01, 0.01)),),
)


class OTSolverMean(OTSolver):
    """Half the squared distance of the means; records its calls."""

    capabilities = OTCapabilities("entropic", debiased=True, warm_start=True, devices=("cpu",), potential_tolerance=1.0)

    def __init__(self) -> None:
        self.calls: list[tuple[Tensor, Tensor, OTResult | None]] = []

    def solve(
        self,
        source: Tensor,
        target: Tensor,
        *,
        source_weights: Tensor | None = None,
        target_weights: Tensor | None = None,
        previous: OTResult | None = None,
    ) -> OTResult:
        self.calls.append((source, target, previous))
        offset = source.mean(dim=0) - target.mean(dim=0)
        gradient = (offset / source.shape[0]).expand_as(source)
        potential = torch.zeros(source.shape[0])
        return OTResult(0.5 * offset @ offset, potential, potential, gradient, True, 1, 0.0, 0.0)

    @property
    def warm(self) -> list[bool]:
        return [previous is not None for _, _, previous in self.calls]


def trajectory(worlds: int = 2) -> Trajectory:
    state = initial_state(SCENE, batch_size=worlds, dtype=torch.float64)
    noise = torch.randn(worlds, 4, 12, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    positions = state.position.unsqueeze(1) + 0.02 * noise
    poses = state.tool_pose.unsqueeze(1).repeat(1, 4, 1, 1)
    return Trajectory(positions, poses, torch.zeros(worlds, 3, 3, dtype=torch.float64), state, state)


def make_goal(count: int = 12) -> Tensor:
    return torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(5))


def test_value_and_gradient_of_the_last_step() -> None:
    path = trajectory()
    result = ObjectiveTransport(OTSolverMean(), make_goal()).evaluate(path)
    positions = path.positions.clone().requires_grad_()
    expected = 0.5 * ((positions[:, -1].mean(dim=1) - make_goal().mean(dim=0)) ** 2).sum(dim=1)
    (gradient,) = torch.autograd.grad(expected.sum(), positions)
    assert torch.allclose(result.loss, expected.detach())
    assert torch.allclose(result.grad_positions, gradient)
    assert result.grad_tools is None


def test_contact_term_is_added_over_the_steps() -> None:
    path, solver = trajectory(), OTSolverMean()
    plain = ObjectiveTransport(solver, make_goal()).evaluate(path)
    result = ObjectiveTransport(solver, make_goal(), contact_weight=3.0, scene=SCENE).evaluate(path)
    positions, poses = path.positions.clone().requires_grad_(), path.tool_poses.clone().requires_grad_()
    contact = 3.0 * contact_loss(SCENE, positions[:, 1:], poses[:, 1:]).sum(dim=1)
    gradients = torch.autograd.grad(contact.sum(), [positions, poses])
    assert torch.allclose(result.loss, plain.loss + contact.detach())
    assert torch.allclose(result.grad_positions, plain.grad_positions + gradients[0])
    assert result.grad_tools is not None
    assert torch.allclose(result.grad_tools, gradients[1])
    assert not path.positions.requires_grad


def test_contact_term_of_a_scene_without_tools_is_zero() -> None:
    bare = SCENE.model_copy(update={"tools": ()})
    path = trajectory()
    result = ObjectiveTransport(OTSolverMean(), make_goal(), contact_weight=3.0, scene=bare).evaluate(path)
    assert torch.equal(result.loss, ObjectiveTransport(OTSolverMean(), make_goal()).evaluate(path).loss)


def test_subset_is_fixed_shared_and_reproducible() -> None:
    path, solver = trajectory(worlds=1), OTSolverMean()
    goal = path.positions[0, -1].clone()
    objective = ObjectiveTransport(solver, goal, points=5, seed=3)
    result = objective.evaluate(path)
    objective.evaluate(path)
    ObjectiveTransport(solver, goal, points=5, seed=3).evaluate(path)
    ObjectiveTransport(solver, goal, points=5, seed=4).evaluate(path)
    sources = [source for source, _, _ in solver.calls]
    assert sources[0].shape == (5, 3)
    assert all(torch.equal(source, cloud) for source, cloud, _ in solver.calls)
    assert torch.equal(sources[0], sources[1])
    assert torch.equal(sources[0], sources[2])
    assert not torch.equal(sources[0], sources[3])
    assert float(result.loss[0]) == 0.0
    moved = ObjectiveTransport(solver, goal + 0.1, points=5, seed=3).evaluate(path)
    assert int((moved.grad_positions[0, -1].norm(dim=-1) > 0).sum()) == 5


def test_clouds_of_different_size_have_their_own_subsets() -> None:
    solver = OTSolverMean()
    ObjectiveTransport(solver, make_goal(30), points=20).evaluate(trajectory(worlds=1))
    assert [tuple(cloud.shape) for cloud in solver.calls[0][:2]] == [(12, 3), (20, 3)]


def test_warm_starts_refresh_and_reset() -> None:
    path, solver = trajectory(worlds=1), OTSolverMean()
    objective = ObjectiveTransport(solver, make_goal(), refresh=3)
    # The chain is the caller's: it hands each result's `warm` to the next call.
    warm = objective.evaluate(path).warm
    moved = dataclasses.replace(path, positions=path.positions + 1e-3)
    for _ in range(5):
        warm = objective.evaluate(moved, warm).warm
    objective.evaluate(path)
    assert solver.warm == [False, True, True, True, False, True, False]


def test_every_batch_starts_from_the_solution_of_the_stages_start() -> None:
    solver = OTSolverMean()
    objective = ObjectiveTransport(solver, make_goal(), refresh=2)
    start = objective.evaluate(trajectory(worlds=1))
    assert start.warm is not None
    for _ in range(2):
        found = objective.evaluate(trajectory(), start.warm * 2)
    assert solver.warm == [False, True, True, True, True]
    assert all(call[2] is not None and float(call[2].value) == float(start.loss[0]) for call in solver.calls[1:])
    found = objective.evaluate(trajectory(), found.warm)
    objective.evaluate(trajectory(), found.warm)
    assert solver.warm[5:] == [True, True, False, False]
    with pytest.raises(InputError, match="warm: got 1 entries, expected 2"):
        objective.evaluate(trajectory(), start.warm)
    with pytest.raises(InputError, match="of an earlier result of this objective"):
        objective.evaluate(trajectory(), ["something", "else"])


def test_a_start_that_is_known_is_not_solved_again() -> None:
    """A stage begins with the particles that the one before ended with."""
    solver, path = OTSolverMean(), trajectory(worlds=1)
    objective = ObjectiveTransport(solver, make_goal(), coast_steps=2.0)
    first = objective.evaluate(path)
    objective.evaluate(trajectory())
    still = dataclasses.replace(path, positions=path.positions[:, -1:].repeat(1, 4, 1, 1))
    again = objective.evaluate(still, first.warm)
    assert len(solver.calls) == 3
    # Only the term for particles that still move differs.
    cost = ObjectiveTransport(OTSolverMean(), make_goal()).evaluate(still)
    torch.testing.assert_close(again.loss, cost.loss)
    torch.testing.assert_close(again.grad_positions[:, -1], cost.grad_positions[:, -1])
    assert float(first.loss[0]) > float(again.loss[0])
    assert again.warm is not None
    objective.evaluate(trajectory(), again.warm * 2)
    assert [call[2] is not None and float(call[2].value) == float(cost.loss[0]) for call in solver.calls[3:]] == [True, True]


def test_every_world_starts_from_its_own_solution() -> None:
    solver = OTSolverMean()
    objective = ObjectiveTransport(solver, make_goal())
    first = objective.evaluate(trajectory())
    moved = trajectory()
    objective.evaluate(dataclasses.replace(moved, positions=moved.positions + 1e-3), first.warm)
    assert [float(call[2].value) for call in solver.calls[2:] if call[2] is not None] == first.loss.tolist()
    objective.evaluate(trajectory(worlds=1))
    assert solver.warm == [False, False, True, True, False]


def test_without_warm_starts() -> None:
    solver = OTSolverMean()
    objective = ObjectiveTransport(solver, make_goal(), warm_start=False)
    objective.evaluate(trajectory())
    objective.evaluate(trajectory())
    assert not any(solver.warm)


def test_options_are_checked() -> None:
    solver = OTSolverMean()
    with pytest.raises(InputError, match="points: got 0"):
        ObjectiveTransport(solver, make_goal(), points=0)
    with pytest.raises(InputError, match="refresh: got 0"):
        ObjectiveTransport(solver, make_goal(), refresh=0)
    with pytest.raises(InputError, match="contact_weight: got nan"):
        ObjectiveTransport(solver, make_goal(), contact_weight=float("nan"), scene=SCENE)
    with pytest.raises(InputError, match="scene: got None"):
        ObjectiveTransport(solver, make_goal(), contact_weight=1.0)
    with pytest.raises(InputError, match="goal: got shape"):
        ObjectiveTransport(solver, torch.zeros(0, 3))


def exact_distance(source: Tensor, target: Tensor) -> float:
    """Wasserstein-1 distance of two clouds of equal size."""
    cost = torch.cdist(source, target).numpy()
    return float(cost[linear_sum_assignment(cost)].mean())


def test_coasting_bounds_the_distance_later_and_has_the_right_gradient() -> None:
    path, goal, steps = trajectory(), make_goal(), 5.0
    positions = path.positions.clone()
    generator = torch.Generator().manual_seed(3)
    positions[:, -1] = positions[:, -2] + 0.01 * torch.randn(positions[:, -1].shape, generator=generator, dtype=torch.float64)

    def coast(moved: Tensor) -> tuple[Tensor, Tensor]:
        moved_path = dataclasses.replace(path, positions=moved)
        plain = ObjectiveTransport(OTSolverMean(), goal).evaluate(moved_path)
        coasting = ObjectiveTransport(OTSolverMean(), goal, coast_steps=steps).evaluate(moved_path)
        return coasting.loss - plain.loss, coasting.grad_positions - plain.grad_positions

    distance, slope = coast(positions)
    step = positions[:, -1] - positions[:, -2]
    assert torch.allclose(distance, steps * step.norm(dim=-1).mean(dim=-1), rtol=1e-2)
    for now, further, added in zip(positions[:, -1], step, distance, strict=True):
        assert exact_distance(now + steps * further, goal) <= exact_distance(now, goal) + float(added) + 1e-4
    direction = torch.randn(positions.shape, generator=generator, dtype=torch.float64)
    numerical = (coast(positions + 1e-6 * direction)[0] - coast(positions - 1e-6 * direction)[0]) / 2e-6
    assert torch.allclose((slope * direction).sum(dim=(1, 2, 3)), numerical, rtol=1e-5)
    at_rest = positions.clone()
    at_rest[:, -1] = at_rest[:, -2]
    assert all(not part.any() for part in coast(at_rest))


def test_axis_scale_counts_one_coordinate_more_and_has_the_right_gradient() -> None:
    path, goal = trajectory(), make_goal()

    def transport(positions: Tensor, scale: tuple[float, float, float]) -> tuple[Tensor, Tensor]:
        objective = ObjectiveTransport(OTSolverMean(), goal, axis_scale=scale)
        result = objective.evaluate(dataclasses.replace(path, positions=positions))
        return result.loss, result.grad_positions

    offset = path.positions[:, -1].mean(dim=1) - goal.mean(dim=0)
    factors = torch.tensor([1.0, 4.0, 0.5], dtype=torch.float64)
    loss, gradient = transport(path.positions, (1.0, 4.0, 0.5))
    assert torch.allclose(loss, 0.5 * (factors * offset).square().sum(dim=1))
    direction = torch.randn(path.positions.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    ahead, back = (transport(path.positions + sign * 1e-6 * direction, (1.0, 4.0, 0.5))[0] for sign in (1, -1))
    assert torch.allclose((gradient * direction).sum(dim=(1, 2, 3)), (ahead - back) / 2e-6, rtol=1e-6)
    with pytest.raises(InputError, match=r"axis_scale: got \(1.0, 0.0, 1.0\)"):
        ObjectiveTransport(OTSolverMean(), goal, axis_scale=(1.0, 0.0, 1.0))
