"""Many worlds of a task as one Gymnasium vector environment."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from cpdeform.core.errors import InputError
from cpdeform.core.task import Task
from cpdeform_gymnasium.options import action_space, check_render_mode, observation_space
from cpdeform_gymnasium.picture import FRAMES_PER_SECOND, RENDER_MODE, Painter
from cpdeform_gymnasium.worlds import RewardGradient, Snapshot, Worlds

Array = NDArray[Any]


class DeformVectorEnv(VectorEnv[Array, Array, Array]):
    """Sub-environments that are worlds of one simulator: a step of all of them is one call.

    World i is the single environment `DeformEnv` of the same options, seeded with ``seed + i``.

    Args:
        task: A task, a registered name, or the path of a YAML file.
        num_envs: Number of worlds B.
        max_episode_steps: Steps after which a world's episode is truncated; None for never.
        autoreset_mode: What happens when an episode is over, see `gymnasium.vector.AutoresetMode` (or its value as a text): the
            next step resets that world (the default), the same step does, or nobody does until
            ``reset(options={"reset_mask": mask})`` is called.
        render_mode: None or ``"rgb_array"``.
        options: Further options of `cpdeform_gymnasium.worlds.Worlds`.

    Attributes:
        worlds: The worlds, in torch tensors.

    Raises:
        InputError: An option or the task cannot be used.
    """

    def __init__(
        self,
        task: Task | Path | str = "writer",
        *,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        check_render_mode(render_mode)
        try:
            mode = AutoresetMode(autoreset_mode)
        except ValueError as error:
            known = ", ".join(item.value for item in AutoresetMode)
            raise InputError("autoreset_mode", came=f'"{autoreset_mode}"', expected=f"one of {known}") from error
        self.worlds = Worlds(task, count=num_envs, **options)
        self.num_envs, self.max_episode_steps, self.render_mode = num_envs, max_episode_steps, render_mode
        self.metadata = {"render_modes": [RENDER_MODE], "render_fps": FRAMES_PER_SECOND, "autoreset_mode": mode}
        self.single_observation_space = observation_space(self.worlds.observation.size)
        self.single_action_space = action_space(self.worlds.task.scene.action_size)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._autoreset = mode
        self._generators = [np.random.default_rng() for _ in range(num_envs)]
        self._elapsed = np.zeros(num_envs, dtype=np.int64)
        self._over = np.zeros(num_envs, dtype=bool)
        self._painter: Painter | None = None

    @property
    def task(self) -> Task:
        """The task with all changes and limits in its scene."""
        return self.worlds.task

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin episodes in all worlds, or in some of them.

        Args:
            seed: A seed for each world (None leaves its generator as it is), or one, from which world i gets ``seed + i``.
            options: ``{"reset_mask": mask}`` with truth values (B,) resets those worlds alone; the others stay as they are.

        Raises:
            InputError: Seeds or mask do not fit the number of worlds.
        """
        seeds = (
            [None if seed is None else seed + world for world in range(self.num_envs)] if not isinstance(seed, Sequence) else seed
        )
        if len(seeds) != self.num_envs:
            raise InputError("seed", came=f"{len(seeds)} seeds", expected=f"{self.num_envs}, one for each world")
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            came = f"{mask.dtype} of shape {mask.shape}"
            raise InputError("options.reset_mask", came=came, expected=f"truth values of shape ({self.num_envs},)")
        for world in np.flatnonzero(mask).tolist():
            if seeds[world] is not None:
                self._generators[world] = np.random.Generator(np.random.PCG64(seeds[world]))
            self._begin(world)
        return self._observations(), self._infos(self.worlds.measures(), mask)

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Take an environment step in all worlds whose episode goes on.

        Args:
            actions: Numbers (B, A) in [-1, 1].

        Raises:
            InputError: A number is not finite or outside [-1, 1], or an episode is over that is not reset by itself.
        """
        if self._autoreset is AutoresetMode.DISABLED and self._over.any():
            worlds = ", ".join(map(str, np.flatnonzero(self._over)))
            remedy = 'Call reset(options={"reset_mask": mask}) first.'
            raise InputError("step", came=f"worlds whose episode is over: {worlds}", expected="episodes that go on", remedy=remedy)
        going = ~self._over
        reward, terminated, truncated = (
            np.zeros(self.num_envs),
            np.zeros(self.num_envs, dtype=bool),
            np.zeros(self.num_envs, dtype=bool),
        )
        infos: dict[str, Any] = {}
        if going.any():
            chosen = np.flatnonzero(going)
            step = self.worlds.step(torch.as_tensor(np.asarray(actions)[chosen]), chosen.tolist())
            reward[chosen], terminated[chosen] = step.reward.numpy(), step.diverged.numpy()
            self._elapsed[chosen] += 1
            if self.max_episode_steps is not None:
                truncated = going & (self._elapsed >= self.max_episode_steps)
            infos = self._infos(_spread(step.info, chosen, self.num_envs), going)
            infos |= {"diverged": terminated.copy(), "_diverged": going}
        for world in np.flatnonzero(~going).tolist():
            self._begin(world)
        self._over = terminated | truncated
        if self._autoreset is AutoresetMode.SAME_STEP and self._over.any():
            infos = self._same_step_reset(infos)
        return self._observations(), reward, terminated, truncated, infos

    def rollout_gradient(self, actions: Array, *, discount: float = 1.0) -> RewardGradient:
        """Rewards (B, T) of actions (B, T, A) from here, and the gradient (B, T, A) of each world's sum; nothing moves.

        Args:
            actions: Actions in [-1, 1].
            discount: Factor of each further step's reward.

        Raises:
            InputError: The shape does not fit, or an action is not finite or outside [-1, 1].
        """
        return self.worlds.rollout_gradient(torch.as_tensor(np.asarray(actions)), discount=discount)

    def get_state(self, world: int) -> Snapshot:
        """A copy of all of a world; the count of its steps is not part of it."""
        return dataclasses.replace(self.worlds.snapshot(world), random_state=self._generators[world].bit_generator.state)

    def set_state(self, world: int, state: Snapshot) -> None:
        """Put a world to where `get_state` was taken, of this or any other world of the same task; the others stay as they are.

        Raises:
            InputError: The state is one of another scene or reward.
        """
        self.worlds.restore(world, state)
        if state.random_state is not None:
            self._generators[world].bit_generator.state = dict(state.random_state)

    def count_step(self, terminated: Array) -> Array:
        """Count a step that somebody else took in all worlds, such as a learner that goes through the simulator's gradient.

        Args:
            terminated: Whether each world's episode (B,) ended with it for good.

        Returns:
            Whether each world's episode (B,) is over.
        """
        self._elapsed += 1
        limit = self.max_episode_steps
        return np.asarray(terminated | (False if limit is None else self._elapsed >= limit))

    def begin_anew(self, mask: Array) -> None:
        """Begin an episode in each world that a mask (B,) chooses; the others stay as they are."""
        for world in np.flatnonzero(mask).tolist():
            self._begin(world)

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """A picture (H, W, 3) of each world; None without a render mode."""
        if self.render_mode is None:
            return None
        painter = self._painter = self._painter or Painter(self.task.scene, self.worlds.goal)
        return tuple(painter.paint(self.worlds.state.select(world)) for world in range(self.num_envs))

    def _begin(self, world: int) -> None:
        self.worlds.reset(world, generator=self._generators[world])
        self._elapsed[world], self._over[world] = 0, False

    def _same_step_reset(self, infos: dict[str, Any]) -> dict[str, Any]:
        """Reset the worlds that are over; what they ended with goes into ``final_obs`` and ``final_info``."""
        over, observations = self._over.copy(), self._observations()
        final = np.full(self.num_envs, None, dtype=object)
        for world in np.flatnonzero(over).tolist():
            final[world] = observations[world]
            self._begin(world)
        # The infos of worlds that begin anew are those of their start.
        now = self._infos(self.worlds.measures(), np.ones(self.num_envs, dtype=bool))
        own = {name: np.where(over, now[name], value) for name, value in infos.items() if name in now and not name.startswith("_")}
        kept = {name: value.copy() for name, value in infos.items()}
        return {**infos, **own, "final_obs": final, "_final_obs": over, "final_info": kept, "_final_info": over}

    def _infos(self, values: dict[str, torch.Tensor], mask: Array) -> dict[str, Any]:
        """Infos in the form of vector environments: an array by name, and whether each world has it."""
        infos: dict[str, Any] = {}
        for name, value in values.items():
            infos[name], infos[f"_{name}"] = np.where(mask, value.numpy(), 0.0), mask.copy()
        return infos

    def _observations(self) -> Array:
        return np.asarray(self.worlds.observe().float().cpu().numpy())


def _spread(values: dict[str, torch.Tensor], chosen: Array, count: int) -> dict[str, torch.Tensor]:
    """Values (b,) of chosen worlds as values (B,) of all, 0 elsewhere."""
    index = torch.as_tensor(chosen)
    return {name: torch.zeros(count, dtype=value.dtype).index_copy(0, index, value) for name, value in values.items()}
