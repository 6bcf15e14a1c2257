"""The environments that learners see: worlds of one simulator behind stable-baselines3's interface."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from cpdeform.core.plugins import load_registry
from cpdeform.core.task import Task, load_task
from cpdeform_baselines.learners.configuration import LearnerConfiguration
from cpdeform_gymnasium import DeformEnv, DeformVectorEnv
from cpdeform_gymnasium.registration import episode_steps

Array = NDArray[Any]


class WorldsVecEnv(VecEnv):
    """A vector environment of cpdeform as one of stable-baselines3.

    Args:
        environment: Resets worlds in the step that ends their episode.
    """

    def __init__(self, environment: DeformVectorEnv) -> None:
        self.environment = environment
        self.render_mode = None
        super().__init__(environment.num_envs, environment.single_observation_space, environment.single_action_space)
        self._actions: Array = np.zeros(0)

    def reset(self) -> Array:
        """Begin episodes in all worlds, by the seeds that were given to `seed`."""
        seeds = [None if seed is None else int(seed) for seed in self._seeds]
        self._reset_seeds()
        return self.environment.reset(seed=seeds)[0]

    def step_async(self, actions: Array) -> None:
        """Take note of the actions (B, A)."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Take the step; an episode that ends has its last observation in the infos."""
        observations, rewards, terminated, truncated, infos = self.environment.step(self._actions)
        done = terminated | truncated
        found: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for world in np.flatnonzero(done).tolist():
            found[world] = {
                "terminal_observation": infos["final_obs"][world],
                "TimeLimit.truncated": bool(truncated[world] and not terminated[world]),
                "w1": float(infos["final_info"]["w1"][world]),
            }
        return observations, rewards.astype(np.float32), done, found

    def close(self) -> None:
        """Nothing is open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The vector environment's own attribute, for each world asked for."""
        return [getattr(self.environment, attr_name, None) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Worlds have no attributes of their own."""
        raise NotImplementedError("worlds of one simulator have no attributes of their own")

    def env_method(self, method_name: str, *arguments: Any, indices: Any = None, **options: Any) -> list[Any]:
        """Worlds have no methods of their own."""
        raise NotImplementedError("worlds of one simulator have no methods of their own")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No world is wrapped."""
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[Array | None]:
        """A picture of each world, where there is a render mode."""
        return self.environment.render() or [None] * self.num_envs


def steps_of(configuration: LearnerConfiguration, task: Task) -> int:
    """Steps of an episode."""
    return configuration.episode_steps or episode_steps(task.rollout_steps, task.stage_count)


def make_vector(configuration: LearnerConfiguration) -> DeformVectorEnv:
    """The environment of a training."""
    task = load_task(configuration.task)
    return DeformVectorEnv(
        task,
        num_envs=configuration.worlds,
        max_episode_steps=steps_of(configuration, task),
        autoreset_mode=AutoresetMode.SAME_STEP,
        backend=configuration.backend,
        device=configuration.device,
        reward=configuration.reward,
        iou=False,
        simulator_options=_simulator_options(configuration),
    )


def _simulator_options(configuration: LearnerConfiguration) -> dict[str, Any]:
    """Gradients go step by step: a step of many worlds is computed twice rather than kept, where that can be asked for."""
    registry = load_registry()
    name = registry.resolve("simulator", configuration.backend, device=configuration.device)
    return {"memory_budget": 0} if "memory_budget" in (registry.option_names("simulator", name) or ()) else {}


def make_single(configuration: LearnerConfiguration) -> tuple[DeformEnv, int]:
    """The environment that a policy is judged in: the task's very start; and the steps of its episode."""
    task = load_task(configuration.task)
    environment = DeformEnv(
        task, backend=configuration.backend, device=configuration.device, reward=configuration.reward, start_noise=0.0
    )
    return environment, steps_of(configuration, task)
