"""Files of the run record: written under a temporary name, then renamed, so that a reader never sees half a file."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import math
import os
import platform
import re
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.run.record_lock import LOCK_FILE

RUN_FILE = "run.json"
METRICS_FILE = "metrics.jsonl"
GOAL_FILE = "goal.h5"
OLD_GOAL_FILE = "target.h5"
"""What it was called up to format 2."""

STAGE_PATTERN = re.compile(r"stage-(\d{3,})\.h5")
UNREVISED_PATTERN = re.compile(r"unrevised-(\d{3,})\.h5")
SHAPE_PATTERN = re.compile(r"shape-[0-9a-f]{16}\.npz")
PICTURE_FILES = ("picture.png", "sheet.png", "curves.png", "animation.mp4", "animation.gif", "report.html")
OWN_FILES = (RUN_FILE, METRICS_FILE, GOAL_FILE, OLD_GOAL_FILE, *PICTURE_FILES)
"""Files, besides the stages', that `overwrite` may remove; pictures are among them since they would show the old run."""

PACKAGES = ("cpdeform", "torch", "warp-lang", "taichi", "pot", "geomloss", "numpy", "h5py")


def stage_file(index: int) -> str:
    """Name of a stage's file."""
    return f"stage-{index:03d}.h5"


def stage_files(directory: Path) -> list[Path]:
    """Files of the finished stages in a directory, in order."""
    return sorted(path for path in directory.iterdir() if STAGE_PATTERN.fullmatch(path.name))


def unrevised_file(index: int) -> str:
    """Name of the copy of a stage's file that is kept, when the stage is revised, until the next one is finished."""
    return f"unrevised-{index:03d}.h5"


def unrevised_files(directory: Path) -> dict[int, Path]:
    """Copies of stages' files from before the last revision, by the numbers of the stages, in order."""
    found = [(UNREVISED_PATTERN.fullmatch(path.name), path) for path in directory.iterdir()]
    return {int(match[1]): path for match, path in sorted(found, key=lambda pair: pair[1]) if match}


def own_files(directory: Path) -> list[Path]:
    """Files in a directory that belong to a run record, left-over temporary ones included."""
    return sorted(path for path in directory.iterdir() if (path.is_file() or path.is_symlink()) and _is_own(path.name))


def _is_own(name: str) -> bool:
    plain = name[1:].replace(".tmp.", ".") if name.startswith(".") else name
    return plain in OWN_FILES or any(pattern.fullmatch(plain) for pattern in (STAGE_PATTERN, UNREVISED_PATTERN, SHAPE_PATTERN))


ATTEMPTS_TO_WRITE = 10
"""How often a directory is made that another process removes at the same moment."""


def check_directory(directory: Path, *, overwrite: bool) -> None:
    """Check that a record can be written, and leave the file system as it was.

    Args:
        directory: The record's directory; it and its parents may be missing.
        overwrite: Whether it may hold files already.

    Raises:
        InputError: It is a file, is not empty, or cannot be made or written to.
    """
    argument = f"output directory {directory}"
    try:
        if directory.exists() and not directory.is_dir():
            raise InputError(argument, came="a file", expected="a directory, or a path that does not exist yet")
        if not overwrite and directory.is_dir() and any(path.name != LOCK_FILE for path in directory.iterdir()):
            raise InputError(
                argument,
                came="a directory that is not empty",
                expected="an empty one, or a path that does not exist yet",
                remedy="Choose another with --out, or replace the record in it with --overwrite.",
            )
        _try_writing(directory)
    except OSError as error:
        came = error.strerror or str(error)
        raise InputError(argument, came=f"a path that cannot be written ({came})", expected="a writable directory") from error


def _try_writing(directory: Path) -> None:
    """Make the directory and a file in it, then remove both; permission bits alone do not tell (root, read-only mounts).

    Other processes may make or remove the same directories at the same time.
    """
    for _ in range(ATTEMPTS_TO_WRITE - 1):
        with contextlib.suppress(FileNotFoundError):
            return _try_writing_once(directory)
    return _try_writing_once(directory)


def _try_writing_once(directory: Path) -> None:
    missing = [path for path in (directory, *directory.parents) if not path.exists()]
    made: list[Path] = []
    try:
        for path in reversed(missing):
            with contextlib.suppress(FileExistsError):
                path.mkdir()
                made.append(path)
        # A name of its own: an existing one may be a link to a file elsewhere.
        with tempfile.TemporaryFile(dir=directory):
            pass
    finally:
        for path in reversed(made):
            with contextlib.suppress(OSError):
                path.rmdir()


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path beside `path`; what was written there takes the place of `path` at the end, in one step."""
    temporary = path.with_name(f".{path.stem}.tmp{path.suffix}")
    try:
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def replacing_hdf5(path: Path) -> Iterator[h5py.File]:
    """Give an HDF5 file in memory; what it holds at the end takes the place of `path`, in one step.

    HDF5 itself never writes to the disk: where that is full, its library cannot close the file, and ends the process.
    """
    with h5py.File(path, "w", driver="core", backing_store=False) as file:
        yield file
        file.flush()
        image = file.id.get_file_image()
    with replacing(path) as temporary:
        temporary.write_bytes(image)


def to_json(value: Any) -> Any:
    """Replace tensors by lists and numbers that are not finite, which JSON cannot hold, by null."""
    if isinstance(value, Tensor):
        return to_json(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): to_json(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_json(entry) for entry in value]
    return value


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file atomically."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(to_json(content), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def write_dataset(group: h5py.Group, name: str, tensor: Tensor, *, shape: str, units: str) -> None:
    """Write a tensor with attributes that say what its axes and numbers are."""
    values = tensor.detach().cpu().numpy()
    options = {"compression": "gzip", "compression_opts": 1, "shuffle": True} if values.size > 1000 else {}
    dataset = group.create_dataset(name, data=values, **options)
    dataset.attrs["shape"] = shape
    dataset.attrs["units"] = units


def environment() -> dict[str, Any]:
    """Versions of Python and of the packages that make a result, and the machine, without names of persons or hosts."""
    versions: dict[str, str | None] = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = None
    return {"versions": versions, "platform": platform.platform(), "cpu_count": os.cpu_count()}
