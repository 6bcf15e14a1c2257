"""NumPy's files: ``.npy``, and ``.npz``, which is a zip archive of them."""

from __future__ import annotations

import contextlib
import io
import math
import zipfile
from collections.abc import Iterator
from typing import IO, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.errors import InputError
from cpdeform.core.reading.array_file import Container, Header
from cpdeform.core.reading.limits import ReadingLimits

_METHODS = {zipfile.ZIP_STORED: "stored", zipfile.ZIP_DEFLATED: "deflated"}
"""How members of an archive may be packed; NumPy makes no others, and some take as much memory as the file asks for."""

_END, _LOCATOR = b"PK\x05\x06", b"PK\x06\x07"
_END_LENGTH, _LOCATOR_LENGTH, _LONGEST_COMMENT = 22, 20, 65535
_ENTRY_LENGTH = 46
_LONGEST_HEADER = 10_000
_PIECE = 2**20


class ContainerNpy(Container):
    """A ``.npy`` file, whose one array goes by any name.

    Args:
        file: The open file.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    @property
    def names(self) -> tuple[str, ...]:
        """None: the array bears no name."""
        return ()

    def has(self, name: str) -> bool:
        """True: the array goes by any name."""
        return True

    def header(self, name: str, argument: str) -> Header:
        """The header of the array."""
        size = self._file.seek(0, 2)
        self._file.seek(0)
        header = _read_header(self._file, size, argument)
        if self._file.tell() + header.bytes != size:
            raise _wrong_length(argument, header, size - self._file.tell())
        return header

    def load(self, name: str, header: Header) -> NDArray[Any]:
        """Read the array; the file stands behind the header."""
        return _read_values(self._file, header)


class ContainerNpz(Container):
    """A ``.npz`` file.

    Args:
        archive: The open archive.
        argument: What the file is, for messages.
    """

    def __init__(self, archive: zipfile.ZipFile, argument: str) -> None:
        self._archive = archive
        self._members: dict[str, zipfile.ZipInfo] = {}
        for info in archive.infolist():
            name = info.filename.removesuffix(".npy")
            if name in self._members:
                raise InputError(f"{argument}: {name}", came="two arrays of that name", expected="one")
            self._members[name] = info

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the members, without their ending."""
        return tuple(self._members)

    def has(self, name: str) -> bool:
        """Whether there is a member of that name."""
        return name in self._members

    def header(self, name: str, argument: str) -> Header:
        """The header of a member."""
        info = self._members[name]
        if info.flag_bits & 1:
            raise InputError(argument, came="an encrypted member", expected="one that is not encrypted")
        if info.compress_type not in _METHODS:
            came = f"a member packed by method {info.compress_type}"
            raise InputError(argument, came=came, expected=f"one that is {' or '.join(_METHODS.values())}")
        with self._archive.open(info) as stream:
            header = _read_header(stream, info.compress_size, argument)
            if stream.tell() + header.bytes != info.file_size:
                raise _wrong_length(argument, header, info.file_size - stream.tell())
        return header

    def load(self, name: str, header: Header) -> NDArray[Any]:
        """Read a member."""
        with self._archive.open(self._members[name]) as stream:
            _read_header(stream, header.stored, name)
            values = _read_values(stream, header)
            # The check sum is compared where the end is met.
            if stream.read(1):
                raise ValueError("more than its header says")
        return values


@contextlib.contextmanager
def open_npz(file: BinaryIO, *, argument: str, limits: ReadingLimits) -> Iterator[ContainerNpz]:
    """Open an archive whose table of contents was found to be of a reasonable size.

    Args:
        file: The open file.
        argument: What it is, for messages.
        limits: How many members are accepted.

    Raises:
        InputError: There are more members, or two of a name.
    """
    size = file.seek(0, 2)
    file.seek(max(size - _END_LENGTH - _LOCATOR_LENGTH - _LONGEST_COMMENT, 0))
    tail = file.read()
    file.seek(0)
    end = tail.rfind(_END)
    if end < 0 or len(tail) - end < _END_LENGTH:
        raise InputError(argument, came="unreadable content (no table of contents)", expected="a complete .npz file")
    table = int.from_bytes(tail[end + 12 : end + 16], "little")
    # A record in the long format replaces the short one, whatever that says.
    if tail[max(end - _LOCATOR_LENGTH, 0) :].startswith(_LOCATOR) or table > limits.members * 2 * _ENTRY_LENGTH:
        raise InputError(argument, came="a table of contents that is too long", expected=f"at most {limits.members} arrays")
    with zipfile.ZipFile(file) as archive:
        yield ContainerNpz(archive, argument)


def _read_header(stream: IO[bytes], stored: int, argument: str) -> Header:
    """Read a header; the length that it gives for itself is checked before so much is read."""
    start = stream.read(8)
    if len(start) < 8 or not start.startswith(b"\x93NUMPY"):
        raise InputError(argument, came="no array", expected="an array as NumPy writes it")
    version = (start[6], start[7])
    if version not in ((1, 0), (2, 0)):
        raise InputError(argument, came=f"format {version[0]}.{version[1]}", expected="an array of numbers, format 1.0 or 2.0")
    width = 2 if version == (1, 0) else 4
    prefix = stream.read(width)
    length = int.from_bytes(prefix, "little")
    if length > _LONGEST_HEADER:
        raise InputError(argument, came=f"a header of {length} bytes", expected=f"one of at most {_LONGEST_HEADER}")
    content = io.BytesIO(prefix + stream.read(length))
    read = np.lib.format.read_array_header_1_0 if width == 2 else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read(content, max_header_size=_LONGEST_HEADER)
    if dtype.hasobject or dtype.itemsize == 0 or not all(type(part) is int and part >= 0 for part in shape):
        raise InputError(argument, came=f"{dtype} of shape {shape}", expected="an array of numbers")
    return Header(shape, dtype, stored, fortran)


def _read_values(stream: IO[bytes], header: Header) -> NDArray[Any]:
    """Read an array piece by piece, so that a short file is met before much memory is touched."""
    values = np.empty(math.prod(header.shape), dtype=header.dtype)
    buffer = values.view(np.uint8).data
    place = 0
    while place < len(buffer):
        piece = stream.read(min(_PIECE, len(buffer) - place))
        if not piece:
            raise EOFError(f"{place} bytes of {len(buffer)}")
        buffer[place : place + len(piece)] = piece
        place += len(piece)
    return values.reshape(header.shape, order="F" if header.fortran else "C")


def _wrong_length(argument: str, header: Header, left: int) -> InputError:
    return InputError(argument, came=f"{left} bytes for {header}", expected=f"{header.bytes} bytes", remedy="Make the file anew.")
