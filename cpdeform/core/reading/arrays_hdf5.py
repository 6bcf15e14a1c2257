"""HDF5 files: datasets and attributes, without what would lead into other files."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from cpdeform.core.errors import InputError
from cpdeform.core.reading.array_file import ArrayFile, Container, Header
from cpdeform.core.reading.boundary import boundary
from cpdeform.core.reading.limits import MEBIBYTE, ReadingLimits

_FILTERS = (h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32, h5py.h5z.FILTER_LZF)
_SMALL = 16 * MEBIBYTE
_MOST_RATIO = 1100
"""What deflate packs zeros by; a dataset of which nothing was written takes no room at all."""

_ATTRIBUTE_BYTES = 65536
_TEXTS, _TEXT_BYTES = 100_000, 16 * MEBIBYTE


class ContainerHdf5(Container):
    """An HDF5 file; names with slashes go into its groups.

    Args:
        file: The open file.
        size: Its bytes.
        limits: What is accepted.
    """

    def __init__(self, file: h5py.File, *, size: int, limits: ReadingLimits) -> None:
        self._file = file
        self._size = size
        self._limits = limits

    @property
    def names(self) -> tuple[str, ...]:
        """Names at the top of the file, at most as many as are accepted."""
        return tuple(name for name, _ in zip(self._file, range(self._limits.members), strict=False))

    def has(self, name: str) -> bool:
        """Whether there is a group or a dataset of that name in this very file."""
        return self._find(name) is not None

    def _find(self, name: str) -> Any:
        """The object of a name; None where there is none, or only a link to another place or file."""
        node: Any = self._file
        for part in name.split("/"):
            if not isinstance(node, h5py.Group) or part not in node.keys():  # noqa: SIM118 - `in node` follows links
                return None
            if not isinstance(node.get(part, getlink=True), h5py.HardLink):
                return None
            node = node[part]
        return node

    def dataset(self, name: str, argument: str) -> h5py.Dataset:
        """A dataset whose values lie in this file, in a packing that every HDF5 library knows."""
        dataset = self._find(name)
        if not isinstance(dataset, h5py.Dataset) or dataset.shape is None:
            raise InputError(argument, came="a group" if isinstance(dataset, h5py.Group) else "no array", expected="an array")
        if dataset.is_virtual or dataset.external:
            raise InputError(argument, came="an array that lies in another file", expected="one in this file")
        plist = dataset.id.get_create_plist()
        for index in range(plist.get_nfilters()):
            if plist.get_filter(index)[0] not in _FILTERS:
                raise InputError(argument, came=f"filter {plist.get_filter(index)[0]}", expected="gzip, lzf or no packing")
        return dataset

    def header(self, name: str, argument: str) -> Header:
        """The header of a dataset."""
        dataset = self.dataset(name, argument)
        header = Header(tuple(int(part) for part in dataset.shape), dataset.dtype, int(dataset.id.get_storage_size()))
        chunk = math.prod(dataset.chunks or ()) * header.dtype.itemsize
        if chunk > self._limits.array_bytes:
            raise InputError(argument, came=f"pieces of {chunk} bytes", expected=f"at most {self._limits.array_bytes}")
        if header.bytes > _SMALL and header.bytes > _MOST_RATIO * min(header.stored, self._size):
            raise InputError(argument, came=f"{header} in {header.stored} bytes", expected="an array that the file holds")
        return header

    def load(self, name: str, header: Header) -> NDArray[Any]:
        """Read a dataset."""
        return np.asarray(self._find(name)[()])


@contextlib.contextmanager
def open_hdf5(path: Path, *, size: int, limits: ReadingLimits) -> Iterator[ContainerHdf5]:
    """Open an HDF5 file.

    Args:
        path: The file, which is a plain one.
        size: Its bytes.
        limits: What is accepted.
    """
    with h5py.File(path, "r") as file:
        yield ContainerHdf5(file, size=size, limits=limits)


def _hdf5(file: ArrayFile) -> ContainerHdf5:
    if not isinstance(file.container, ContainerHdf5):
        raise InputError(file.argument, came="a file of another format", expected="an HDF5 file")
    return file.container


def has_attribute(file: ArrayFile, name: str) -> bool:
    """Whether a value of that name is attached to the whole file."""
    with boundary(f"{file.argument}: {name}", expected="a value"):
        return name in _hdf5(file)._file.attrs


def read_attribute(file: ArrayFile, name: str, kind: type[Any]) -> Any:
    """Read a single value that is attached to the whole file.

    Args:
        file: An HDF5 file.
        name: The attribute's name.
        kind: `int`, `float` or `str`.

    Raises:
        InputError: There is none, or it is of another kind.
    """
    argument, names = f"{file.argument}: {name}", {int: "a whole number", float: "a number", str: "a text"}
    with boundary(argument, expected=names[kind]):
        attributes = _hdf5(file)._file.attrs
        if name not in attributes:
            raise InputError(argument, came="nothing", expected=names[kind])
        identifier = attributes.get_id(name)
        if identifier.shape != () or identifier.get_storage_size() > _ATTRIBUTE_BYTES:
            raise InputError(argument, came=f"{identifier.dtype} of shape {identifier.shape}", expected=names[kind])
        value = attributes[name]
        if kind is str and isinstance(value, str):
            return value
        if kind is int and isinstance(value, np.integer):
            return int(value)
        if kind is float and isinstance(value, (np.floating, np.integer)):
            return float(value)
        raise InputError(argument, came=f"{value!r}", expected=names[kind])


def read_texts(file: ArrayFile, name: str, *, count: int) -> list[str]:
    """Read a list of texts.

    Args:
        file: An HDF5 file.
        name: The dataset's name.
        count: Its length.

    Raises:
        InputError: There is none, or it holds something else or too much.
    """
    argument, expected = f"{file.argument}: {name}", f"{count} texts"
    with boundary(argument, expected=expected):
        dataset = _hdf5(file).dataset(name, argument)
        if h5py.check_string_dtype(dataset.dtype) is None or dataset.shape != (count,) or count > _TEXTS:
            raise InputError(argument, came=f"{dataset.dtype} of shape {dataset.shape}", expected=expected)
        texts: list[str] = []
        length = 0
        # One by one: many texts may lie in one place of the file.
        for value in (dataset[index] for index in range(count)):
            length += len(value)
            if length > _TEXT_BYTES:
                raise InputError(argument, came=f"more than {_TEXT_BYTES} bytes", expected=expected)
            texts.append(value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value))
        return texts
