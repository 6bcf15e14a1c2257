"""The card of a data set: what is in it, how it was made, under which licence."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from cpdeform.datasets.settings import DatasetSettings

if TYPE_CHECKING:
    from cpdeform.datasets.build import BuiltDataset
    from cpdeform.sweep.status import Throughput

TEXT = """---
license: {licence_lower}
pretty_name: {name}
tags: [robotics, deformable-objects, differentiable-physics, imitation-learning]
size_categories: [{size}]
---

# {name}

{count} plans of cpdeform that shape clay into generated goals, in the scene of the task `{scene}`. Licence: {licence}.

| figure | value |
| --- | --- |
{rows}

Kinds of goals: {kinds}.

## Files

- `trajectories-NNNNN.h5` and `.json`: ManiSkill's trajectory layout, {shard} episodes a file. `traj_I/obs` is what was seen
  (positions of {particles} of the {all_particles} particles, poses of the tools), `actions` what was done (in [-1, 1]), `rewards`
  what each step added to the normalised incremental IoU, `success` whether the state after a step has at least {success:g} of it.
  `traj_I/plan` holds the goal, the transport priorities and losses of each stage, and the positions of all particles at the end.
- {minari}
- `SHA256SUMS`: check with `sha256sum --check SHA256SUMS`.

Lengths are in edges of the domain. Where `plan/placed` is true a stage begins: the tools were put, before the step, where
`obs/tool_poses` has them. All else follows from the actions.

## How it was made

Backend {backend}, transport solver {ot}, strategy {strategy}, seed {seed}, {threads} thread(s) a plan; {versions}.
{throughput}
{without}
Repeat a sample: `cpdeform dataset replay DIR --backend NAME`.
"""

SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))


def card_text(
    name: str, settings: DatasetSettings, built: BuiltDataset, *, took: Throughput, environment: Mapping[str, Any]
) -> str:
    """The card, as Markdown with the head that data hubs read.

    Args:
        name: Name of the data set.
        settings: Its settings.
        built: What was written.
        took: What the plans took.
        environment: What is needed to simulate the episodes again.
    """
    episodes, configuration = built.episodes, environment["configuration"]
    kinds = Counter(item["reset_kwargs"]["options"]["goal_kind"] for item in episodes)
    counts = [body["particle_count"] for body in environment["task"]["scene"]["bodies"]]
    versions = ", ".join(f"{package} {version}" for package, version in (environment["versions"] or {}).items() if version)
    return TEXT.format(
        name=name,
        licence=settings.licence,
        licence_lower=settings.licence.lower(),
        size=next((size for most, size in SIZES if len(episodes) < most), "n>1M"),
        count=len(episodes),
        scene=environment["task"]["name"],
        rows="\n".join(f"| {title} | {value} |" for title, value in _figures(episodes)),
        kinds=", ".join(f"{kind} ({count})" for kind, count in kinds.most_common()),
        shard=settings.shard_size,
        particles=min(settings.particles, sum(counts)),
        all_particles=sum(counts),
        success=settings.success_iou,
        minari=(
            '`minari/data`: the same as a Minari data set: `minari.MinariDataset("minari/data")`.'
            if built.minari
            else "There is no Minari data set, since Minari was not installed."
        ),
        backend=configuration["backend"],
        ot=configuration["ot"],
        strategy=configuration["strategy"],
        seed=settings.seed,
        threads=settings.threads,
        versions=versions,
        throughput=_took(took),
        without=_without(built.without_plan),
    )


def _took(took: Throughput) -> str:
    rate = took.plans_per_core_hour
    hours = f"{took.core_hours:.3g} core-hours ({took.cpu_hours:.3g} of them computing)"
    return "" if rate is None else f"The plans took {hours}: {rate:.3g} plans per core-hour."


def _figures(episodes: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    steps = [item["elapsed_steps"] for item in episodes]
    iou = [item["incremental_iou"] for item in episodes]
    ratios = [item["losses"][-1] / item["losses"][0] for item in episodes if item["losses"][0]]
    return [
        ("episodes", str(len(episodes))),
        ("steps", f"{sum(steps)} ({min(steps)} to {max(steps)} an episode)"),
        ("successes", f"{sum(item['success'] for item in episodes)} of {len(episodes)}"),
        ("normalised incremental IoU", _spread(iou)),
        ("loss at the end over loss at the start", _spread(ratios)),
    ]


def _spread(values: Sequence[float]) -> str:
    """Median and extremes."""
    return f"{statistics.median(values):.3f} ({min(values):.3f} to {max(values):.3f})" if values else "-"


def _without(reasons: Mapping[str, str]) -> str:
    if not reasons:
        return "Every goal has a plan.\n"
    lines = "".join(f"- {job}: {reason}\n" for job, reason in reasons.items())
    return f"Goals without a plan, which are left out:\n\n{lines}"
