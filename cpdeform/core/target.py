"""Goal files: particles of a target shape, with its node masses where it was imported from a grid."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.errors import InputError
from cpdeform.core.scene import Scene

POSITION_SCALE = 2**16
"""Integer positions in a file are whole multiples of 1/POSITION_SCALE, length units."""


def load_target(path: Path, *, scene: Scene) -> NDArray[np.float64]:
    """Read target particles from ``.npz`` or ``.h5`` with an array ``position`` (M, 3), or from ``.npy`` with such an array.

    Integer arrays are positions in units of 2^-16 (compact files), others are in length units.

    Args:
        path: The file.
        scene: Its domain must hold the target.

    Returns:
        Positions (M, 3), length units.

    Raises:
        InputError: The file is missing or unreadable, or holds something else than finite positions in the domain.
    """
    argument = f"target file {path}"
    with _arrays(path) as arrays:
        if "position" not in arrays:
            raise InputError(argument, came="no array of that name", expected='an array "position" of shape (M, 3)')
        values = np.asarray(arrays["position"])
    if values.ndim != 2 or values.shape[1] != 3 or not len(values) or values.dtype.kind not in "fui":
        raise InputError(argument, came=f"{values.dtype} of shape {values.shape}", expected="positions of shape (M, 3), M >= 1")
    positions = values.astype(np.float64) / (1.0 if values.dtype.kind == "f" else POSITION_SCALE)
    bad = int((~np.isfinite(positions)).any(axis=1).sum())
    if bad:
        came = f"{bad} particles with nan or infinity"
        raise InputError(argument, came=came, expected="finite positions", remedy="Make the file anew.")
    lower, upper = scene.domain
    outside = int(((positions < np.asarray(lower) - 1e-4) | (positions > np.asarray(upper) + 1e-4)).any(axis=1).sum())
    if outside:
        raise InputError(
            argument,
            came=f"{outside} of {len(positions)} particles outside the domain",
            expected=f"positions within {lower} and {upper}",
            remedy="Scale or shift the target.",
        )
    return positions


def load_target_grid(path: Path, *, scene: Scene) -> NDArray[np.float64] | None:
    """Read the node masses of a goal file: arrays ``grid_cells`` (K, 3), node indices, and ``grid_mass`` (K,).

    Args:
        path: The file.
        scene: Its grid is the one that the masses belong to.

    Returns:
        Node masses (G, G, G); None where the file holds none.

    Raises:
        InputError: The file is missing or unreadable, or the masses do not fit the scene's grid.
    """
    argument = f"target file {path}"
    with _arrays(path) as arrays:
        if "grid_cells" not in arrays or "grid_mass" not in arrays:
            return None
        cells, masses = np.asarray(arrays["grid_cells"]), np.asarray(arrays["grid_mass"], dtype=np.float64)
    if cells.ndim != 2 or cells.shape[1] != 3 or masses.shape != cells.shape[:1] or cells.dtype.kind not in "ui":
        came = f"grid_cells {cells.dtype} {cells.shape}, grid_mass {masses.shape}"
        raise InputError(argument, came=came, expected="node indices (K, 3) and masses (K,)")
    if len(cells) and int(cells.max()) >= scene.grid_size:
        came, expected = f"a node index {int(cells.max())}", f"indices below the scene's grid_size {scene.grid_size}"
        raise InputError(argument, came=came, expected=expected, remedy="Import the grid anew for this scene.")
    if not np.isfinite(masses).all() or (masses < 0.0).any():
        raise InputError(argument, came="negative or non-finite masses", expected="finite masses of at least 0")
    grid = np.zeros((scene.grid_size,) * 3)
    grid[tuple(cells.astype(np.int64).T)] = masses
    return grid


def load_correspondence(path: Path) -> bool:
    """Whether a goal file says (array ``corresponds``, one truth value) that its particles are the body's, one to one, moved.

    The goal then is within reach to the last particle: no distance is owed to another sampling of the same shape.

    Args:
        path: The file.

    Raises:
        InputError: The file is missing or unreadable.
    """
    with _arrays(path) as arrays:
        return "corresponds" in arrays and bool(np.asarray(arrays["corresponds"]).all())


def write_target(
    path: Path, position: NDArray[Any], *, grid: NDArray[np.floating[Any]] | None = None, corresponds: bool = False
) -> None:
    """Write a goal file, an ``.npz`` whose bytes depend on its content alone (no time stamp).

    Args:
        path: The file; its directory must exist.
        position: Goal particles (M, 3): integers in units of 2^-16 length units, or length units, which are rounded to that.
        grid: Node masses (G, G, G) of the goal, mass units, where it was imported from them.
        corresponds: Whether particle i is particle i of the body, moved; see `load_correspondence`.
    """
    if position.dtype.kind == "f":
        position = np.rint(position * POSITION_SCALE)
    arrays: dict[str, NDArray[Any]] = {"position": np.clip(position, 0, POSITION_SCALE - 1).astype(np.uint16)}
    if grid is not None:
        cells = np.argwhere(grid > 0.0)
        arrays["grid_cells"] = cells.astype(np.uint8 if max(grid.shape) <= 256 else np.uint16)
        arrays["grid_mass"] = grid[tuple(cells.T)].astype(np.float32)
    if corresponds:
        arrays["corresponds"] = np.array(True)
    with zipfile.ZipFile(path, "w") as archive:
        for name, values in arrays.items():
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, values, allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), buffer.getvalue(), zipfile.ZIP_DEFLATED, 9)


@contextmanager
def _arrays(path: Path) -> Iterator[Mapping[str, Any]]:
    """The arrays in a file by name; whatever makes it unreadable becomes an `InputError`."""
    argument = f"target file {path}"
    try:
        # Opened here, since numpy leaves the file open where it turns out to be a damaged archive.
        with path.open("rb") as file:
            if path.suffix == ".h5":
                import h5py

                with h5py.File(file, "r") as content:
                    yield content
            else:
                loaded = np.load(file, allow_pickle=False)
                yield loaded if isinstance(loaded, np.lib.npyio.NpzFile) else {"position": np.asarray(loaded)}
    except FileNotFoundError as error:
        raise InputError(argument, came="no such file", expected="an .npz or .npy file of target particles") from error
    except InputError:
        raise
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(argument, came=f"unreadable content ({error})", expected="an .npz or .npy file of numbers") from error
