"""`cpdeform rl`: train a policy by reinforcement learning."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from cpdeform_baselines.learners.configuration import LearnerConfiguration

FLAGS = ("task", "algorithm", "steps", "worlds", "episode_steps", "seed", "backend", "device", "reward", "checkpoint_every")


def rl(
    task: Annotated[str | None, typer.Argument(help="Name, e.g. writer-v2, or a YAML file.")] = None,
    algorithm: Annotated[
        str | None, typer.Option(help="sac, ppo, td3, or shac (through the simulator's gradient). Defaults to sac.", metavar="NAME")
    ] = None,
    steps: Annotated[int | None, typer.Option(help="Environment steps of all worlds together. Defaults to 20000.")] = None,
    worlds: Annotated[int | None, typer.Option(help="Worlds that are stepped together. Defaults to 8.")] = None,
    episode_steps: Annotated[int | None, typer.Option(help="Steps of an episode. Defaults to the task's.")] = None,
    preset: Annotated[
        str | None,
        typer.Option(help="quick: 2,000 steps; paper: 1,000 episodes of 1,000 steps. Other options override it.", metavar="NAME"),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of policy, exploration and starts. Defaults to 0.")] = None,
    backend: Annotated[str | None, typer.Option(help="Simulator. Defaults to auto.", metavar="NAME")] = None,
    device: Annotated[str | None, typer.Option(help="cpu or cuda. Defaults to cpu.", metavar="NAME")] = None,
    reward: Annotated[
        str | None, typer.Option(help="auto, transport (the paper) or plasticinelab. Defaults to auto.", metavar="NAME")
    ] = None,
    checkpoint_every: Annotated[int | None, typer.Option(help="Steps between checkpoints. Defaults to 5000.")] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="Option of the algorithm, e.g. learning_rate=1e-4; repeatable.", metavar="KEY=VALUE"),
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(help="Go on from the last checkpoint in this directory; only --steps may change.", metavar="DIR"),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Directory of checkpoints and figures. Defaults to rl/<task>-<algorithm>-<seed>.", metavar="DIR"),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line.")] = False,
) -> None:
    """Train a policy on a task by reinforcement learning.

    The directory holds checkpoints, episodes.csv, TensorBoard's files (tensorboard --logdir DIR) and result.json. Interrupted by
    control-C, it keeps a checkpoint. Checkpoints of sac, ppo and td3 are pickles: resume only what you made yourself.
    """
    values = (task, algorithm, steps, worlds, episode_steps, seed, backend, device, reward, checkpoint_every)
    given = {name: value for name, value in zip(FLAGS, values, strict=True) if value is not None}
    with contextlib.redirect_stdout(sys.stderr):
        directory, result = _train(given, settings or [], preset=preset, resume=resume, out=out)
    content = {**dataclasses.asdict(result), "checkpoint": str(result.checkpoint), "out": str(directory)}
    if as_json:
        typer.echo(json.dumps(content))
        return
    typer.echo(f"{result.steps} steps, {result.steps_per_second:.1f} a second")
    typer.echo(f"return of an episode: {result.before.episode_return:.4g} -> {result.after.episode_return:.4g}")
    typer.echo(f"W1 at its end: {result.before.w1:.4g} -> {result.after.w1:.4g}")
    typer.echo(f"written to {directory}")


def _train(
    given: dict[str, Any], settings: list[str], *, preset: str | None, resume: Path | None, out: Path | None
) -> tuple[Path, Any]:
    from cpdeform.core.errors import InputError

    if resume is None:
        from cpdeform_baselines.learners.training import train

        configuration = configure(given, settings, preset=preset)
        name = Path(configuration.task).stem
        directory = out or Path("rl") / f"{name}-{configuration.algorithm}-{configuration.seed}"
        return directory, train(configuration, directory, progress=_tell)
    others = [f"--{name.replace('_', '-')}" if name != "task" else "TASK" for name in given if name != "steps"]
    others += [flag for flag, value in (("--preset", preset), ("--out", out), ("--set", settings or None)) if value is not None]
    if others:
        raise InputError(
            "--resume", came=f"{', '.join(others)} beside it", expected="--steps alone", remedy="The rest is kept there."
        )
    from cpdeform_baselines.learners.training import resume as go_on

    return resume, go_on(resume, steps=given.get("steps"), progress=_tell)[1]


def configure(given: dict[str, Any], settings: list[str], *, preset: str | None) -> LearnerConfiguration:
    """The configuration that a command line asks for.

    Raises:
        InputError: Something of it cannot be used.
    """
    from cpdeform.core.errors import InputError, UnknownNameError
    from cpdeform.core.plugins import split_options
    from cpdeform.core.reading.models import validate
    from cpdeform_baselines.learners.configuration import ALGORITHMS, PRESETS, LearnerConfiguration

    if "task" not in given:
        raise InputError("TASK", came="nothing", expected="a task", remedy="See `cpdeform tasks`, or go on with --resume.")
    if "algorithm" in given and given["algorithm"] not in ALGORITHMS:
        raise UnknownNameError("--algorithm", given["algorithm"], ALGORITHMS)
    if preset is not None and preset not in PRESETS:
        raise UnknownNameError("--preset", preset, PRESETS)
    budget = PRESETS[preset] if preset is not None else {}
    return validate(LearnerConfiguration, {**budget, **given, "options": split_options(settings)}, source="cpdeform rl")


def _tell(line: str) -> None:
    typer.echo(line, err=True)
