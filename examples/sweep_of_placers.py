"""A sweep in Python: a task with several placers and seeds, worked on by this process, and a table of what came of it.

Any number of workers may help meanwhile: ``cpdeform sweep work DIR``, here or on other machines that see the directory. Interrupted
and started again, the script goes on where it was. Run it with ``python examples/sweep_of_placers.py``.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Sequence
from pathlib import Path

from cpdeform import load_record, load_registry
from cpdeform.sweep.plan import SweepSettings, combinations, new_sweep
from cpdeform.sweep.queue import Queue
from cpdeform.sweep.worker import Worker

PLACERS = ("transport", "random", "fixed")


def make_sweep(directory: Path, *, task: str, seeds: int, iterations: int, particles: int) -> Queue:
    """The jobs: every placer with every seed, one stage each."""
    settings = SweepSettings(
        tasks=(task,),
        seeds=tuple(range(seeds)),
        settings={
            "stages": 1,
            "optimizer": {"iterations": iterations},
            "scene": {"bodies": {"0": {"particle_count": particles}}},
        },
        variations=combinations([("placer", PLACERS)]),
    )
    return new_sweep(directory, settings, registry=load_registry())


def table(queue: Queue) -> dict[str, list[float]]:
    """Loss at the end over that at the start, by placer."""
    ratios: dict[str, list[float]] = {placer: [] for placer in PLACERS}
    for name in queue.names():
        run = load_record(queue.directory / queue.job(name).record).run
        ratios[run["configuration"]["placer"]].append(run["loss_final"] / run["loss_initial"])
    return ratios


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the sweep, do its jobs, and print the table."""
    parser = argparse.ArgumentParser(description="Compare placers over seeds.")
    parser.add_argument("--task", default="writer-v2")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--iterations", type=int, default=15)
    parser.add_argument("--particles", type=int, default=4000)
    parser.add_argument("--out", type=Path, default=Path("runs/placers"))
    options = parser.parse_args(arguments)
    queue = make_sweep(
        options.out, task=options.task, seeds=options.seeds, iterations=options.iterations, particles=options.particles
    )
    for outcome in Worker(queue).work():
        print(f"{outcome.name}: {outcome.outcome}")
    for placer, ratios in table(queue).items():
        print(f"{placer:10} loss at the end / at the start: mean {statistics.mean(ratios):.3f} of {len(ratios)} runs")


if __name__ == "__main__":
    main()
