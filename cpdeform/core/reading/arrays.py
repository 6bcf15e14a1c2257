"""Arrays of unknown origin, from ``.npz``, ``.npy`` and HDF5 files, which are told apart by their content.

with open_arrays(path, argument=f"goal file {path}", expected="...") as file:
    positions = file.read("position", shape=("M", 3))
    weights = file.read("weight", shape=("M",))  # the same M
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

from cpdeform.core.errors import InputError
from cpdeform.core.reading import arrays_numpy
from cpdeform.core.reading.array_file import MOST_NUMBER, NUMBERS, ArrayFile, Container, Header, check_bytes
from cpdeform.core.reading.boundary import open_file
from cpdeform.core.reading.limits import ReadingLimits, default_limits

__all__ = ["MOST_NUMBER", "NUMBERS", "ArrayFile", "Container", "Header", "check_bytes", "open_arrays"]

_REMEDY = "Other formats: read them with their own library and save the numbers with numpy.savez."


@contextlib.contextmanager
def open_arrays(
    path: Path, *, argument: str, expected: str, limits: ReadingLimits | None = None, sizes: Mapping[str, int] | None = None
) -> Iterator[ArrayFile]:
    """Open an ``.npz``, ``.npy`` or HDF5 file; whatever goes wrong inside becomes an `InputError`.

    Args:
        path: The file. A ``.npy`` holds a single array, which goes by the name that is asked for.
        argument: What the file is, for messages.
        expected: What would have been accepted, for messages.
        limits: What is accepted; defaults to `default_limits`.
        sizes: As for `ArrayFile`.

    Raises:
        InputError: The file is missing, unreadable, or of another format.
    """
    limits = limits or default_limits()
    with open_file(path, argument=argument, expected=expected) as file, contextlib.ExitStack() as stack:
        start = file.read(8)
        file.seek(0)
        container: Container
        if start.startswith(b"PK\x03\x04") or start.startswith(b"PK\x05\x06"):
            container = stack.enter_context(arrays_numpy.open_npz(file, argument=argument, limits=limits))
        elif start.startswith(b"\x93NUMPY"):
            container = arrays_numpy.ContainerNpy(file)
        elif start == b"\x89HDF\r\n\x1a\n":
            from cpdeform.core.reading import arrays_hdf5

            container = stack.enter_context(arrays_hdf5.open_hdf5(path, size=_size(file), limits=limits))
        else:
            begins = f"unreadable content (it begins with {start!r})" if start else "unreadable content (an empty file)"
            raise InputError(argument, came=begins, expected=expected, remedy=_REMEDY if start else "")
        yield ArrayFile(container, argument=argument, limits=limits, sizes=sizes)


def _size(file: BinaryIO) -> int:
    size = file.seek(0, 2)
    file.seek(0)
    return size
