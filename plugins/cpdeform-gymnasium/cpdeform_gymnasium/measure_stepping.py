"""Steps per second of several numbers of worlds, in one process: `python -m cpdeform_gymnasium.measure_stepping writer`."""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Sequence

import torch

from cpdeform_gymnasium.worlds import Worlds


def steps_per_second(worlds: Worlds, *, steps: int) -> float:
    """Steps of all worlds together per second of wall time."""
    actions = torch.zeros(worlds.count, worlds.task.scene.action_size)
    begin = time.perf_counter()
    for _ in range(steps):
        worlds.step(actions)
    return worlds.count * steps / (time.perf_counter() - begin)


def measure(task: str, counts: Sequence[int], *, steps: int, repeats: int, iou: bool, backend: str) -> dict[int, float]:
    """Median steps per second by number of worlds; the numbers take turns, so that other load hits all of them alike."""
    made = {count: Worlds(task, count=count, iou=iou, backend=backend) for count in counts}
    found: dict[int, list[float]] = {count: [] for count in counts}
    for worlds in made.values():
        steps_per_second(worlds, steps=1)
    for _ in range(repeats):
        for count, worlds in made.items():
            found[count].append(steps_per_second(worlds, steps=steps))
    return {count: statistics.median(values) for count, values in found.items()}


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the figures as a JSON object."""
    parser = argparse.ArgumentParser(description="Steps per second of several numbers of worlds, in one process.")
    parser.add_argument("task", nargs="?", default="writer")
    parser.add_argument("--worlds", default="1,8", help="numbers of worlds, separated by commas")
    parser.add_argument("--steps", type=int, default=10)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--no-iou", action="store_true", help="leave the IoU out")
    options = parser.parse_args(arguments)
    counts = [int(count) for count in options.worlds.split(",")]
    found = measure(
        options.task, counts, steps=options.steps, repeats=options.repeats, iou=not options.no_iou, backend=options.backend
    )
    ratio = found[counts[-1]] / found[counts[0]]
    json.dump({"steps_per_second": found, "ratio_last_to_first": ratio}, sys.stdout)
    sys.stdout.write("\n")


if __name__ == "__main__":
    main()
