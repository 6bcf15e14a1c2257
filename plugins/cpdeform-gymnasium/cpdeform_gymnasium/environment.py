"""A task as a Gymnasium environment."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray

from cpdeform.core.task import Task
from cpdeform_gymnasium.options import action_space, check_render_mode, observation_space
from cpdeform_gymnasium.picture import FRAMES_PER_SECOND, RENDER_MODE, Painter
from cpdeform_gymnasium.worlds import RewardGradient, Snapshot, Worlds

Array = NDArray[Any]


class DeformEnv(gymnasium.Env[Array, Array]):
    """One world of a task: the tools begin where the scene has them, and the agent moves them.

    The observation is PlasticineLab's: positions and velocities of 200 particles, then positions and quaternions of the tools. An
    action holds numbers in [-1, 1], as in `cpdeform.core.scene.Scene`. The reward is the paper's, -(W1 + distance of the tools
    to the clay), or PlasticineLab's own (for Pinch). An episode ends by the step limit that it is registered with; it is
    terminated where the simulation leaves the finite numbers.

    Args:
        task: A task, a registered name, or the path of a YAML file.
        render_mode: None or ``"rgb_array"``.
        options: Further options of `cpdeform_gymnasium.worlds.Worlds`: ``backend``, ``device``, ``reward``,
            ``observed_particles``, ``points``, ``start_noise``, ``limits``, ``iou``, ``scene``, ``simulator_options``,
            ``registry``.

    Attributes:
        worlds: The world, in torch tensors.

    Raises:
        InputError: An option or the task cannot be used.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": [RENDER_MODE], "render_fps": FRAMES_PER_SECOND}  # type: ignore[misc]

    def __init__(self, task: Task | Path | str = "writer", *, render_mode: str | None = None, **options: Any) -> None:
        check_render_mode(render_mode)
        self.render_mode = render_mode
        self.worlds = Worlds(task, **options)
        self.observation_space = observation_space(self.worlds.observation.size)
        self.action_space = action_space(self.worlds.task.scene.action_size)
        self._painter: Painter | None = None

    @property
    def task(self) -> Task:
        """The task with all changes and limits in its scene."""
        return self.worlds.task

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: Seed of this and the following episodes: of the tools' start positions, see `Worlds`.
            options: Not used.
        """
        super().reset(seed=seed)
        self.worlds.reset(0, generator=self.np_random)
        return self._observation(), self._info()

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Take an environment step.

        Args:
            action: Numbers (A,) in [-1, 1].

        Raises:
            InputError: A number is not finite, or outside [-1, 1].
        """
        step = self.worlds.step(torch.as_tensor(np.asarray(action)).reshape(1, -1))
        diverged = bool(step.diverged[0])
        info: dict[str, Any] = {name: float(value[0]) for name, value in step.info.items()}
        info["diverged"] = diverged
        return self._observation(), float(step.reward[0]), diverged, False, info

    def rollout_gradient(self, actions: NDArray[Any], *, discount: float = 1.0) -> RewardGradient:
        """Rewards of actions from here, and the gradient of their sum; the environment stays where it is.

        Args:
            actions: Actions (T, A) in [-1, 1].
            discount: Factor of each further step's reward.

        Returns:
            Rewards (T,) and the gradient (T, A), as torch tensors.

        Raises:
            InputError: The shape does not fit, or an action is not finite or outside [-1, 1].
        """
        found = self.worlds.rollout_gradient(torch.as_tensor(np.asarray(actions)).unsqueeze(0), discount=discount)
        return RewardGradient(found.rewards[0], found.gradient[0])

    def get_state(self) -> Snapshot:
        """A copy of all that the environment is; `set_state` brings it back. The count of a step limit is not part of it."""
        return dataclasses.replace(self.worlds.snapshot(0), random_state=self.np_random.bit_generator.state)

    def set_state(self, state: Snapshot) -> None:
        """Go back to where `get_state` was taken, in this environment or in another one of the same task.

        Raises:
            InputError: The state is one of another scene or reward.
        """
        self.worlds.restore(0, state)
        if state.random_state is not None:
            self.np_random.bit_generator.state = state.random_state

    def render(self) -> NDArray[np.uint8] | None:
        """The clay and the tools as a picture (H, W, 3); None without a render mode."""
        if self.render_mode is None:
            return None
        self._painter = self._painter or Painter(self.task.scene, self.worlds.goal)
        return self._painter.paint(self.worlds.state)

    def _observation(self) -> Array:
        return np.asarray(self.worlds.observe()[0].float().cpu().numpy())

    def _info(self) -> dict[str, Any]:
        return {**{name: float(value[0]) for name, value in self.worlds.measures().items()}, "diverged": False}
