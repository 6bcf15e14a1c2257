"""Single environments: the interface that Gymnasium checks, seeds, states, rewards and gradients."""

from __future__ import annotations

import pickle

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

import cpdeform_gymnasium
from cpdeform import Task
from cpdeform.core.errors import InputError
from cpdeform.core.signed_distance import signed_distance
from cpdeform_gymnasium import DeformEnv

OPTIONS = {"backend": "example", "points": 50}
PRESS = np.array([0.0, -1.0, 0.0], dtype=np.float32)


@pytest.fixture
def environment(task: Task) -> DeformEnv:
    return DeformEnv(task, **OPTIONS)


def walk(environment: DeformEnv, count: int = 3) -> list[np.ndarray]:
    return [environment.step(PRESS)[0] for _ in range(count)]


@pytest.mark.filterwarnings("ignore:.*observation space m.*imum value is -?infinity")
@pytest.mark.filterwarnings("ignore:.*different render modes.*as it requires the environment spec")
def test_gymnasiums_own_check(task: Task) -> None:
    environment = gymnasium.make("cpdeform/Task-v0", task=task, render_mode="rgb_array", **OPTIONS)
    check_env(environment.unwrapped)
    environment.reset(seed=0)
    picture = environment.render()
    assert picture.ndim == 3
    assert picture.std() > 10.0
    environment.step(PRESS)
    assert not np.array_equal(environment.render(), picture)


def test_every_task_and_variant_is_registered_under_both_names() -> None:
    ids = cpdeform_gymnasium.environment_ids()
    assert ids["cpdeform/Writer-v2"] == ids["cpdeform/writer-v2"] == "writer-v2"
    assert ids["cpdeform/RollingPin-v1"] == ids["cpdeform/rolling-pin-v1"] == "rolling-pin-v1"
    assert ids["cpdeform/WriterPlusPlus-v1"] == ids["cpdeform/writer-plus-plus-v1"] == "writer++"
    assert set(ids) <= set(gymnasium.registry)
    # Nine tasks of five variants and eight without, each under two names.
    assert len(ids) == 2 * (9 * 5 + 8)
    assert gymnasium.spec("cpdeform/Writer-v1").max_episode_steps == 50
    assert gymnasium.spec("cpdeform/Star-v1").max_episode_steps == 12 * 15


def test_a_seed_repeats_and_two_differ(environment: DeformEnv) -> None:
    first, _ = environment.reset(seed=3)
    further, _ = environment.reset()
    again, _ = environment.reset(seed=3)
    other, _ = environment.reset(seed=4)
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert not np.array_equal(first, further)
    # It is the tool that is elsewhere, free of the clay; the clay is the task's own.
    assert np.array_equal(first[:-7], other[:-7])
    pose = torch.as_tensor(other[-7:])
    padded = torch.cat([pose, torch.zeros(1)])
    tool = environment.task.scene.tools[0]
    assert float(signed_distance(tool, padded, environment.worlds.state.position[0].float()).min()) >= 0.0


def test_a_seed_determines_the_whole_episode(task: Task) -> None:
    one, two = DeformEnv(task, **OPTIONS), DeformEnv(task, **OPTIONS)
    one.reset(seed=5)
    two.reset(seed=5)
    for first, second in zip(walk(one), walk(two), strict=True):
        assert np.array_equal(first, second)


def test_without_noise_episodes_begin_at_the_scene(task: Task) -> None:
    environment = DeformEnv(task, start_noise=0.0, **OPTIONS)
    first, _ = environment.reset(seed=1)
    second, _ = environment.reset(seed=2)
    assert np.array_equal(first, second)
    assert np.allclose(second[-7:-4], task.scene.tools[0].position)


def test_what_is_observed(environment: DeformEnv) -> None:
    environment.reset(seed=0)
    observation = environment.step(PRESS)[0]
    state = environment.worlds.state
    clay = observation[:600].reshape(100, 6)
    assert np.allclose(clay[:, :3], state.position[0].numpy())
    assert np.allclose(clay[:, 3:], state.velocity[0].numpy())
    assert np.allclose(observation[600:], state.tool_pose[0, 0, :7].numpy())


def test_rewards(environment: DeformEnv, task: Task) -> None:
    environment.reset(seed=0)
    _, reward, terminated, truncated, info = environment.step(-PRESS)
    assert reward == pytest.approx(-(info["w1"] + info["tool_distance"]))
    assert info["tool_distance"] > 0.01
    assert not terminated
    assert not truncated
    assert 0.0 < info["iou"] < 1.0
    # At the goal itself W1 is zero, since its particles are the body's.
    worlds = environment.worlds
    goal = torch.as_tensor(task.load_goal()).unsqueeze(0)
    assert float(worlds.reward.terms(goal, worlds.state.tool_pose)["w1"][0]) < 1e-7
    other = DeformEnv(task, reward="plasticinelab", **OPTIONS)
    other.reset(seed=0)
    start = other.worlds.start_terms()
    _, reward, _, _, info = other.step(PRESS)
    weights = {"density": 10.0, "sdf": 10.0, "contact": 1.0}
    assert reward == pytest.approx(sum(weight * (float(start[name][0]) - info[name]) for name, weight in weights.items()))


def test_states_come_back_exactly(environment: DeformEnv) -> None:
    environment.reset(seed=0)
    walk(environment, 2)
    kept = pickle.loads(pickle.dumps(environment.get_state()))
    expected = [environment.step(PRESS) for _ in range(2)]
    following, _ = environment.reset()
    environment.set_state(kept)
    for observation, reward, _, _, info in expected:
        found = environment.step(PRESS)
        assert np.array_equal(found[0], observation)
        assert (found[1], found[4]) == (reward, info)
    assert np.array_equal(environment.reset()[0], following)


def test_the_gradient_is_that_of_the_rewards(task: Task) -> None:
    environment = DeformEnv(task, simulator_options={"dtype": torch.float64}, **OPTIONS)
    environment.reset(seed=0)
    generator = np.random.default_rng(0)
    actions = np.tile(PRESS.astype(np.float64), (3, 1)) * 0.7 + 0.05 * generator.normal(size=(3, 3))
    before = environment.get_state()
    found = environment.rollout_gradient(actions, discount=0.9)
    assert torch.equal(environment.get_state().state.position, before.state.position)
    direction, step = generator.normal(size=(3, 3)), 1e-5

    def value(shift: float) -> float:
        environment.set_state(before)
        moved = environment.worlds.rollout_gradient(torch.as_tensor(actions + shift * direction).unsqueeze(0)).rewards[0]
        return float((moved * torch.tensor([1.0, 0.9, 0.81])).sum())

    slope = (value(step) - value(-step)) / (2.0 * step)
    assert float((found.gradient * torch.as_tensor(direction)).sum()) == pytest.approx(slope, rel=1e-3)
    assert abs(slope) > 1e-4
    environment.set_state(before)
    stepped = [environment.step(action)[1] for action in actions]
    assert stepped == pytest.approx(found.rewards.tolist(), rel=1e-9)


def test_a_simulation_that_diverges_ends_the_episode(environment: DeformEnv) -> None:
    environment.reset(seed=0)
    before = environment.get_state()
    simulate = environment.worlds.simulator.simulate

    def diverging(state, actions):
        trajectory = simulate(state, actions)
        trajectory.final_state.velocity[0, 0, 0] = torch.nan
        return trajectory

    environment.worlds.simulator.simulate = diverging
    observation, reward, terminated, _, info = environment.step(PRESS)
    assert terminated
    assert info["diverged"]
    assert np.isfinite(observation).all()
    assert reward < -1.0
    assert torch.equal(environment.get_state().state.position, before.state.position)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"reward": "iou"}, "reward"),
        ({"render_mode": "human"}, "render_mode"),
        ({"observed_particles": 0}, "observed_particles"),
        ({"points": 0}, "points"),
        ({"start_noise": -1.0}, "start_noise"),
    ],
)
def test_unusable_options(task: Task, options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        DeformEnv(task, **{**OPTIONS, **options})


def test_unusable_actions_and_states(environment: DeformEnv, task: Task) -> None:
    environment.reset(seed=0)
    with pytest.raises(InputError, match="actions"):
        environment.step(3.0 * PRESS)
    state = environment.get_state()
    with pytest.raises(InputError, match="same task with the same reward"):
        DeformEnv(task, reward="plasticinelab", **OPTIONS).set_state(state)
