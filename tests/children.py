"""Child processes that tests interrupt, or give a small disk."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

COMMAND = (
    "import signal, sys\n"
    "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    "signal.signal(signal.SIGHUP, signal.SIG_DFL)\n"
    "from cpdeform.cli.main import main\n"
    "sys.argv[0] = 'cpdeform'\n"
    "main()\n"
)


def interruptible_command(arguments: Sequence[str]) -> list[str]:
    """The command line's arguments as a child's, which control-C and SIGHUP interrupt even where its parent ignores them.

    What a script starts in the background ignores the first, what `nohup` starts the second, and children inherit that.
    """
    return [sys.executable, "-c", COMMAND, *arguments]


@contextlib.contextmanager
def interrupts_ignored() -> Iterator[None]:
    """As if a script had started the tests in the background."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def child_environment(*paths: Path) -> dict[str, str]:
    """The environment of a child process that finds the toy parts of `tests/toys`, and what this process was told to find.

    Args:
        paths: Further places to import from, e.g. that of the toys' distribution.
    """
    places = [str(Path(__file__).parent / "toys"), *map(str, paths), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(place for place in places if place)}


@contextlib.contextmanager
def small_disk(directory: Path, kilobytes: int) -> Iterator[Path]:
    """A file system in memory of some kilobytes, mounted in a directory; skips the test where mounting is not possible."""
    place = directory / "disk"
    place.mkdir()
    options = ["-t", "tmpfs", "-o", f"size={kilobytes}k", "cpdeform-test"]
    try:
        subprocess.run(["mount", *options, str(place)], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"NOT TESTED: a full disk needs the right to mount one, which this process does not have ({error})")
    try:
        yield place
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True)
