"""Equal cost for every method: what a rollout without gradient costs, and how large a search may be for a budget."""

from __future__ import annotations

import contextlib
import math
import os
import time
import uuid
from pathlib import Path
from typing import Any

import torch

from cpdeform.core.plugins import Registry
from cpdeform.core.reading.json_text import read_json
from cpdeform.core.task import Task
from cpdeform.experiments.experiment_plan import plain_name
from cpdeform.planning.strategies.sculpt import StrategySculpt
from cpdeform.run.configuration import RunConfiguration
from cpdeform.run.record_files import write_json

SHARES = "rollout-shares"
"""Directory of what a rollout costs in each task: measured once, so that an experiment that goes on has its first budgets."""

POPULATION, SAMPLES, KEPT = 16, 32, 3
"""Plans of a generation of `cma`, samples of a round of `mppi`, descents of `sampled-gradients`."""

LEARNERS, JUDGED = ("sac", "ppo", "td3"), 3
"""Learners, whose episodes are rollouts, and the rollouts that each spends on judging what it has learnt."""

JOINT_SHARE, JOINT_SHARE_OF_SEVERAL = 0.25, 0.4
"""Part of the cost that `sculpt` spends in descents over touches that it has found: over a single one, and over several."""

REPEATS = 5


def rollout_share(task: Task, configuration: RunConfiguration, out: Path, *, registry: Registry) -> float:
    """What a rollout without gradient costs in a task, in evaluations with gradient; measured unless it is known already.

    Of several workers that measure at once, the first one's figure counts for all: methods are compared by one budget.

    Args:
        task: With all changes of its scene.
        configuration: Names the simulator.
        out: Directory of the experiment, where the shares are kept.
        registry: Where the simulator is looked up.

    Raises:
        InputError: The file of an earlier share cannot be read.
    """
    path = out / SHARES / f"{plain_name(task.name)}.json"
    if not path.exists():
        share = measured_share(task, configuration, registry=registry)
        path.parent.mkdir(parents=True, exist_ok=True)
        own = path.with_name(f".{uuid.uuid4().hex}.json")
        write_json(own, {"task": task.name, "share": share})
        # A link, unlike a replacement, fails where another worker was first.
        with contextlib.suppress(FileExistsError):
            os.link(own, path)
        own.unlink()
    return float(read_json(path, argument=str(path))["share"])


def known_shares(out: Path) -> dict[str, float]:
    """The shares that an experiment has measured, by task.

    Args:
        out: Directory of the experiment.

    Raises:
        InputError: A file cannot be read.
    """
    found = [read_json(path, argument=str(path)) for path in sorted((out / SHARES).glob("[!.]*.json"))]
    return {str(content["task"]): float(content["share"]) for content in found}


def measured_share(task: Task, configuration: RunConfiguration, *, registry: Registry) -> float:
    """Time of a rollout that keeps nothing, over that of one with its gradient; one world, the quickest of several each."""
    options = {**configuration.simulator_options, "batch_size": 1}
    simulator = registry.create("simulator", configuration.backend, scene=task.scene, device=configuration.device, **options)
    state, actions = simulator.initial_state(), torch.zeros(1, task.rollout_steps, task.scene.action_size)
    actions = actions.to(state.position)
    alone, whole = [], []
    for _ in range(REPEATS + 1):
        marks = [time.perf_counter()]
        simulator.simulate(state, actions)
        marks.append(time.perf_counter())
        trajectory = simulator.rollout(state, actions)
        simulator.vjp(trajectory, torch.ones_like(trajectory.positions))
        marks.append(time.perf_counter())
        alone.append(marks[1] - marks[0])
        whole.append(marks[2] - marks[1])
    # The first of each warms up.
    return round(min(alone[1:]) / min(whole[1:]), 3)


def budget_values(method: str, cost: float, *, share: float, iterations: int, stages: int = 1) -> dict[str, Any]:
    """Values of a method's configuration with which a stage costs about as much as it may.

    Args:
        method: A name of `cpdeform.experiments.experiment_plan.METHODS`.
        cost: What a stage may cost, in gradient evaluations.
        share: What a rollout without gradient costs.
        iterations: Gradient evaluations of a descent where the method makes several.
        stages: Stages of the run.

    Returns:
        Fields of `RunConfiguration`, nested; none for a method that has no such size.
    """
    whole = max(1, round(cost))
    single = {"optimizer": {"iterations": whole, "patience": whole}}
    descent = min(iterations, whole)
    several = {"optimizer": {"iterations": descent, "patience": descent}}
    rollouts = max(4, round(cost / share))
    if method == "fixed":
        return single
    if method == "random":
        return {**single, "placer_options": {"rounds": 1}}
    if method == "restarts":
        return {**several, "strategy_options": {"restarts": max(1, round(cost / descent))}}
    if method == "bayesopt":
        return {**several, "strategy_options": {"evaluations": max(1, round(cost / descent))}}
    if method == "cma":
        population = min(POPULATION, rollouts)
        return {"strategy_options": {"population": population, "generations": max(1, round(rollouts / population))}}
    if method == "mppi":
        samples = min(SAMPLES, max(2, rollouts // 2))
        return {"strategy_options": {"samples": samples, "updates": max(1, round(rollouts / samples) - 1)}}
    if method in LEARNERS:
        return {"strategy_options": {"episodes": max(1, rollouts - JUDGED)}}
    if method == "sculpt":
        return {"strategy_options": _touches(cost, share=share, stages=stages)}
    if method == "sampled-gradients":
        kept = min(KEPT, max(1, whole // 2))
        descent = max(1, round(0.5 * cost / kept))
        samples = max(kept, round(0.5 * cost / share))
        return {
            "optimizer": {"iterations": descent, "patience": descent, "pruner": "none"},
            "strategy_options": {"samples": samples, "keep": kept},
        }
    return {}


def _touches(cost: float, *, share: float, stages: int) -> dict[str, Any]:
    """Options of `sculpt`: fewer touches and fewer of them polished, and shorter descents over all stages."""
    full = StrategySculpt()
    descents, joint = _joint_descents(full, cost, stages)
    # What joint descents may not use goes to the touches.
    steps = list(zip(full.polished, full.iterations, strict=True))
    rollouts, gradients = full.touches + 2 * full.variations, sum(math.prod(step) for step in steps)
    part = (cost - joint / stages) / (share * rollouts + gradients)
    polished = tuple(max(1, round(part * count)) for count in full.polished)
    # One candidate may be more than the part of a step; its gradients then make up for it.
    iterations = tuple(max(1, round(part * math.prod(step) / kept)) for step, kept in zip(steps, polished, strict=True))
    return {
        "touches": max(2, round(part * full.touches)),
        "variations": max(2, round(part * full.variations)),
        "polished": polished,
        "iterations": iterations,
        **descents,
    }


def _joint_descents(full: StrategySculpt, cost: float, stages: int) -> tuple[dict[str, Any], int]:
    """Options of `sculpt` for joint descents, the last one twice as long as those on the way, and the gradients of all of them."""
    chapters = math.ceil(stages / full.together)
    together = math.ceil(stages / chapters)
    share = JOINT_SHARE if stages == 1 else JOINT_SHARE_OF_SEVERAL
    interim = max(1, round(share * cost * stages / (chapters * (math.ceil(together / full.joint_every) + 1))))
    options: dict[str, Any] = {"together": together, "interim_gradients": interim, "joint_gradients": 2 * interim}
    descents = StrategySculpt(**options).joint_descents(stages)
    return options, sum(descent.effort.gradients[1] for descent in descents)
