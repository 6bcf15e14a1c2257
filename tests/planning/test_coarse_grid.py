"""A coarser grid: its floor, walls, tools and clocks, and clay that falls, rests and is pushed there as on the fine one."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from cpdeform_toy.parts import OTSolverToy

from cpdeform.core.placer import Candidate, Proposal, Stage
from cpdeform.core.plugins import AUTO, load_registry
from cpdeform.core.scene import BodyBox, Scene, ToolSphere
from cpdeform.core.task import load_task
from cpdeform.planning.coarse import CoarseModel, on_coarser_grid
from cpdeform.planning.objectives.shape import ObjectiveShape
from cpdeform.planning.objectives.transport import ObjectiveTransport
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.pruner import PrunerNone
from cpdeform.planning.still import still_trajectory
from cpdeform.planning.workbench import Workbench

FLOOR = 3 / 64
BALL = ToolSphere(radius=0.04, position=(0.36, FLOOR + 0.045, 0.5), friction=0.9, action_scale=(0.01, 0.01, 0.01))


def make_scene(*, height=FLOOR, ground=0.0, count=4096, tools=(BALL,)):
    body = BodyBox(position=(0.5, height + ground + 0.05, 0.5), widths=(0.16, 0.1, 0.16), particle_count=count)
    return Scene(bodies=(body,), tools=tools, ground_height=ground)


def make_simulator(scene):
    registry = load_registry()
    name = registry.resolve("simulator", AUTO, device="cpu")
    return registry.create("simulator", name, scene=scene, batch_size=2, dtype=torch.float64)


def make_model(scene):
    simulator = make_simulator(scene)
    start = simulator.initial_state(batch_size=1)
    goal = start.position[0] + torch.tensor([0.02, 0.0, 0.0], dtype=torch.float64)
    objective = ObjectiveShape(ObjectiveTransport(OTSolverToy(), goal, scene=scene), scene, goal, start.position[0])
    return simulator, start, objective, CoarseModel.of(simulator, objective)


@pytest.mark.parametrize("name", ["star", "airplane", "pinch", "move++"])
def test_the_coarse_scene_keeps_time_floor_and_filling(name):
    scene = load_task(name).scene
    coarse = on_coarser_grid(scene)
    found = coarse.scene
    assert found.grid_size == scene.grid_size // 2
    assert found.time_step * found.substeps == pytest.approx(scene.time_step * scene.substeps)
    assert 1.8 * scene.time_step <= found.time_step <= 2.0 * scene.time_step
    assert found.resting_height == pytest.approx(scene.resting_height + coarse.lift, abs=1e-12)
    assert 0.0 <= coarse.lift <= 3 / 64 + 1e-12
    assert found.particle_count == pytest.approx(scene.particle_count / 8, rel=0.01)
    for tool, raised in zip(scene.tools, found.tools, strict=True):
        assert raised.lower_bound[1] - tool.lower_bound[1] == pytest.approx(coarse.lift)


def test_thin_tools_thin_clay_and_few_particles_stay_on_their_grid():
    assert on_coarser_grid(load_task("chopsticks-v1").scene) is None
    assert on_coarser_grid(make_scene(count=3000)) is None
    thin = BodyBox(position=(0.5, 0.2, 0.5), widths=(0.3, 0.03, 0.3), particle_count=5000)
    assert on_coarser_grid(make_scene().model_copy(update={"bodies": (thin,)})) is None


def test_clay_near_a_wall_stays_on_its_grid():
    scene = make_scene()
    body = scene.bodies[0].model_copy(update={"position": (0.15, 0.1, 0.5)})
    _, _, _, model = make_model(scene.model_copy(update={"bodies": (body,)}))
    assert model.simulator.scene.grid_size == 64


@pytest.mark.parametrize("ground", [0.0, 0.27])
def test_clay_falls_and_lands_alike(ground):
    simulator, start, _, model = make_model(make_scene(height=FLOOR + 0.012, ground=ground, tools=()))
    lift = model.simulator.scene.resting_height - simulator.scene.resting_height
    ends = []
    own = torch.arange(len(model.kept))
    for which, state, rise, same in ((simulator, start, 0.0, model.kept), (model.simulator, model.thinned(start), lift, own)):
        trajectory = which.rollout(state, torch.zeros(1, 60, 0, dtype=torch.float64))
        heights = trajectory.positions[0, :, same, 1] - rise
        ends.append((heights[5].mean(), heights[60].mean(), heights[60].min()))
    fine, coarse = ends
    # Free fall knows no grid.
    assert float(coarse[0] - fine[0]) == pytest.approx(0.0, abs=1e-6)
    # On the floor within a quarter of the wide cells.
    assert float(coarse[1] - fine[1]) == pytest.approx(0.0, abs=0.25 / 32)
    assert float(coarse[2] - fine[2]) == pytest.approx(0.0, abs=0.25 / 32)


def test_a_push_moves_the_clay_alike_and_its_plan_is_improved():
    scene = make_scene()
    simulator, start, objective, model = make_model(scene)
    task = load_task("pinch").model_copy(update={"scene": scene, "step_count": 8, "rest_steps": 2})
    loss = float(objective.evaluate(still_trajectory(start, 10, scene=scene)).loss[0])
    stage = Stage(0, scene, start, objective.goal, None, torch.Generator(), loss=loss, step_count=8)
    bench = Workbench(stage=stage, task=task, simulator=simulator, objective=objective)
    push = torch.zeros(10, 3, dtype=torch.float64)
    push[:8, 0] = 0.5
    plans = [
        Candidate(Proposal(start.tool_pose[0], 0.0, "push", None), float("nan"), plan) for plan in (push, torch.zeros_like(push))
    ]
    coarse, fine = model.rollout_losses(bench, plans, phase="screening"), bench.rollout_losses(plans, None, phase="screening")
    assert float(coarse[0] - coarse[1]) == pytest.approx(float(fine[0] - fine[1]), rel=0.3)
    assert float(fine[0]) < float(fine[1])
    spent, gradients = bench.rollouts, bench.gradient_evaluations
    found = model.minimize(bench, plans[:1], TrajectoryOptimizer(iterations=3, pruner=PrunerNone()), phase="polish")
    assert float(found.loss[0]) < float(coarse[0])
    # A coarse gradient counts as a rollout.
    assert (bench.rollouts - spent, bench.gradient_evaluations) == (3, gradients)
    better = dataclasses.replace(plans[0], actions=found.actions[0])
    assert float(bench.rollout_losses([better], None, phase="trial")[0]) < float(fine[0])
