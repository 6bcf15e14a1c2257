"""SAC, PPO and TD3 of stable-baselines3 on the worlds of one simulator."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from cpdeform.core.errors import InputError
from cpdeform_baselines.learners.configuration import LearnerConfiguration
from cpdeform_baselines.learners.environments import WorldsVecEnv, make_vector
from cpdeform_baselines.learners.evaluation import Policy
from cpdeform_baselines.learners.training import Learner, Note

CLASSES: dict[str, Any] = {"sac": SAC, "ppo": PPO, "td3": TD3}

BUFFER = 50_000
"""Transitions of a replay buffer at most: an observation has 1,200 numbers, so that these take half a gigabyte."""

LEARNING_STARTS = 500
"""Steps of random actions before SAC and TD3 begin to learn, at most."""

ROLLOUT = 512
"""Steps of all worlds between two updates of PPO."""

MODEL_FILE, NORMALISATION_FILE, BUFFER_FILE = "model.zip", "normalisation.pkl", "buffer.pkl"


class _Episodes(BaseCallback):
    """Tells of the episodes that are over."""

    def __init__(self, note: Note) -> None:
        super().__init__()
        self._note = note

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:
                self._note(self.num_timesteps, float(info["episode"]["r"]), float(info["w1"]))
        return True


class LearnerStableBaselines(Learner):
    """A learner of stable-baselines3; observations and rewards are normalised by their running mean and spread.

    Args:
        configuration: How.
        out: Where TensorBoard's files go; None for nowhere.
        environment: Where it learns; defaults to that of the configuration.

    Raises:
        InputError: The algorithm does not take one of the options.
    """

    def __init__(self, configuration: LearnerConfiguration, out: Path | None, environment: WorldsVecEnv | None = None) -> None:
        monitored: Any = VecMonitor(environment or WorldsVecEnv(make_vector(configuration)), info_keywords=())
        self._environment = VecNormalize(monitored)
        self._class = CLASSES[configuration.algorithm]
        self._configuration, self._out = configuration, out
        # Nested ones are written to by stable-baselines3.
        options = {**_defaults(configuration), **copy.deepcopy(configuration.options)}
        try:
            self._model: Any = self._class(
                "MlpPolicy", self._environment, seed=configuration.seed, device=configuration.device, **options
            )
        except TypeError as error:
            raise InputError(
                "options", came=str(configuration.options), expected=f"options of {configuration.algorithm} ({error})"
            ) from error
        self._log()

    @property
    def steps_done(self) -> int:
        """Environment steps so far."""
        return int(self._model.num_timesteps)

    def learn(self, steps: int, note: Note) -> None:
        """Go on; whole rollouts of all worlds are made."""
        self._model.learn(total_timesteps=steps, callback=_Episodes(note), reset_num_timesteps=False)

    def policy(self) -> Policy:
        """The mean action, from observations normalised as in training."""
        model, normalise = self._model, self._environment.normalize_obs

        def act(observation: NDArray[np.float32]) -> NDArray[Any]:
            action, _ = model.predict(normalise(observation), deterministic=True)
            return np.asarray(action)

        return act

    def save(self, directory: Path) -> None:
        """Model, normalisation and replay buffer."""
        self._model.save(directory / MODEL_FILE)
        self._environment.save(str(directory / NORMALISATION_FILE))
        if hasattr(self._model, "replay_buffer"):
            self._model.save_replay_buffer(directory / BUFFER_FILE)

    def load(self, directory: Path) -> None:
        """Model, normalisation and replay buffer; the worlds begin new episodes, whose random numbers are others."""
        self._environment = VecNormalize.load(str(directory / NORMALISATION_FILE), self._environment.venv)
        self._model = self._class.load(directory / MODEL_FILE, env=self._environment, device=self._configuration.device)
        if (directory / BUFFER_FILE).is_file():
            self._model.load_replay_buffer(directory / BUFFER_FILE)
        self._environment.seed(self._configuration.seed + self.steps_done)
        self._log()

    def _log(self) -> None:
        logger = configure(None, []) if self._out is None else configure(str(self._out / "tensorboard"), ["tensorboard"])
        self._model.set_logger(logger)


def _defaults(configuration: LearnerConfiguration) -> dict[str, Any]:
    """Options that follow from the budget; all others are those of stable-baselines3."""
    if configuration.algorithm == "ppo":
        steps = max(2, ROLLOUT // configuration.worlds)
        return {"n_steps": steps, "batch_size": max(2, steps * configuration.worlds // 4)}
    return {
        "buffer_size": min(configuration.steps, BUFFER),
        "learning_starts": min(LEARNING_STARTS, configuration.steps // 4),
        "train_freq": 1,
        "gradient_steps": -1,
    }
