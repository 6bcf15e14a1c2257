"""What this process may use of the machine."""

from __future__ import annotations

import os

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")
"""Environment variables that say how many threads numerical libraries take; they read them when they are loaded."""


def machine_cores() -> int:
    """Cores that the system lets this process have."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def available_cores() -> int:
    """Cores that this process may use: those of the system, or fewer where ``OMP_NUM_THREADS`` says so."""
    # A list of numbers is for nested regions; the first is that of the outermost.
    asked = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()
    most = int(asked) if asked.isascii() and asked.isdigit() and len(asked) < 10 else 0
    return min(machine_cores(), most) if most else machine_cores()


def thread_environment(threads: int) -> dict[str, str]:
    """Environment variables that let a process take so many threads."""
    return dict.fromkeys(THREAD_VARIABLES, str(threads))
