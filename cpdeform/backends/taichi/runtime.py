"""The one Taichi runtime of a process: who started it, with what, and whether it serves a simulator.

Taichi holds a single runtime per process, of one arch and with one pool of threads; starting another one destroys the first with
all that uses it. So the first simulator starts it, later ones share it, and what does not fit is refused. All modules import Taichi
from here, since it prints a banner when it is imported.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import os
import threading
import warnings
from collections.abc import Iterator
from typing import Any

import torch

from cpdeform.backends.kernel_cache import cache_folder, user_cache
from cpdeform.core.errors import CapabilityError, CpdeformError
from cpdeform.core.machine import available_cores

__all__ = ["TaichiRuntimeError", "require", "ti"]

DEVICES = {"x64": "cpu", "arm64": "cpu", "cuda": "cuda"}
"""Taichi's names of the devices that tensors can be on."""

REMEDY = (
    "A process has one Taichi runtime: use another process, for instance a worker of "
    'concurrent.futures.ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")).'
)


class TaichiRuntimeError(CpdeformError, RuntimeError):
    """A Taichi runtime that does not serve a simulator, and cannot be replaced while others use it.

    Args:
        runs: What this process runs.
        asked: What the simulator needs.
    """

    def __init__(self, *, runs: str, asked: str) -> None:
        super().__init__(f"Taichi: this process runs {runs}; asked for was {asked}. {REMEDY}")


@contextlib.contextmanager
def _quietly() -> Iterator[None]:
    """Keep Taichi from printing its banner and from asking its maker's server for newer versions; the environment is put back."""
    settings = {"ENABLE_TAICHI_HEADER_PRINT": "0", "TI_ENABLE_PYBUF": "0", "TI_SKIP_VERSION_CHECK": "ON"}
    before = {name: os.environ.get(name) for name in settings}
    os.environ.update({name: value for name, value in settings.items() if before[name] is None})
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)


def _give_it_a_home() -> None:
    """Taichi ends the process where neither variable tells where its cache is; the system's user database does."""
    if "HOME" not in os.environ and "XDG_CACHE_HOME" not in os.environ:
        os.environ["XDG_CACHE_HOME"] = str(cache_folder(user_cache(), setting="XDG_CACHE_HOME"))


_give_it_a_home()
with _quietly(), warnings.catch_warnings():
    warnings.filterwarnings("ignore", category=DeprecationWarning, module=r"taichi\.")
    import taichi as ti


@dataclasses.dataclass(frozen=True)
class Runtime:
    """A running Taichi.

    Attributes:
        program: Taichi's own object; another one after somebody has started Taichi anew.
        arch: Taichi's name of the device, e.g. ``"x64"`` or ``"cuda"``.
        threads: Size of its pool of threads.
        process: Process that started it; none of its threads lives in a forked child.
    """

    program: Any
    arch: str
    threads: int
    process: int

    def __str__(self) -> str:
        return f"a runtime on {self.arch} with {self.threads} thread{'s' if self.threads > 1 else ''}"


_lock = threading.Lock()
_running: Runtime | None = None


def require(device: torch.device, threads: int | None = None) -> int:
    """Start Taichi, or make sure that the running one serves.

    Args:
        device: Where the simulator's tensors are.
        threads: Threads that it works with on the CPU; defaults to those that the process may use and the pool has.

    Returns:
        The number of threads.

    Raises:
        CapabilityError: Taichi has no such device.
        TaichiRuntimeError: Another runtime is needed than the one that runs.
    """
    global _running
    wanted = threads or available_cores()
    with _lock:
        if _running is not None and _running.process != os.getpid():
            raise TaichiRuntimeError(runs="what it was forked with, a runtime without its threads", asked="a simulator")
        program = ti.lang.impl.get_runtime().prog
        if program is None:
            _start(device, max(wanted, available_cores()))
            program = ti.lang.impl.get_runtime().prog
        if _running is None or _running.program is not program:
            _running = Runtime(program, ti.cfg.arch.name, int(ti.cfg.cpu_max_num_threads), os.getpid())
    if DEVICES.get(_running.arch) != device.type:
        raise TaichiRuntimeError(runs=str(_running), asked=f"the device {device.type}")
    if device.type == "cpu" and threads is not None and threads > _running.threads:
        raise TaichiRuntimeError(runs=str(_running), asked=f"one with {threads} threads")
    return min(wanted, _running.threads)


def _start(device: torch.device, threads: int) -> None:
    if (device.index or 0) > 0:
        raise CapabilityError(f"Taichi runs on the first visible GPU only, not on {device}; choose it by CUDA_VISIBLE_DEVICES.")
    options: dict[str, Any] = {"cpu_max_num_threads": threads} if device.type == "cpu" else {"enable_fallback": False}
    # LLVM optimises anyway: without Taichi's own passes the first gradient comes after a fifth of the time, and as fast;
    # without fast math: it would drop the care that the kernels take of nan and of small differences
    options |= {"cfg_optimization": False, "advanced_optimization": False, "fast_math": False}
    # what it started on is printed, not logged
    with _quietly(), contextlib.redirect_stdout(io.StringIO()):
        ti.init(arch=getattr(ti, device.type), log_level=ti.ERROR, default_fp=ti.f32, default_ip=ti.i32, **options)
