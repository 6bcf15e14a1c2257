"""A first run in Python: a task to a plan, its record, and a picture of every stage.

Run it with ``python examples/first_run.py``; with the default options it takes some minutes on two cores.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from cpdeform import Observer, RunResult, deform, render
from cpdeform.planning.optimizer import Iteration


class Progress(Observer):
    """Prints the lowest loss of all candidates after every few iterations."""

    def iteration_finished(self, stage: int, iteration: Iteration) -> None:
        """One line for every fifth iteration."""
        if iteration.index % 5 == 0:
            print(f"stage {stage}, iteration {iteration.index}: loss {float(iteration.best_loss.min()):.6f}")


def run(task: str, *, out: Path, stages: int, iterations: int, particles: int | None) -> RunResult:
    """Plan, write the record and draw the clay after each stage.

    Args:
        task: Name of a task, or a YAML file.
        out: Directory of the record.
        stages: Number of stages.
        iterations: The most gradient steps of a stage.
        particles: Particles of the first body; None for as many as the task has.
    """
    settings = {"optimizer": {"iterations": iterations}}
    if particles is not None:
        settings["scene"] = {"bodies": {"0": {"particle_count": particles}}}
    result = deform(task, stages=stages, seed=0, settings=settings, observers=[Progress()])
    result.save(out, overwrite=True)
    for stage in result.stages:
        picture = render(stage.state, scene=result.task.scene, camera="front", width=480)
        Image.fromarray(picture).save(out / f"after-stage-{stage.index}.png")
    return result


def main(arguments: Sequence[str] | None = None) -> None:
    """Run and print what came of it."""
    parser = argparse.ArgumentParser(description="Plan for a task in Python.")
    parser.add_argument("--task", default="pinch")
    parser.add_argument("--out", type=Path, default=Path("runs/first-run"))
    parser.add_argument("--stages", type=int, default=2)
    parser.add_argument("--iterations", type=int, default=20)
    parser.add_argument("--particles", type=int, default=None, help="fewer take less time")
    options = parser.parse_args(arguments)
    result = run(options.task, out=options.out, stages=options.stages, iterations=options.iterations, particles=options.particles)
    print(f"{result.status.value}: loss {result.loss_initial:.6f} -> {result.loss_final:.6f}")
    print(f"{result.metric_name} {result.metric_initial:.4f} -> {result.metric_value:.4f}, {result.gradient_evaluations} gradients")
    print(f"the record is in {options.out}; draw its page with: cpdeform report {options.out}")


if __name__ == "__main__":
    main()
