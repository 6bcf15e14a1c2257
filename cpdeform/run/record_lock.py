"""The lock of a record's directory: one run at a time writes there.

The system itself ends the lock with the process, however that ends; a file that a killed run leaves behind locks nothing.
"""

from __future__ import annotations

import os
from pathlib import Path

from filelock import FileLock, Timeout

from cpdeform.core.errors import InputError

LOCK_FILE = ".run.lock"
"""Name of the file, which holds the number of the process and is gone once the run is over."""


class RecordLock:
    """The right to write to a directory, among processes.

    Args:
        directory: The record's directory.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._path = directory / LOCK_FILE
        # Shared within a process: a run that broke off there, and whose trace is still kept, must not lock out the next one.
        self._lock = FileLock(self._path, timeout=0, thread_local=False, is_singleton=True)

    def check(self) -> None:
        """Raise `InputError` if another process has the lock, or it cannot be taken; make no file."""
        if not os.path.lexists(self._path):
            return
        try:
            self._take()
        except OSError as error:
            came = f"a file {LOCK_FILE} that cannot be locked ({error.strerror or error})"
            remedy = "Remove that file, or choose another directory with --out."
            raise InputError(f"output directory {self._directory}", came=came, expected="a lock of a run", remedy=remedy) from error
        self._lock.release()

    def acquire(self) -> None:
        """Take the lock, if this one does not have it yet.

        Raises:
            InputError: Another process has it.
            OSError: The file cannot be written.
        """
        self._take()
        try:
            self._path.write_text(f"{os.getpid()}\n", encoding="ascii")
        except OSError:
            self._lock.release(force=True)
            raise

    def release(self) -> None:
        """Give the lock back and remove its file; nothing happens without the lock."""
        if self._lock.is_locked:
            self._path.unlink(missing_ok=True)
            self._lock.release(force=True)

    def _take(self) -> None:
        try:
            self._lock.acquire()
        except Timeout as error:
            raise InputError(
                f"output directory {self._directory}",
                came=f"one that another run is writing to ({self._holder()})",
                expected="a directory that no run is using",
                remedy="Wait for that run or stop it, or choose another directory with --out.",
            ) from error

    def _holder(self) -> str:
        try:
            return f"process {int(self._path.read_text(encoding='ascii'))}"
        except (OSError, ValueError):
            return "process unknown"
