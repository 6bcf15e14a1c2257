"""The boundary to files: opening without waiting, and every failure as one `InputError`."""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from cpdeform.core.errors import CpdeformError, InputError, brief

_KINDS = {
    stat.S_IFDIR: "a directory",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}


@contextlib.contextmanager
def boundary(argument: str, *, expected: str) -> Iterator[None]:
    """Turn whatever is raised inside into one `InputError`; errors that are for the user already pass as they are.

    Args:
        argument: What is read, e.g. ``"goal file goal.npz"``.
        expected: What would have been accepted.

    Raises:
        InputError: Something inside failed.
    """
    try:
        yield
    except CpdeformError:
        raise
    except FileNotFoundError as error:
        raise InputError(argument, came="no such file", expected=expected) from error
    except MemoryError as error:
        raise InputError(argument, came="more than the memory holds", expected=expected) from error
    except RecursionError as error:
        raise InputError(argument, came="unreadable content (nested too deep)", expected=expected) from error
    except Exception as error:
        # Whatever a damaged file makes a library raise, the file is at fault; the cause stays in the chain.
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        reason = brief(reason, 120) or type(error).__name__
        raise InputError(argument, came=f"unreadable content ({reason})", expected=expected) from error


@contextlib.contextmanager
def open_file(path: Path, *, argument: str, expected: str) -> Iterator[BinaryIO]:
    """Open a plain file for reading, within `boundary`. A pipe or a device is refused without waiting for what it would send.

    Args:
        path: The file; symbolic links are followed.
        argument: As for `boundary`.
        expected: As for `boundary`.

    Raises:
        InputError: It is missing, is no plain file or cannot be read; or something inside failed.
    """
    with boundary(argument, expected=expected):
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
        kind = stat.S_IFMT(os.stat(path).st_mode)
        if kind not in _KINDS:
            with os.fdopen(os.open(path, flags), "rb") as file:
                yield file
            return
        raise InputError(argument, came=f"unreadable content ({_KINDS[kind]})", expected=expected)


def read_text(path: Path, *, argument: str, expected: str, limit: int) -> str:
    """Read a text of at most `limit` bytes, UTF-8.

    Args:
        path: The file.
        argument: As for `boundary`.
        expected: As for `boundary`.
        limit: The most bytes.

    Raises:
        InputError: It cannot be read, is too long or no UTF-8.
    """
    with open_file(path, argument=argument, expected=expected) as file:
        # A file of the system's may tell no size, so that only reading shows it.
        content = file.read(limit + 1)
        if len(content) > limit:
            raise InputError(argument, came=f"more than {limit} bytes", expected=expected)
        return content.decode("utf-8")
