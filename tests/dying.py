"""Functions that end the process that computes them; in a module that imports nothing slow."""

from __future__ import annotations

import os
import signal
from pathlib import Path


class Die:
    """Ends the process that computes it, unless a file says that this was done."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __call__(self, number: int) -> int:
        if number == 3 and not self.marker.exists():
            self.marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return number**2


class AlwaysDie:
    def __call__(self, number: int) -> int:
        os.kill(os.getpid(), signal.SIGKILL)
        return number


class Refuse:
    """Raises what a part of a plugin may raise."""

    def __call__(self, number: int) -> int:
        # Imported here: the others need nothing slow.
        from cpdeform.core.errors import InputError

        raise InputError("number", came=str(number), expected="none")


class Square:
    """Lives."""

    def __call__(self, number: int) -> int:
        return number**2
