"""Vector environments: worlds of one simulator that are the single environment, and are reset one by one."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from cpdeform import Task
from cpdeform.core.errors import InputError
from cpdeform_gymnasium import DeformEnv, DeformVectorEnv

OPTIONS: dict[str, Any] = {"backend": "example", "points": 50}
COUNT = 3


def make(task: Task, **options: Any) -> DeformVectorEnv:
    vector = gymnasium.make_vec("cpdeform/Task-v0", num_envs=COUNT, task=task, **{**OPTIONS, **options})
    assert isinstance(vector, DeformVectorEnv)
    return vector


def actions(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (COUNT, 3)).astype(np.float32)


def test_worlds_are_single_environments(task: Task) -> None:
    vector = make(task)
    observations, infos = vector.reset(seed=7)
    assert vector.observation_space.contains(observations)
    for world in range(COUNT):
        single = DeformEnv(task, **OPTIONS)
        observation, info = single.reset(seed=7 + world)
        assert np.array_equal(observations[world], observation)
        assert infos["w1"][world] == pytest.approx(info["w1"])
    single = DeformEnv(task, **OPTIONS)
    single.reset(seed=8)
    for step in range(3):
        observations, rewards, *_ = vector.step(actions(step))
        observation, reward, *_ = single.step(actions(step)[1])
        assert np.allclose(observations[1], observation, atol=1e-6)
        assert rewards[1] == pytest.approx(reward, abs=1e-6)


def test_a_single_world_is_reset_exactly(task: Task) -> None:
    vector, twin = make(task, autoreset_mode="Disabled"), make(task, autoreset_mode="Disabled")
    start, _ = vector.reset(seed=[1, 2, 3])
    twin.reset(seed=[1, 2, 3])
    for step in range(2):
        vector.step(actions(step))
        before, *_ = twin.step(actions(step))
    found, infos = vector.reset(seed=[None, 2, None], options={"reset_mask": np.array([False, True, False])})
    assert np.array_equal(found[1], start[1])
    assert np.array_equal(found[[0, 2]], before[[0, 2]])
    assert infos["_w1"].tolist() == [False, True, False]
    # What follows in the others is what follows without the reset, and what follows in that world is a new episode's course.
    fresh = make(task, autoreset_mode="Disabled")
    fresh.reset(seed=[1, 2, 3])
    expected, *_ = twin.step(actions(5))
    renewed, *_ = fresh.step(actions(5))
    following, *_ = vector.step(actions(5))
    assert np.array_equal(following[[0, 2]], expected[[0, 2]])
    assert np.array_equal(following[1], renewed[1])


def test_episodes_end_and_begin_again(task: Task) -> None:
    vector = make(task, max_episode_steps=2)
    vector.reset(seed=0)
    vector.step(actions(0))
    last, _, _, truncated, _ = vector.step(actions(1))
    assert truncated.all()
    again, rewards, _, truncated, _ = vector.step(actions(2))
    assert not truncated.any()
    assert (rewards == 0.0).all()
    # The tools are back near the start.
    home = task.scene.tools[0].position
    assert (np.linalg.norm(again[:, -7:-4] - home, axis=1) < 0.03).all()
    assert not np.array_equal(again, last)


def test_episodes_end_and_begin_again_in_the_same_step(task: Task) -> None:
    vector = make(task, max_episode_steps=2, autoreset_mode=AutoresetMode.SAME_STEP)
    plain = make(task, autoreset_mode="Disabled")
    vector.reset(seed=0)
    plain.reset(seed=0)
    for step in range(2):
        found, _, _, truncated, infos = vector.step(actions(step))
        expected, *_ = plain.step(actions(step))
    assert truncated.all()
    assert infos["_final_obs"].all()
    assert np.array_equal(np.stack(infos["final_obs"]), expected)
    assert not np.array_equal(found, expected)
    assert infos["w1"].tolist() != infos["final_info"]["w1"].tolist()


def test_an_episode_that_is_over_has_to_be_reset(task: Task) -> None:
    vector = make(task, max_episode_steps=1, autoreset_mode="Disabled")
    vector.reset(seed=0)
    vector.step(actions(0))
    with pytest.raises(InputError, match="reset_mask"):
        vector.step(actions(1))


def test_states_go_from_world_to_world(task: Task) -> None:
    vector = make(task)
    vector.reset(seed=0)
    vector.step(actions(0))
    vector.set_state(2, vector.get_state(0))
    same = np.tile(actions(1)[:1], (COUNT, 1))
    following, rewards, *_ = vector.step(same)
    assert np.array_equal(following[0], following[2])
    assert rewards[0] == rewards[2]
    assert not np.array_equal(following[0], following[1])
    gradient = vector.rollout_gradient(np.zeros((COUNT, 2, 3)))
    assert gradient.rewards.shape == (COUNT, 2)
    assert gradient.gradient.shape == (COUNT, 2, 3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seed": [1, 2]}, "seed"),
        ({"options": {"reset_mask": np.array([True])}}, "reset_mask"),
    ],
)
def test_unusable_resets(task: Task, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make(task).reset(**arguments)


def test_unusable_options(task: Task) -> None:
    with pytest.raises(InputError, match="autoreset_mode"):
        make(task, autoreset_mode="Never")
    with pytest.raises(InputError, match="num_envs"):
        DeformVectorEnv(task, num_envs=0, **OPTIONS)
