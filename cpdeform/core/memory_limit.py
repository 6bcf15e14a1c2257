"""How much memory a run may still take, and whether it is enough, asked before the run starts."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from cpdeform.core.errors import InputError

if TYPE_CHECKING:
    import torch

    from cpdeform.core.simulator import Simulator

_UNLIMITED = 2**60
_STATE_BYTES = 2 * 8 * (3 + 3 + 9 + 6)
"""Bytes of a particle's state at the scene's start, in double precision and once more in the simulator's type."""

_CGROUP_FILES = (
    ("memory.max", "memory.current", "inactive_file"),
    ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
)
"""Limit, use and the share of the use that is given back when it is needed, in versions 2 and 1 of Linux's control groups."""


def check_memory(simulator: Simulator, *, step_count: int, worlds: int) -> None:
    """Hold what rollouts and gradients will need against what there is.

    Args:
        simulator: Foretells the need, see `Simulator.memory_estimate`.
        step_count: Environment steps of a rollout.
        worlds: Number of worlds.

    Raises:
        InputError: There is not enough memory.
    """
    needed = simulator.memory_estimate(step_count, worlds=worlds) + worlds * simulator.scene.particle_count * _STATE_BYTES
    available = available_memory(simulator.device)
    if available is not None and needed > available:
        count = simulator.scene.particle_count
        fewer = "worlds at a time (--set simulator_options.batch_size=1), " if worlds > 1 else ""
        raise InputError(
            "memory",
            came=f"a need of {needed / 1e9:.3g} GB ({count} particles, {step_count} steps, worlds {worlds})",
            expected=f"at most the {available / 1e9:.3g} GB that are available",
            remedy=f"Take fewer {fewer}particles or steps.",
        )


def available_memory(device: torch.device | str = "cpu", *, root: Path = Path("/")) -> int | None:
    """Bytes that this process can still take: of what the system has, of its own limits, and of its control group's.

    Args:
        device: A CUDA device's own memory is asked for there.
        root: Where ``proc`` and ``sys`` lie, for tests.

    Returns:
        Bytes; None where nothing is known.
    """
    import torch

    device = torch.device(device)
    if device.type == "cuda":
        if not torch.cuda.is_available():
            return None
        free = torch.cuda.mem_get_info(device)[0]
        return int(free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device))
    import psutil

    return max(0, min(int(psutil.virtual_memory().available), *_process_limits(), *_group_limits(root)))


def _process_limits() -> Iterator[int]:
    """Bytes left under the limits of this process (``ulimit -v``, ``ulimit -d``)."""
    yield _UNLIMITED
    try:
        import resource
    except ImportError:
        return
    import psutil

    use = psutil.Process().memory_info()
    for limit, used in ((resource.RLIMIT_AS, use.vms), (resource.RLIMIT_DATA, getattr(use, "data", 0))):
        most = resource.getrlimit(limit)[0]
        if most != resource.RLIM_INFINITY:
            yield most - used


def _group_limits(root: Path) -> Iterator[int]:
    """Bytes left under the limits of this process's control group and of those that it is in."""
    try:
        lines = (root / "proc/self/cgroup").read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return
    for line in lines:
        number, _, rest = line.partition(":")
        controllers, _, group = rest.partition(":")
        if number != "0" and "memory" not in controllers.split(","):
            continue
        top = root / "sys/fs/cgroup" / ("" if number == "0" else "memory")
        folder = top / group.strip("/")
        while True:
            yield from _group_left(folder)
            if folder == top or top not in folder.parents:
                break
            folder = folder.parent


def _group_left(folder: Path) -> Iterator[int]:
    """Bytes left in one control group; nothing where it has no limit."""
    for limit_file, use_file, reclaimable in _CGROUP_FILES:
        try:
            limit, use = int((folder / limit_file).read_text()), int((folder / use_file).read_text())
            fields = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
            yield limit - use + int(fields.get(reclaimable, 0))
        except (OSError, ValueError):
            # Another version, the word "max", or a system that does not tell.
            continue
