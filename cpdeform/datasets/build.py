"""From the records of a data set's plans to the data set: shards, the Minari data set, the card, checksums."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cpdeform.core.errors import InputError
from cpdeform.core.reading.models import validate
from cpdeform.datasets.card import card_text
from cpdeform.datasets.episode import Episode, record_episode
from cpdeform.datasets.settings import DatasetSettings
from cpdeform.datasets.trajectories import DATASET, EpisodeLabel, write_trajectories
from cpdeform.run.configuration import RunConfiguration
from cpdeform.run.record_reader import load_record
from cpdeform.sweep.queue import DONE, Queue
from cpdeform.sweep.status import sweep_rows, throughput

MINARI, CARD_FILE, CHECKSUM_FILE = "minari", "README.md", "SHA256SUMS"
CHUNK = 2**20


@dataclasses.dataclass(frozen=True, kw_only=True)
class BuiltDataset:
    """A data set that was written.

    Attributes:
        directory: Where it lies.
        episodes: What the JSON files say about each episode.
        without_plan: Names of the jobs that gave none, and why.
        minari: Whether there is a Minari data set, too.
    """

    directory: Path
    episodes: list[dict[str, Any]]
    without_plan: dict[str, str]
    minari: bool


def build_dataset(queue: Queue, settings: DatasetSettings, *, name: str) -> BuiltDataset:
    """Write the data set of all plans that are done, in place of an earlier one.

    It is made beside and takes its place in one step, so that there is always a whole one.

    Args:
        queue: The plans.
        settings: Of the data set.
        name: Its name.

    Returns:
        What was written.

    Raises:
        InputError: There is no plan to be written.
    """
    temporary = queue.directory / f".{DATASET}.tmp"
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir()
    without: dict[str, str] = {}
    labelled = _episodes(queue, settings, without)
    said: list[dict[str, Any]] = []
    minari = _Minari(temporary / MINARI / "data", name, settings)
    environment: dict[str, Any] = {}
    for number in itertools.count():
        shard = list(itertools.islice(labelled, settings.shard_size))
        if not shard:
            break
        environment = environment or _environment(queue, shard[0][0].job)
        told = write_trajectories(temporary, number, shard, first=len(said), environment=environment)
        said += told
        minari.write(shard)
    if not said:
        reasons = "; ".join(f"{job}: {reason}" for job, reason in itertools.islice(without.items(), 3))
        raise InputError(f"data set {queue.directory}", came=f"no plan ({reasons or 'no job is done'})", expected="at least one")
    took = throughput(sweep_rows(queue))
    built = BuiltDataset(directory=queue.directory / DATASET, episodes=said, without_plan=without, minari=minari.made)
    text = card_text(name, settings, built, took=took, environment=environment)
    (temporary / CARD_FILE).write_text(text, encoding="utf-8")
    (temporary / CHECKSUM_FILE).write_text(_checksums(temporary), encoding="utf-8")
    shutil.rmtree(built.directory, ignore_errors=True)
    temporary.rename(built.directory)
    return built


class _Minari:
    """The Minari data set, where Minari is installed."""

    def __init__(self, directory: Path, name: str, settings: DatasetSettings) -> None:
        self._directory, self._name, self._settings = directory, name, settings
        self._writer: Any = None
        self.made = False

    def write(self, shard: list[tuple[EpisodeLabel, Episode]]) -> None:
        """Append the episodes of a shard."""
        try:
            from cpdeform.datasets.minari import MinariWriter
        except ImportError:
            return
        if self._writer is None:
            fields = {"description": f"Plans of cpdeform for generated goals of {self._settings.scene}"}
            identity = f"cpdeform/{self._name}-v0"
            self._writer = MinariWriter(self._directory, name=identity, sample=shard[0][1], fields=fields)
            self.made = True
        self._writer.write((label.goal_seed, episode) for label, episode in shard)


def _episodes(queue: Queue, settings: DatasetSettings, without: dict[str, str]) -> Iterator[tuple[EpisodeLabel, Episode]]:
    """Episodes of the plans that are done, in the order of their goals; why there is none goes into `without`."""
    for name, content in queue.outcomes():
        if content["outcome"] != DONE:
            without[name] = str(content.get("reason", "unknown"))
            continue
        job = queue.job(name)
        try:
            record = load_record(queue.directory / job.record)
            episode = record_episode(record, particles=settings.particles, success_iou=settings.success_iou)
        except InputError as error:
            without[name] = str(error)
            continue
        kind = str(content.get("goal_kind", ""))
        yield EpisodeLabel(goal_seed=int(job.request["goal"]), goal_kind=kind, job=name, figures=content), episode


def _environment(queue: Queue, job: str) -> dict[str, Any]:
    """What is needed to simulate the episodes again: scene, schedule, configuration, versions. Goals are in the files."""
    record = load_record(queue.directory / queue.job(job).record)
    configuration = validate(RunConfiguration, record.run["configuration"], source=f"job {job}")
    task = record.task.model_dump(mode="json", exclude={"goal"})
    return {
        "task": task,
        "configuration": configuration.model_dump(mode="json", exclude={"goal", "task"}),
        "threads": queue.head.threads,
        "versions": record.run.get("versions"),
    }


def _checksums(directory: Path) -> str:
    """Lines as `sha256sum --check` takes them."""
    lines = []
    for path in sorted(path for path in directory.rglob("*") if path.is_file()):
        digest = hashlib.sha256()
        with path.open("rb") as file:
            while chunk := file.read(CHUNK):
                digest.update(chunk)
        lines.append(f"{digest.hexdigest()}  {path.relative_to(directory).as_posix()}\n")
    return "".join(lines)
