"""Training of a policy, with checkpoints that a later call goes on from."""

from __future__ import annotations

import abc
import csv
import dataclasses
import re
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cpdeform.core.errors import InputError
from cpdeform.experiments.tables import describe_machine
from cpdeform.run.record_files import environment as installed
from cpdeform.run.record_files import write_json
from cpdeform_baselines.learners.configuration import LearnerConfiguration, read_configuration, write_configuration
from cpdeform_baselines.learners.environments import make_single
from cpdeform_baselines.learners.evaluation import EpisodeFigures, Policy, run_episode

CHECKPOINTS, EPISODES_FILE, RESULT_FILE = "checkpoints", "episodes.csv", "result.json"

Note = Callable[[int, float, float], None]
"""Told of an episode that is over: steps so far, its return, W1 at its end."""


class Learner(abc.ABC):
    """Something that learns a policy."""

    @abc.abstractmethod
    def learn(self, steps: int, note: Note) -> None:
        """Go on for at least so many environment steps, of all worlds together."""

    @property
    @abc.abstractmethod
    def steps_done(self) -> int:
        """Environment steps so far."""

    @abc.abstractmethod
    def policy(self) -> Policy:
        """The policy as it is, without exploration."""

    @abc.abstractmethod
    def save(self, directory: Path) -> None:
        """Write all that `load` needs into a directory that is there."""

    @abc.abstractmethod
    def load(self, directory: Path) -> None:
        """Go back to where `save` was called."""


@dataclasses.dataclass(frozen=True)
class TrainingResult:
    """A training.

    Attributes:
        steps: Environment steps, those before a resumption included.
        seconds: Wall time of this call's training.
        steps_per_second: Environment steps of this call over that time.
        before: An episode of the policy that this call began with.
        after: An episode of the policy at its end.
        checkpoint: The last checkpoint.
    """

    steps: int
    seconds: float
    steps_per_second: float
    before: EpisodeFigures
    after: EpisodeFigures
    checkpoint: Path


def train(configuration: LearnerConfiguration, out: Path, *, progress: Callable[[str], None] = lambda line: None) -> TrainingResult:
    """Train a policy from the beginning.

    Args:
        configuration: How.
        out: Directory of the configuration, checkpoints, episodes, TensorBoard's files and the result.
        progress: Told of every finished part, in a line.

    Raises:
        InputError: There is a training in `out` already, or an option cannot be used.
    """
    if out.exists() and any(out.iterdir()):
        remedy = "Choose another directory, or go on from there with --resume."
        raise InputError("--out", came=f"{out}, which is not empty", expected="a new directory", remedy=remedy)
    learner = make_learner(configuration, out)
    write_configuration(configuration, out)
    return _train(learner, configuration, out, progress)


def resume(
    directory: Path, *, steps: int | None = None, progress: Callable[[str], None] = lambda line: None
) -> tuple[LearnerConfiguration, TrainingResult]:
    """Go on with a training from its last checkpoint.

    Args:
        directory: Where it is.
        steps: Environment steps to come to in all; defaults to those asked for at the beginning.
        progress: Told of every finished part, in a line.

    Raises:
        InputError: There is no training, or it has come that far already.
    """
    configuration = read_configuration(directory)
    if steps is not None:
        configuration = configuration.model_copy(update={"steps": steps})
    learner = make_learner(configuration, directory)
    checkpoints = list_checkpoints(directory)
    if checkpoints:
        learner.load(checkpoints[-1])
    if learner.steps_done >= configuration.steps:
        came = f"{learner.steps_done} steps done of {configuration.steps}"
        raise InputError("--resume", came=came, expected="steps that are left", remedy="Ask for more with --steps.")
    write_configuration(configuration, directory)
    return configuration, _train(learner, configuration, directory, progress)


def make_learner(configuration: LearnerConfiguration, out: Path) -> Learner:
    """The learner that a configuration describes, at its beginning."""
    if configuration.algorithm == "shac":
        from cpdeform_baselines.learners.shac import LearnerShortHorizon

        return LearnerShortHorizon(configuration, out)
    from cpdeform_baselines.learners.stable_baselines import LearnerStableBaselines

    return LearnerStableBaselines(configuration, out)


def list_checkpoints(directory: Path) -> list[Path]:
    """The complete checkpoints of a training, the oldest first."""
    found = [path for path in (directory / CHECKPOINTS).glob("*") if re.fullmatch(r"step-\d+", path.name)]
    return sorted(found, key=lambda path: int(path.name.removeprefix("step-")))


def _train(learner: Learner, configuration: LearnerConfiguration, out: Path, progress: Callable[[str], None]) -> TrainingResult:
    judge, episode = make_single(configuration)
    before = run_episode(judge, learner.policy(), steps=episode)
    progress(f"{learner.steps_done} steps: return {before.episode_return:.4g}, W1 {before.w1:.4g}")
    first, begin, after = learner.steps_done, time.perf_counter(), before
    seconds = 0.0
    with (out / EPISODES_FILE).open("a", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        if not file.tell():
            writer.writerow(["steps", "return", "w1"])

        def note(steps: int, episode_return: float, w1: float) -> None:
            writer.writerow([steps, episode_return, w1])
            file.flush()

        while learner.steps_done < configuration.steps:
            begin = time.perf_counter()
            try:
                learner.learn(min(configuration.checkpoint_every, configuration.steps - learner.steps_done), note)
            except KeyboardInterrupt:
                _checkpoint(learner, out)
                raise
            seconds += time.perf_counter() - begin
            checkpoint = _checkpoint(learner, out)
            after = run_episode(judge, learner.policy(), steps=episode)
            progress(f"{learner.steps_done} steps: return {after.episode_return:.4g}, W1 {after.w1:.4g}")
    taken = learner.steps_done - first
    result = TrainingResult(learner.steps_done, seconds, taken / seconds, before, after, checkpoint)
    content: dict[str, Any] = dataclasses.asdict(result) | {"checkpoint": checkpoint.name}
    write_json(out / RESULT_FILE, {**content, "machine": describe_machine(), "versions": installed()["versions"]})
    return result


def _checkpoint(learner: Learner, out: Path) -> Path:
    """Write a checkpoint, whole or not at all; the one before it goes."""
    path = out / CHECKPOINTS / f"step-{learner.steps_done:09d}"
    temporary = path.with_name(f"{path.name}.unfinished")
    for old in (temporary, path):
        shutil.rmtree(old, ignore_errors=True)
    temporary.mkdir(parents=True)
    learner.save(temporary)
    temporary.rename(path)
    for older in list_checkpoints(out)[:-1]:
        shutil.rmtree(older, ignore_errors=True)
    return path
