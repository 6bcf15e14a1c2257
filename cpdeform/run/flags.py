"""Flags of `cpdeform run`; of their own, so that they are there before anything slow is imported."""

from __future__ import annotations

from collections.abc import Mapping

FLAGS: Mapping[str, str] = {
    "task": "TASK",
    "backend": "--backend",
    "ot": "--ot",
    "placer": "--placer",
    "strategy": "--strategy",
    "device": "--device",
    "seed": "--seed",
    "stages": "--stages",
    "steps": "--steps",
    "goal": "--goal",
    "workers": "--workers",
    "optimizer.iterations": "--iterations",
}
"""Flag of `cpdeform run` for each field of the configuration that has one."""
