"""Sweeps of toy runs that are disturbed on the way, and the comparison of what comes of them with an undisturbed one."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import random
import time
from collections.abc import Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import h5py
import pytest
from children import child_environment
from toy_fixtures import write_toy_distribution, write_toy_task
from typer.testing import CliRunner

from cpdeform.cli.main import app
from cpdeform.run.record_files import RUN_FILE
from cpdeform.sweep.claim import claimant
from cpdeform.sweep.queue import ATTEMPTS, CLAIMS, DONE, Queue
from cpdeform.sweep.status import sweep_status
from cpdeform.sweep.worker import Worker, WorkSettings

STAGES = 3
TIMES = frozenset({"seconds", "time", "recorded_at", "memory", "rollout", "objective", "vjp", "optimizer"})
"""Fields of a record that no two runs have in common."""

PRELOADED = ["torch", "torch._dynamo", "h5py", "cpdeform.run.resolve", "cpdeform.run.record_continued", "cpdeform.ot.divergence"]
"""What workers find loaded: to load it anew after each kill would take most of the time."""

SECONDS_TO_WAIT = 1800.0


class Campaign:
    """A directory with the toy task and the toys' distribution, and sweeps in it.

    Args:
        directory: Where.
        jobs: Jobs of a sweep.
        delay: Seconds that a rollout takes; a job makes about forty.
    """

    def __init__(self, directory: Path, monkeypatch: pytest.MonkeyPatch, *, jobs: int, delay: float) -> None:
        self.directory, self.jobs, self.delay = directory, jobs, delay
        write_toy_task(directory, stage_count=STAGES, offset=0.3)
        distribution = write_toy_distribution(directory)
        self.environment = child_environment(distribution)
        monkeypatch.chdir(directory)
        monkeypatch.syspath_prepend(str(distribution))
        monkeypatch.setenv("PYTHONPATH", self.environment["PYTHONPATH"])

    def new(self, name: str, *, delay: float | None = None) -> Queue:
        """A sweep of which nothing is done."""
        parts = ["--backend", "toy", "--ot", "toy", "--iterations", "6", "--set", "placer=toy"]
        slow = ["--set", f"simulator_options.delay={self.delay if delay is None else delay}"]
        made = CliRunner().invoke(app, ["sweep", "new", name, "--tasks", "shift.yaml", "--seeds", f"0:{self.jobs}", *parts, *slow])
        assert made.exit_code == 0, made.output
        return Queue(self.directory / name)

    def undisturbed(self) -> dict[str, str]:
        """Digests of the records that one worker makes, in this process."""
        queue = self.new("undisturbed", delay=0.0)
        assert {outcome.outcome for outcome in Worker(queue, own_process=True).work()} == {"done"}
        return digests(queue)

    def with_kills(self, name: str, *, workers: int, every: float, most: int = 10**6, seed: int = 0) -> tuple[Queue, int]:
        """Let workers do a sweep; kill a random one again and again, and start another in its place.

        Args:
            name: Name of the sweep.
            workers: Workers at the same time, each a command of its own.
            every: Seconds between kills; more where no job was done in that time, as on a machine with much else to do.
            most: Kills at most.
            seed: Which of them is killed.

        Returns:
            The sweep, over, and how many workers were killed.
        """
        queue, chance, killed, done_before = self.new(name), random.Random(seed), 0, -1
        running = {f"w{number}": self.worker(queue, f"w{number}") for number in range(workers)}
        limit = time.monotonic() + SECONDS_TO_WAIT
        try:
            while not sweep_status(queue).over:
                assert time.monotonic() < limit, sweep_status(queue)
                time.sleep(every)
                at_work, done = self.at_work(queue, list(running)), len(queue.listed(DONE))
                if not at_work or killed == most or done == done_before:
                    continue
                done_before = done
                victim = chance.choice(at_work)
                running[victim].kill()
                running.pop(victim).join()
                killed += 1
                running[f"w{workers + killed}"] = self.worker(queue, f"w{workers + killed}")
        finally:
            for process in running.values():
                process.kill()
                process.join()
        return queue, killed

    @staticmethod
    def at_work(queue: Queue, workers: Sequence[str]) -> list[str]:
        """Those of the workers in the midst of a job: one that only loads its libraries could be killed for ever."""
        owners = {name: claimant(queue.file(CLAIMS, name)) for name in queue.listed(CLAIMS)}
        begun = {owner for name, owner in owners.items() if (queue.place(ATTEMPTS) / f"{name}@{owner}" / RUN_FILE).exists()}
        return [worker for worker in workers if worker in begun]

    def worker(self, queue: Queue, identity: str) -> BaseProcess:
        """A worker in a process of its own that nobody watches, forked from one that has loaded the libraries."""
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(PRELOADED)
        process = context.Process(target=work_unwatched, args=(str(queue.directory), identity))
        process.start()
        return process


def work_unwatched(directory: str, identity: str) -> None:
    """Do what there is to do, as a worker's process does."""
    settings = WorkSettings(stale_after=3.0, attempts=50)
    for _ in Worker(Queue(directory), settings, identity=identity, own_process=True).work():
        pass


def digests(queue: Queue) -> dict[str, str]:
    """A digest of each job's record: everything but times, and what the toy was told to wait."""
    found = {}
    for name in queue.names():
        record = queue.directory / queue.job(name).record
        digest = hashlib.sha256()
        for path in sorted(record.iterdir()):
            digest.update(path.name.encode())
            digest.update(_hdf5(path) if path.suffix == ".h5" else _text(path))
        found[name] = digest.hexdigest()
    return found


def _hdf5(path: Path) -> bytes:
    parts: list[bytes] = []

    def visit(name: str, item: h5py.Dataset | h5py.Group) -> None:
        parts.append(name.encode())
        parts.extend(f"{key}={value!r}".encode() for key, value in sorted(item.attrs.items()) if key not in TIMES)
        if isinstance(item, h5py.Dataset):
            parts.append(str(item.dtype).encode() + item[()].tobytes() if item.dtype.kind != "O" else repr(item[()]).encode())

    with h5py.File(path) as file:
        parts.extend(f"{key}={value!r}".encode() for key, value in sorted(file.attrs.items()) if key not in TIMES)
        file.visititems(visit)
    return b"|".join(parts)


def _text(path: Path) -> bytes:
    contents = [json.loads(path.read_text())] if path.suffix == ".json" else map(json.loads, path.read_text().splitlines())
    return json.dumps([_timeless(content) for content in contents], sort_keys=True).encode()


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _timeless(entry) for key, entry in value.items() if key not in TIMES and key != "delay"}
    return [_timeless(entry) for entry in value] if isinstance(value, list) else value
