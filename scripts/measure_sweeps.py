"""Measures sweeps: listing many jobs, what the queue costs a job, and two workers against one.

    python scripts/measure_sweeps.py [--jobs 100000] [--plans 8]

Times are those of this machine as it is: let nothing else run. Processor time, which others disturb less, is told beside them.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

from cpdeform.core.plugins import load_registry
from cpdeform.sweep.engines.local import EngineLocal
from cpdeform.sweep.job import Job, JobContext
from cpdeform.sweep.plan import SweepSettings, new_sweep
from cpdeform.sweep.queue import DONE, Queue, SweepHead
from cpdeform.sweep.status import sweep_status
from cpdeform.sweep.worker import Worker, WorkSettings

SECONDS_OF_A_JOB = 10.0
"""Length of a job that the cost of the queue is held against."""

PLAN = {"stages": 1, "optimizer": {"iterations": 5}, "scene": {"bodies": {"0": {"particle_count": 400}}}}


def main() -> None:
    """Measure, a line each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=100_000, help="jobs to list")
    parser.add_argument("--plans", type=int, default=8, help="plans for one worker and for two; 0 for none")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        listing(Path(folder) / "listing", given.jobs)
        overhead(Path(folder) / "overhead", 500)
        if given.plans:
            two_workers(Path(folder), given.plans)


def listing(directory: Path, count: int) -> None:
    """A sweep of many jobs, half of them done."""
    jobs = (Job(name=f"job-{number:06d}", record=f"records/job-{number:06d}") for number in range(count))
    (wall, busy), queue = timed(lambda: Queue.create(directory, SweepHead(kind="run"), jobs))
    say(f"making {count:,} jobs: {wall:.1f} s ({busy:.1f} s of processor time)")
    for name in queue.names()[: count // 2]:
        queue.file(DONE, name).write_text("{}", encoding="utf-8")
    (wall, busy), status = timed(lambda: sweep_status(queue))
    say(f"listing {status.jobs:,} jobs, {status.done:,} of them done: {wall:.2f} s ({busy:.2f} s)")


def overhead(directory: Path, count: int) -> None:
    """Jobs that do nothing but write a file: all else is the queue's."""

    def nothing(context: JobContext) -> dict[str, object]:
        (context.directory / "file").touch()
        return {}

    jobs = (Job(name=f"job-{number:06d}", record=f"records/job-{number:06d}") for number in range(count))
    queue = Queue.create(directory, SweepHead(kind="run"), jobs)
    (wall, busy), done = timed(lambda: sum(1 for _ in Worker(queue, function=nothing).work()))
    share = wall / done / SECONDS_OF_A_JOB
    say(f"queue: {1e3 * wall / done:.1f} ms a job ({1e3 * busy / done:.1f} ms), {share:.3%} of a job of {SECONDS_OF_A_JOB:g} s")


def two_workers(directory: Path, count: int) -> None:
    """The same plans by one worker and by two, from the first outcome to the last: the start of the processes left out."""
    rates = []
    for workers in (1, 2):
        settings = SweepSettings(tasks=("move-v1",), seeds=tuple(range(count + workers)), settings=PLAN)
        queue = new_sweep(directory / f"workers-{workers}", settings, registry=load_registry())
        times = [time.perf_counter() for _ in EngineLocal(workers=workers).work(queue, WorkSettings())]
        # Each worker's first plan has the loading of its libraries in it.
        rates.append((len(times) - workers) / (times[-1] - times[workers - 1]))
        say(f"{workers} worker(s): {3600.0 * rates[-1]:.0f} plans an hour")
    say(f"two workers do {rates[1] / rates[0]:.2f} times the plans of one")


def timed(call):
    """Wall time, processor time, and what a call returns."""
    wall, busy = time.perf_counter(), time.process_time()
    found = call()
    return (time.perf_counter() - wall, time.process_time() - busy), found


def say(line: str) -> None:
    """Print a line at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
