"""Learners as strategies: what they cost, what they execute, and that they begin where the stage does."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode

from cpdeform import Task, deform
from cpdeform.core.errors import InputError
from cpdeform.core.plugins import load_registry
from cpdeform.run.result import RunResult
from cpdeform_baselines.learners.environments import WorldsVecEnv
from cpdeform_baselines.learners.stage import EpisodesVecEnv, _rollouts
from cpdeform_gymnasium import DeformVectorEnv
from cpdeform_gymnasium.rewards import MatchedTransport

NETWORK = {"policy_kwargs": {"net_arch": [8]}}
OPTIONS = {"sac": {**NETWORK, "batch_size": 8}, "td3": {**NETWORK, "batch_size": 8}, "ppo": NETWORK}
EPISODES = 12


def run(task: Task, name: str, *, episodes: int = EPISODES, seed: int = 0) -> RunResult:
    options = {"episodes": episodes, "learner": OPTIONS[name]}
    settings = {"strategy_options": options, "objective": {"points": 100}}
    return deform(task, simulator="example", strategy=name, settings=settings, seed=seed)


@pytest.mark.parametrize("name", OPTIONS)
def test_a_run_costs_its_episodes_and_executes_what_lowers_the_loss(task: Task, name: str) -> None:
    (stage,) = run(task, name).stages
    assert stage.gradient_evaluations == 0
    # The episodes, one of the policy, the two plans that are judged, and the execution.
    assert stage.rollouts == EPISODES + 4
    (candidate,) = stage.candidates
    assert candidate.actions.shape == (task.rollout_steps, task.scene.action_size)
    assert float(candidate.actions.abs().max()) <= 1.0
    # Of a dozen random motions of a ball above a block some press it, as the goal asks for.
    assert stage.loss < stage.loss_before
    assert stage.loss == pytest.approx(candidate.loss, rel=1e-2)
    # The tool begins where the task puts it.
    assert stage.tool_poses[0, 0, :3].tolist() == pytest.approx(task.scene.tools[0].position)


def test_a_seed_repeats_and_another_one_does_not(task: Task) -> None:
    first, again, other = (run(task, "ppo", episodes=4, seed=seed).stages[0].candidates[0].actions for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def vector(task: Task, **options) -> DeformVectorEnv:
    return DeformVectorEnv(
        task, num_envs=2, max_episode_steps=3, autoreset_mode=AutoresetMode.SAME_STEP, start_noise=0.0, iou=False, **options
    )


def test_the_best_episode_can_be_executed_again(task: Task) -> None:
    """Its actions, from the same start, end at the W1 that it had, which no other episode is below."""
    simulator = load_registry().create("simulator", "example", scene=task.scene, batch_size=2)
    start = simulator.initial_state(batch_size=1)
    environment = EpisodesVecEnv(vector(task, simulator=simulator, start=start))
    environment.reset()
    assert environment.best is None
    generator, distances = np.random.default_rng(0), []
    for _ in range(12):
        environment.step_async(generator.uniform(-1.0, 1.0, (2, 3)).astype(np.float32))
        *_, done, infos = environment.step_wait()
        distances += [info["w1"] for info, over in zip(infos, done, strict=True) if over]
    assert len(distances) == 8
    assert environment.best_distance == min(distances) < max(distances)
    end = simulator.rollout(start, environment.best[None]).final_state.position
    measured = MatchedTransport(task, torch.as_tensor(task.load_goal())).distance(end)
    assert float(measured[0]) == pytest.approx(environment.best_distance, abs=1e-6)


def test_episodes_begin_where_the_stage_does(task: Task) -> None:
    simulator = load_registry().create("simulator", "example", scene=task.scene, batch_size=2)
    press = torch.tensor([0.0, -1.0, 0.0]).repeat(1, 4, 1)
    later = simulator.rollout(simulator.initial_state(batch_size=1), press).final_state
    environment = WorldsVecEnv(vector(task, simulator=simulator, start=later))
    environment.reset()
    state = environment.environment.worlds.state
    assert torch.equal(state.position, later.position.expand(2, -1, -1).to(state.position))
    assert torch.equal(state.tool_pose, later.tool_pose.expand(2, -1, -1).to(state.tool_pose))
    # A simulator's steps one by one are those of a rollout.
    step = environment.step(np.full((2, 3), 0.5, dtype=np.float32))
    assert not step[2].any()
    expected = simulator.rollout(later, torch.full((1, 1, 3), 0.5)).final_state.position
    torch.testing.assert_close(environment.environment.worlds.state.position[:1], expected)


def test_a_simulator_has_to_fit(task: Task) -> None:
    simulator = load_registry().create("simulator", "example", scene=task.scene, batch_size=1)
    with pytest.raises(InputError, match=r"simulator.*room for 1.*room for 2 worlds"):
        vector(task, simulator=simulator)
    other = task.model_copy(update={"scene": task.scene.model_copy(update={"ground_friction": 2.5})})
    with pytest.raises(InputError, match="one of another scene"):
        vector(other, simulator=simulator)


@pytest.mark.parametrize(("steps", "worlds"), [(16, 1), (96, 2), (100, 5), (700, 8), (20_000, 8)])
def test_proximal_policy_pays_for_its_rollouts(steps: int, worlds: int) -> None:
    found = _rollouts("ppo", steps, worlds)
    assert found["n_steps"] * worlds * 4 <= max(steps, 8 * worlds)
    assert (found["n_steps"] * worlds) % found["batch_size"] == 0
    assert found["batch_size"] > 1


def test_proximal_policy_spends_no_more_than_its_episodes(task: Task) -> None:
    """Of 11 episodes of 4 steps in 8 worlds, rollouts of 16 steps: two, and no third one."""
    (stage,) = run(task, "ppo", episodes=11).stages
    assert stage.rollouts == 2 * 16 // task.step_count + 4


@pytest.mark.parametrize(("options", "message"), [({"episodes": 0}, "episodes"), ({"learner": {"speed": 3}}, "options of sac")])
def test_unusable_options(task: Task, options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        deform(task, simulator="example", strategy="sac", settings={"strategy_options": options})
