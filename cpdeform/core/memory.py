"""How much memory this process holds at its peak, on the CPU or on a CUDA device."""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import gc
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

STATUS, CLEAR_REFERENCES = Path("/proc/self/status"), Path("/proc/self/clear_refs")
RESET_PEAK = "5"
"""What makes Linux forget the highest resident size, see proc(5)."""


@dataclasses.dataclass(frozen=True)
class MemoryUse:
    """Memory of a rollout and its gradient.

    Attributes:
        worlds: Worlds of the batch.
        estimate: What `Simulator.memory_estimate` foretold, bytes.
        peak: What was measured, bytes; None where the system does not tell.
    """

    worlds: int
    estimate: int
    peak: int | None


class MemoryGauge:
    """Measures the peak of this process's memory above what it held when the gauge was made or restarted.

    On the CPU that is the resident size: `VmHWM` of Linux, which is reset at the start, or else the peak since the process
    began, which misses whatever stays below an earlier peak. On CUDA it is what torch and Warp have taken from their pools.
    What is not in use any more is given back to the system first, so that it counts when it is taken again.

    Args:
        device: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``; the CPU is measured where there is no such device.

    Attributes:
        exact: Whether the peak could be reset.
        start: Bytes held at the start.
    """

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self._device = torch.device(device)
        self._on_cuda = self._device.type == "cuda" and torch.cuda.is_available()
        self.restart()

    def restart(self) -> None:
        """Begin anew: forget the peak, take what is held now as the start."""
        self._top = 0
        self._forget()
        self.start = self._held()

    def peak(self) -> int:
        """Bytes held at the peak since the start, above those held at the start."""
        return max(self._top, self._highest(), self.start) - self.start

    @contextlib.contextmanager
    def leave_out(self) -> Iterator[None]:
        """Leave out the peak of what goes on inside; what it leaves behind counts."""
        self._top = max(self._top, self._highest())
        yield
        self._forget()

    def _forget(self) -> None:
        # What was dropped lately, which is all that matters here: a full collection takes longer than a small run.
        gc.collect(1)
        give_back()
        if self._on_cuda:
            torch.cuda.synchronize(self._device)
            torch.cuda.reset_peak_memory_stats(self._device)
            self._warp_before = _warp_bytes("used_mem_high", self._device)
        self.exact = self._on_cuda or _reset_peak()

    def _held(self) -> int:
        """Bytes held now."""
        if self._on_cuda:
            return torch.cuda.memory_allocated(self._device) + _warp_bytes("used_mem_current", self._device)
        return _resident("VmRSS") if self.exact else _highest_resident()

    def _highest(self) -> int:
        """Most bytes held since the peak was last forgotten."""
        if not self._on_cuda:
            return _resident("VmHWM") if self.exact else _highest_resident()
        torch.cuda.synchronize(self._device)
        warp = _warp_bytes("used_mem_high", self._device)
        if warp == self._warp_before:
            # Warp's peak cannot be reset: below the old one, what it holds now is the best that is known.
            warp = _warp_bytes("used_mem_current", self._device)
        return torch.cuda.max_memory_allocated(self._device) + warp


def _reset_peak() -> bool:
    try:
        CLEAR_REFERENCES.write_text(RESET_PEAK, encoding="ascii")
        return _resident("VmHWM") > 0
    except (OSError, ValueError):
        return False


def _resident(field: str) -> int:
    """A size from the status of this process, bytes.

    Raises:
        ValueError: The system does not tell.
    """
    for line in STATUS.read_text(encoding="ascii", errors="replace").splitlines():
        name, _, value = line.partition(":")
        if name == field:
            return int(value.split()[0]) * 1024
    raise ValueError(field)


def _highest_resident() -> int:
    """The most bytes ever resident; 0 where the system does not tell."""
    try:
        import resource
    except ImportError:
        return 0
    highest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return highest if sys.platform == "darwin" else highest * 1024


def give_back() -> None:
    """Have glibc give freed memory back to the system; other C libraries have nothing of the kind."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (AttributeError, OSError, TypeError):
        return


def _warp_bytes(figure: str, device: torch.device) -> int:
    """A figure of Warp's memory pool, 0 where Warp is not in use. Core does not import Warp; it only asks one that is there."""
    warp: Any = sys.modules.get("warp")
    if warp is None:
        return 0
    index = device.index if device.index is not None else torch.cuda.current_device()
    return int(getattr(warp, f"get_mempool_{figure}")(f"cuda:{index}"))
