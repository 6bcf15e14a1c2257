"""The arrays of an open file: headers first, contents after they were accepted."""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.errors import InputError
from cpdeform.core.reading.boundary import boundary
from cpdeform.core.reading.limits import MEBIBYTE, VARIABLE, ReadingLimits, default_limits

NUMBERS = "fui"
"""Kinds of `numpy.dtype` that are real numbers; ``"b"`` is for truth values."""

_NAMES = {"f": "numbers", "u": "whole numbers", "i": "whole numbers", "b": "truth values"}
MOST_NUMBER = 1e30
"""Largest magnitude that is accepted where numbers have to be finite: its square is finite, too."""


@dataclasses.dataclass(frozen=True)
class Header:
    """What a file says about an array, before any of it is read.

    Attributes:
        shape: Its shape.
        dtype: Its type.
        stored: Bytes that it takes in the file.
        fortran: Whether the first index runs fastest.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    stored: int
    fortran: bool = False

    @property
    def bytes(self) -> int:
        """Bytes of the array."""
        return math.prod(self.shape) * self.dtype.itemsize

    def __str__(self) -> str:
        return f"{self.dtype} of shape {self.shape}"


class Container(abc.ABC):
    """A file's format: headers first, contents after they were accepted."""

    @property
    @abc.abstractmethod
    def names(self) -> tuple[str, ...]:
        """Names of the arrays."""

    @abc.abstractmethod
    def has(self, name: str) -> bool:
        """Whether there is anything of that name."""

    @abc.abstractmethod
    def header(self, name: str, argument: str) -> Header:
        """The header of an array; raises `InputError` where what bears the name is none."""

    @abc.abstractmethod
    def load(self, name: str, header: Header) -> NDArray[Any]:
        """Read an array whose header was accepted."""


class ArrayFile:
    """The arrays of an open file.

    Args:
        container: The file's format.
        argument: What the file is, for messages.
        limits: What is accepted.
        sizes: Sizes that are known already, by the names that `read` uses.
    """

    def __init__(
        self, container: Container, *, argument: str, limits: ReadingLimits, sizes: Mapping[str, int] | None = None
    ) -> None:
        self.container = container
        self.argument = argument
        self._limits = limits
        self._taken = 0
        self._sizes = dict(sizes or {})

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the arrays, in the file's order."""
        return self.container.names

    def __contains__(self, name: str) -> bool:
        return self.container.has(name)

    def header(self, name: str) -> Header:
        """What the file says about an array.

        Raises:
            InputError: There is no array of that name.
        """
        argument = f"{self.argument}: {name}"
        with boundary(argument, expected="an array"):
            if name not in self:
                raise InputError(self.argument, came="no array of that name", expected=f'an array "{name}"')
            return self.container.header(name, argument)

    def read(
        self, name: str, *, shape: Sequence[int | str] | None, kinds: str = NUMBERS, finite: bool = True, meaning: str = ""
    ) -> NDArray[Any]:
        """Read an array; its shape, type and size are checked before memory is taken for it.

        Args:
            name: Its name.
            shape: Its shape: numbers, and names of sizes, which stand for one size wherever this file's arrays use them; None
                for any.
            kinds: Kinds of `numpy.dtype` that are accepted.
            finite: Whether numbers that are not finite, or larger than `MOST_NUMBER`, are refused.
            meaning: What it holds, for messages, e.g. ``"positions"``.

        Raises:
            InputError: There is no such array, or it is not as described.
        """
        header = self.header(name)
        argument, what = f"{self.argument}: {name}", meaning or _NAMES.get(kinds[0], "an array")
        wanted = what if shape is None else f"{what} of shape {_shape_text(shape, self._sizes)}"
        if header.dtype.kind not in kinds or (shape is not None and not self._fits(header.shape, shape)):
            raise InputError(argument, came=str(header), expected=wanted)
        self._charge(argument, header)
        with boundary(argument, expected=wanted):
            values = self.container.load(name, header)
            if header.dtype.kind == "f" and finite:
                bad = int(np.count_nonzero(~(np.abs(values) <= MOST_NUMBER)))
                if bad:
                    raise InputError(argument, came=f"{bad} values that are nan, infinite or huge", expected="finite numbers")
        return values

    def _fits(self, found: tuple[int, ...], shape: Sequence[int | str]) -> bool:
        if len(found) != len(shape):
            return False
        sizes = dict(self._sizes)
        for size, wanted in zip(found, shape, strict=True):
            if size != (sizes.setdefault(wanted, size) if isinstance(wanted, str) else wanted):
                return False
        self._sizes = sizes
        return True

    def _charge(self, argument: str, header: Header) -> None:
        self._taken += header.bytes
        came = f"{header}, with what was read before"
        check_bytes(self._taken, argument=argument, came=came, limits=self._limits)


def check_bytes(count: int, *, argument: str, came: str, limits: ReadingLimits | None = None) -> None:
    """Raise `InputError` where an array that a file asks for takes more memory than is accepted.

    Args:
        count: Its bytes.
        argument: What asks for it, for messages.
        came: What it is.
        limits: What is accepted; defaults to `default_limits`.
    """
    most = (limits or default_limits()).array_bytes
    if count > most:
        raise InputError(
            argument,
            came=f"{came}: {count / MEBIBYTE:.4g} MiB",
            expected=f"at most {most / MEBIBYTE:.4g} MiB",
            remedy=f"If you trust the file, set {VARIABLE} higher.",
        )


def _shape_text(shape: Sequence[int | str], sizes: dict[str, int]) -> str:
    parts = [f"{part} = {sizes[part]}" if isinstance(part, str) and part in sizes else str(part) for part in shape]
    return f"({', '.join(parts)}{',' if len(parts) == 1 else ''})"
