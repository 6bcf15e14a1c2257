"""Learners as strategies: each stage is learnt from its own start, so that they stand beside the other methods at equal cost."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from torch import Tensor

from cpdeform.core.placer import Candidate
from cpdeform.core.task import Task, merge
from cpdeform.planning.effort import Effort
from cpdeform.planning.phases.phase import Phase, Scope
from cpdeform.planning.strategies.budget import search_settings
from cpdeform.planning.strategy import Parts, Strategy
from cpdeform.planning.workbench import Workbench
from cpdeform_baselines.learners.configuration import Algorithm, LearnerConfiguration
from cpdeform_baselines.learners.environments import WorldsVecEnv
from cpdeform_baselines.learners.stable_baselines import ROLLOUT, LearnerStableBaselines
from cpdeform_baselines.searches.common import count, stage_seed
from cpdeform_gymnasium import DeformVectorEnv

EPISODES = 1_000
"""Episodes of a stage, as many as the paper gives its learners."""

WORLDS = 8
"""Worlds that are stepped together, at most."""

JUDGED = 3
"""Rollouts after the training: the policy's own episode, and its plan and the best episode's, by the stage's loss."""

LEAST_UPDATES = 4
"""Updates of PPO, at least: where there are few steps, it learns from fewer of them at a time."""


class EpisodesVecEnv(WorldsVecEnv):
    """Remembers the actions of the episode whose end had the least W1.

    Args:
        environment: Resets worlds in the step that ends their episode.

    Attributes:
        best: Actions (T, A) of that episode; None before the first one is over.
        best_distance: Its W1, length units.
    """

    def __init__(self, environment: DeformVectorEnv) -> None:
        super().__init__(environment)
        self.best: Tensor | None = None
        self.best_distance = float("inf")
        self._taken: list[list[NDArray[Any]]] = [[] for _ in range(self.num_envs)]

    def step_wait(self) -> Any:
        """Take the step; where it ends an episode, compare that with the best one."""
        for taken, action in zip(self._taken, self._actions, strict=True):
            taken.append(np.array(action))
        observations, rewards, done, infos = super().step_wait()
        for world in np.flatnonzero(done).tolist():
            if infos[world]["TimeLimit.truncated"] and infos[world]["w1"] < self.best_distance:
                self.best, self.best_distance = torch.as_tensor(np.stack(self._taken[world])), infos[world]["w1"]
            self._taken[world] = []
        return observations, rewards, done, infos


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhaseLearner(Phase):
    """Train a policy where the stage begins; its episode without exploration, or the best one of the training, is the plan.

    Rewards are those of `cpdeform_gymnasium`; which of the two plans is taken, the stage's own loss decides.

    Attributes:
        algorithm: ``"sac"``, ``"ppo"`` or ``"td3"``.
        episodes: Episodes of the training, each as long as a plan.
        options: Further keyword options of the algorithm.
        name: The phase's name.
    """

    scope: ClassVar[Scope] = "round"
    algorithm: Algorithm
    episodes: int
    options: Mapping[str, Any]
    name: str = "learning"

    def effort(self, candidates: int) -> Effort:
        """See `Phase`; an episode costs a rollout, and the two plans are judged."""
        return Effort(rollouts=(self.episodes + JUDGED, self.episodes + JUDGED))

    def run(self, bench: Workbench, candidates: list[Candidate]) -> list[Candidate]:
        """The first candidate with the better of the two plans; the others are left out."""
        first = candidates[0]
        plans = [plan for plan in self._learn(bench, first) if plan is not None]
        padded = [torch.nn.functional.pad(plan, (0, 0, 0, bench.task.rest_steps)) for plan in plans]
        tried = [dataclasses.replace(first, actions=plan) for plan in padded]
        losses = torch.nan_to_num(bench.rollout_losses(tried, None, phase=self.name), nan=torch.inf)
        best = int(losses.argmin())
        idle = [dataclasses.replace(candidate, actions=padded[best], loss=torch.inf) for candidate in candidates[1:]]
        return [dataclasses.replace(tried[best], loss=float(losses[best])), *idle]

    def _learn(self, bench: Workbench, candidate: Candidate) -> tuple[Tensor, Tensor | None]:
        """Actions (T, A) of the policy without exploration, and of the best episode of the training."""
        worlds, length = min(WORLDS, bench.simulator.batch_size, self.episodes), bench.task.step_count
        vector = EpisodesVecEnv(_environment(bench, candidate, worlds))
        configuration = LearnerConfiguration(
            task=bench.task.name,
            algorithm=self.algorithm,
            steps=self.episodes * length,
            worlds=worlds,
            episode_steps=length,
            seed=stage_seed(bench.stage),
            device=str(bench.simulator.device),
            options={**_rollouts(self.algorithm, self.episodes * length, worlds), **self.options},
        )
        learner = LearnerStableBaselines(configuration, None, vector)
        try:
            learner.learn(_paid(configuration), lambda *_: None)
        finally:
            bench.rollouts += -(-learner.steps_done // length)
        policy, single = learner.policy(), _environment(bench, candidate, 1)
        observations, _ = single.reset(seed=0)
        actions = []
        for _ in range(length):
            actions.append(np.clip(policy(observations), -1.0, 1.0).astype(np.float32))
            observations, *_ = single.step(actions[-1])
        bench.rollouts += 1
        return torch.as_tensor(np.concatenate(actions)), vector.best


def _environment(bench: Workbench, candidate: Candidate, worlds: int) -> DeformVectorEnv:
    """Worlds that begin where the stage does, with the tools placed."""
    return DeformVectorEnv(
        bench.task,
        num_envs=worlds,
        max_episode_steps=bench.task.step_count,
        autoreset_mode=AutoresetMode.SAME_STEP,
        simulator=bench.simulator,
        start=bench.worlds([candidate]),
        start_noise=0.0,
        limits=False,
        iou=False,
    )


def _paid(configuration: LearnerConfiguration) -> int:
    """Steps of a training that the budget covers: PPO ends with the rollout in which it reaches its number of steps."""
    each = int(configuration.options.get("n_steps", 1)) * configuration.worlds
    return max(each, configuration.steps // each * each) if configuration.algorithm == "ppo" else configuration.steps


def _rollouts(algorithm: Algorithm, steps: int, worlds: int) -> dict[str, int]:
    """Options of PPO for a training of so many steps: it makes whole rollouts of all worlds, and none that is not paid for."""
    if algorithm != "ppo":
        return {}
    each = max(2, min(ROLLOUT, steps // LEAST_UPDATES) // worlds)
    # A part of the worlds at a time: minibatches of another size would leave some of the steps over.
    return {"n_steps": each, "batch_size": each * max(1, worlds // LEAST_UPDATES)}


class StrategyLearner(Strategy):
    """Reinforcement learning, stage by stage, with the tools where they are.

    Args:
        episodes: Episodes of a stage.
        learner: Further keyword options of the algorithm, as stable-baselines3 names them.

    Raises:
        InputError: An option is out of range, or the algorithm does not take it.

    References:
        Li et al., "Contact Points Discovery for Soft-Body Manipulations with Differentiable Physics", ICLR 2022.
    """

    takes_optimizer: ClassVar[bool] = False
    algorithm: ClassVar[Algorithm]

    def __init__(self, *, episodes: int = EPISODES, learner: Mapping[str, Any] | None = None) -> None:
        self.episodes, self.learner = count("episodes", episodes), dict(learner or {})

    def settings(self, task: Task, *, placer: str | None) -> Mapping[str, Any]:
        """Tools that stay, and the loss of the default strategy."""
        return merge(search_settings(task), {"placer": "fixed"})

    def phases(self, parts: Parts) -> tuple[Phase, ...]:
        """The training."""
        return (PhaseLearner(algorithm=self.algorithm, episodes=self.episodes, options=self.learner),)


class StrategySoftActorCritic(StrategyLearner):
    """SAC; see `StrategyLearner`."""

    algorithm = "sac"


class StrategyProximalPolicy(StrategyLearner):
    """PPO; see `StrategyLearner`."""

    algorithm = "ppo"


class StrategyTwinDelayed(StrategyLearner):
    """TD3; see `StrategyLearner`."""

    algorithm = "td3"
