"""Where compiled kernels are kept: the user's cache, or a temporary folder where that cannot be written to."""

from __future__ import annotations

import functools
import os
import shutil
import tempfile
import warnings
from pathlib import Path

from cpdeform.core.errors import InputError

ROOM = 32 * 2**20
"""Bytes that compiled kernels may need; those of all backends together take six millions."""


def user_cache() -> Path:
    """The folder of the user's caches, as the XDG base directory specification has it; it need not exist."""
    named = os.environ.get("XDG_CACHE_HOME")
    return Path(named) if named else Path(os.path.expanduser("~")) / ".cache"


def cache_folder(wanted: Path, *, setting: str) -> Path:
    """The folder that is wanted, if it can be written to, or else a temporary one, with a warning that says so.

    Args:
        wanted: The folder; made if it is not there.
        setting: Name of the environment variable that chooses it, for the messages.

    Returns:
        `wanted`, or a folder that is removed when the process ends.

    Raises:
        InputError: Temporary files cannot be written, either.
    """
    fault = _fault(wanted)
    if fault is None:
        return wanted
    needed = f"a folder with {ROOM >> 20} MB free that can be written to"
    try:
        temporary = Path(_temporary_folder(os.getpid()).name)
    except OSError as error:
        remedy = f"Set {setting} or TMPDIR to such a folder."
        raise InputError(setting, came=f"{wanted} ({fault}), and no temporary folder", expected=needed, remedy=remedy) from error
    other = _fault(temporary)
    if other is not None:
        came = f"{wanted} ({fault}) and {temporary} ({other})"
        raise InputError(setting, came=came, expected=needed, remedy=f"Set {setting} or TMPDIR to such a folder.")
    warnings.warn(
        f"{wanted} cannot hold compiled kernels ({fault}); this process keeps them in {temporary}. Set {setting} to {needed} "
        "to compile but once.",
        UserWarning,
        stacklevel=2,
    )
    return temporary


def _fault(folder: Path) -> str | None:
    """Why files cannot be written to a folder, or None."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(4096))
        free = shutil.disk_usage(folder).free
    except OSError as error:
        return (error.strerror or type(error).__name__).lower()
    return f"{free / 2**20:.1f} MB free" if free < ROOM else None


@functools.lru_cache(maxsize=1)
def _temporary_folder(process: int) -> tempfile.TemporaryDirectory[str]:
    """One folder for a process; removed when it ends."""
    return tempfile.TemporaryDirectory(prefix=f"cpdeform-{process}-")
