"""Goal files: particles of the shape wanted, with its node masses where it was imported from a grid."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.errors import InputError
from cpdeform.core.reading.arrays import check_bytes, open_arrays
from cpdeform.core.reading.limits import ReadingLimits
from cpdeform.core.scene import Scene

_EXPECTED = "an .npz, .npy or .h5 file of goal particles"

POSITION_SCALE = 2**16
"""Integer positions in a file are whole multiples of 1/POSITION_SCALE, length units."""


def load_goal(path: Path, *, scene: Scene, limits: ReadingLimits | None = None) -> NDArray[np.float64]:
    """Read goal particles from ``.npz`` or ``.h5`` with an array ``position`` (M, 3), or from ``.npy`` with such an array.

    Integer arrays are positions in units of 2^-16 (compact files), others are in length units.

    Args:
        path: The file.
        scene: Its domain must hold the goal.
        limits: How large it may be; defaults to `cpdeform.core.reading.limits.default_limits`.

    Returns:
        Positions (M, 3), length units.

    Raises:
        InputError: The file is missing, unreadable or too large, or holds something else than finite positions in the domain.
    """
    argument = f"goal file {path}"
    with open_arrays(path, argument=argument, expected=_EXPECTED, limits=limits) as file:
        if "position" not in file:
            raise InputError(argument, came="no array of that name", expected='an array "position" of shape (M, 3)')
        values = file.read("position", shape=("M", 3), finite=False, meaning="positions")
    if not len(values):
        raise InputError(argument, came="positions of shape (0, 3)", expected="positions of shape (M, 3), M >= 1")
    with np.errstate(all="ignore"):
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
            remedy="Scale or shift the goal.",
        )
    return positions


def write_goal_points(path: Path, position: NDArray[np.float64], *, scene: Scene) -> None:
    """Write a goal file of points (M, 3) that lie in a scene's domain, length units.

    Raises:
        InputError: The points are not finite (M, 3) or not in the domain, or the file cannot be written.
    """
    if path.suffix != ".npz":
        raise InputError("path", came=str(path), expected="a file name that ends in .npz")
    if position.ndim != 2 or position.shape[1:] != (3,) or not len(position) or not np.isfinite(position).all():
        raise InputError("points", came=f"shape {position.shape}", expected="finite positions (M, 3), M >= 1")
    lower, upper = (np.asarray(corner) for corner in scene.domain)
    outside = int(((position < lower - 1e-4) | (position > upper + 1e-4)).any(axis=1).sum())
    if outside:
        came = f"{outside} of {len(position)} points outside the domain"
        raise InputError("points", came=came, expected=f"positions within {scene.domain[0]} and {scene.domain[1]}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_goal(path, np.clip(position, lower, upper))
    except OSError as error:
        came = f"a path that cannot be written ({error.strerror or error})"
        raise InputError(f"goal file {path}", came=came, expected="a writable path") from error


def load_goal_grid(path: Path, *, scene: Scene, limits: ReadingLimits | None = None) -> NDArray[np.float64] | None:
    """Read the node masses of a goal file: arrays ``grid_cells`` (K, 3), node indices, and ``grid_mass`` (K,).

    Args:
        path: The file.
        scene: Its grid is the one that the masses belong to.
        limits: As for `load_goal`.

    Returns:
        Node masses (G, G, G); None where the file holds none.

    Raises:
        InputError: The file is missing, unreadable or too large, or the masses do not fit the scene's grid.
    """
    argument = f"goal file {path}"
    with open_arrays(path, argument=argument, expected=_EXPECTED, limits=limits) as file:
        if not file.names or "grid_cells" not in file or "grid_mass" not in file:
            return None
        cells = file.read("grid_cells", shape=("K", 3), kinds="ui", meaning="node indices")
        masses = file.read("grid_mass", shape=("K",), meaning="masses").astype(np.float64)
    if (masses < 0.0).any():
        raise InputError(f"{argument}: grid_mass", came="negative masses", expected="finite masses of at least 0")
    remedy = "Import the grid anew for this scene."
    return dense_grid(cells, masses, scene.grid_size, argument=f"{argument}: grid_cells", remedy=remedy)


def dense_grid(cells: NDArray[Any], masses: NDArray[Any], size: int, *, argument: str, remedy: str = "") -> NDArray[np.float64]:
    """Node masses (G, G, G) of those that are not 0.

    Args:
        cells: Node indices (K, 3), each once.
        masses: Their masses (K,).
        size: Number of nodes G along an axis.
        argument: What the indices are, for messages.
        remedy: What the user can do where they do not fit.

    Raises:
        InputError: An index lies outside of the grid or comes twice, or the grid is too large.
    """
    if len(cells) and not (int(cells.min()) >= 0 and int(cells.max()) < size):
        came = f"a node index {int(cells.min()) if int(cells.min()) < 0 else int(cells.max())}"
        raise InputError(argument, came=came, expected=f"indices from 0 to {size - 1} (grid_size {size})", remedy=remedy)
    check_bytes(8 * size**3, argument=argument, came=f"a grid of {size} nodes along an axis")
    flat = np.ravel_multi_index(tuple(cells.astype(np.int64).T), (size,) * 3)
    if len(np.unique(flat)) != len(flat):
        came = f"{len(flat) - len(np.unique(flat))} nodes more than once"
        raise InputError(argument, came=came, expected="each node once", remedy=remedy)
    grid = np.zeros(size**3)
    grid[flat] = masses
    return grid.reshape((size,) * 3)


def load_correspondence(path: Path) -> bool:
    """Whether a goal file says (array ``corresponds``, one truth value) that its particles are the body's, one to one, moved.

    The goal then is within reach to the last particle: no distance is owed to another sampling of the same shape.

    Args:
        path: The file.

    Raises:
        InputError: The file is missing or unreadable, or the array is no single truth value.
    """
    with open_arrays(path, argument=f"goal file {path}", expected=_EXPECTED) as file:
        return bool(file.names) and "corresponds" in file and bool(file.read("corresponds", shape=(), kinds="b"))


def write_goal(
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
