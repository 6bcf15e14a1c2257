"""Reference trajectories of PlasticineLab, read from a folder beside the project; tests skip loudly where it is absent."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

SHARED = Path(os.environ.get("CPDEFORM_SHARED", Path(__file__).resolve().parents[2] / "shared"))
NAMES = (
    "assembly-v2",
    "chopsticks-v2",
    "move-v2",
    "multistage_airplane-v1",
    "multistage_star-v1",
    "pinch-v2",
    "rollingpin-v2",
    "rope-v2",
    "table-v2",
    "torus-v2",
    "triplemove-v2",
    "writer-v2",
)


def golden_path(name: str) -> Path:
    """Path of a recorded rollout; skips the test where it is absent."""
    path = SHARED / "golden" / f"{name}-seed0.npz"
    if not path.exists():
        pytest.skip(f"no recorded trajectory {path.name} in {path.parent}; set CPDEFORM_SHARED to the folder that holds golden/")
    return path
