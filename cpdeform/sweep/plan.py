"""What a sweep consists of: every task with every variation of the settings and every seed, a job each."""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cpdeform.core.errors import InputError
from cpdeform.core.plugins import Registry
from cpdeform.core.task import merge
from cpdeform.sweep.job import Job
from cpdeform.sweep.queue import Queue, SweepHead

LEAST_DIGITS = 4


@dataclasses.dataclass(frozen=True, kw_only=True)
class SweepSettings:
    """What to run.

    Attributes:
        tasks: Registered names with their variants, or paths of YAML files.
        seeds: Seeds.
        settings: Fields of `RunConfiguration` for all runs, nested.
        variations: Changes of them, nested, each for a set of runs of its own.
        threads: Threads of each job. They are part of what a sweep is: sums of several threads differ in the last digits with
            their number.

    Raises:
        InputError: A list is empty or holds something twice, or a number is out of range.
    """

    tasks: tuple[str, ...]
    seeds: tuple[int, ...] = (0,)
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    variations: tuple[Mapping[str, Any], ...] = ({},)
    threads: int = 1

    def __post_init__(self) -> None:
        for name in ("tasks", "seeds"):
            entries = getattr(self, name)
            if not entries or len(set(entries)) < len(entries):
                came = ", ".join(map(str, entries[:10])) or "nothing"
                raise InputError(f"--{name}", came=came, expected="entries, each once")
        if self.threads < 1:
            raise InputError("--threads", came=str(self.threads), expected="at least 1")
        for field, option in (("task", "--tasks"), ("seed", "--seeds")):
            if any(field in values for values in (self.settings, *self.variations)):
                raise InputError("--set", came=f'"{field}"', expected="another field", remedy=f"Use {option} instead.")


def combinations(choices: Sequence[tuple[str, Sequence[Any]]]) -> tuple[Mapping[str, Any], ...]:
    """All variations that a choice of values for each of several fields gives.

    Args:
        choices: Dotted name of a field of `RunConfiguration`, and its values.
    """
    found = []
    for values in itertools.product(*(values for _, values in choices)):
        variation: dict[str, Any] = {}
        for (key, _), value in zip(choices, values, strict=True):
            for part in reversed(key.split(".")):
                value = {part: value}
            variation = merge(variation, value)
        found.append(variation)
    return tuple(found)


def new_sweep(directory: Path, settings: SweepSettings, *, registry: Registry) -> Queue:
    """Make the jobs of a sweep, names and options checked; nothing is run.

    Args:
        directory: Where; a sweep of the same settings that is there already is taken as it is.
        settings: What to run.
        registry: Where names are looked up.

    Raises:
        InputError: A task, a name or an option cannot be used, or another sweep is there.
    """
    from cpdeform.run.record_files import environment

    requests = _requests(settings, registry)
    digits = max(LEAST_DIGITS, len(str(len(requests) * len(settings.seeds) - 1)))
    jobs = []
    for number, ((task, values), seed) in enumerate(itertools.product(requests, settings.seeds)):
        name = f"{number:0{digits}d}-{re.sub(r'[^A-Za-z0-9_.+-]', '_', task)}-seed{seed}"
        jobs.append(Job(name=name, record=f"records/{name}", request={**values, "seed": seed}))
    head = SweepHead(kind="run", threads=settings.threads, asked=dataclasses.asdict(settings), environment=environment())
    return Queue.create(directory, head, jobs)


def _requests(settings: SweepSettings, registry: Registry) -> list[tuple[str, dict[str, Any]]]:
    """Name of the task and values of the configuration for each task and variation, nothing left to what is installed where."""
    from cpdeform.run.resolve import resolve

    found = []
    for source, variation in itertools.product(settings.tasks, settings.variations):
        values = merge(settings.settings, {**variation, "task": _absolute(source)})
        if values.get("goal") is not None:
            values["goal"] = str(Path(str(values["goal"])).resolve())
        resolved = resolve(values, registry=registry)
        parts = {"backend": resolved.configuration.backend, "ot": resolved.configuration.ot}
        found.append((resolved.task.name, {**values, **parts}))
    return found


def _absolute(source: str) -> str:
    """A task's name, or the full path of its file: workers may be anywhere."""
    return str(Path(source).resolve()) if source.endswith((".yaml", ".yml")) else source
