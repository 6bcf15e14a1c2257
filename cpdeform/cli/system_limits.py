"""Limits of the system that a command may meet anywhere: no bugs, so no traces."""

from __future__ import annotations

import errno
from collections.abc import Mapping
from types import MappingProxyType

REMEDIES: Mapping[int, str] = MappingProxyType(
    {
        errno.EMFILE: "Raise the number of open files that a process may have (ulimit -n 1024).",
        errno.ENFILE: "Close other programs: the system has no more open files.",
        errno.ENAMETOOLONG: "Choose a shorter path.",
        errno.ENOSPC: "Free some space, or choose a folder on another disk.",
        errno.EDQUOT: "Free some space, or choose a folder on another disk.",
        errno.EROFS: "Choose a folder that can be written to.",
    }
)
"""What to do about an error number of the system."""


def system_limit(error: OSError) -> str | None:
    """One line about an error that is a limit of the system, with the path and a remedy; None for any other."""
    remedy = REMEDIES.get(error.errno or 0)
    if remedy is None:
        return None
    place = "" if error.filename is None else f"{error.filename}: "
    return f"{place}{(error.strerror or type(error).__name__).lower()}. {remedy}"
