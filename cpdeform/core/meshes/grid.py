"""Signed-distance grids of meshes, and the shape files that hold them."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.errors import InputError
from cpdeform.core.meshes.mesh import Array, Mesh
from cpdeform.core.meshes.sharp import SharpCells, find_sharp_cells
from cpdeform.core.reading.arrays import ArrayFile, open_arrays

RESOLUTION = 80
"""Cells along the longest edge of a mesh's box."""

MARGIN_CELLS = 6
"""Cells of the grid beyond the box on each side; farther away distances are continued."""

MOST_NODES = 200
"""Nodes along an axis that a grid may have."""

EXPECTED = "a shape file (.npz) as `cpdeform task new` and `write_shape` make it"


@dataclasses.dataclass(frozen=True, eq=False)
class DistanceGrid:
    """A mesh around the origin and its signed distance on the nodes of a grid.

    Attributes:
        distance: Signed distance (X, Y, Z) at the nodes, negative inside; the grid's middle is the origin.
        spacing: Distance between nodes.
        mesh: The mesh, its box's middle at the origin.
        volume: What it encloses.
        sharp: Where the distance is computed from triangles instead.
    """

    distance: Array
    spacing: float
    mesh: Mesh
    volume: float
    sharp: SharpCells = dataclasses.field(default_factory=SharpCells.none)

    @functools.cached_property
    def coefficients(self) -> Array:
        """Coefficients (X, Y, Z) of the quadratic B-spline through the distances: what kernels interpolate."""
        return spline_coefficients(self.distance)

    @functools.cached_property
    def kernel_numbers(self) -> Array:
        """What kernels compute the distance from (K,): the coefficients in C order, and `SharpCells.kernel_numbers`."""
        numbers = self.sharp.kernel_numbers(self.mesh, nodes=self.distance.size)
        return np.concatenate([self.coefficients.reshape(-1), numbers])

    def scaled(self, factor: float) -> DistanceGrid:
        """The grid of the mesh with all lengths multiplied."""
        if factor == 1.0:
            return self
        return DistanceGrid(
            factor * self.distance, factor * self.spacing, self.mesh.scaled(factor), factor**3 * self.volume, self.sharp
        )


def spline_coefficients(distance: Array) -> Array:
    """Coefficients (X, Y, Z) of the quadratic B-spline through numbers on a grid."""
    from scipy.ndimage import spline_filter

    return np.asarray(spline_filter(distance, order=2, mode="mirror"))


def make_grid(mesh: Mesh, *, resolution: int = RESOLUTION) -> DistanceGrid:
    """The signed-distance grid of a mesh, moved so that its box's middle is the origin.

    Args:
        mesh: A closed mesh, lengths in units of the domain edge.
        resolution: Cells along the longest edge of its box.
    """
    mesh = mesh.centred()
    spacing = float(mesh.extents.max()) / resolution
    counts = np.ceil(mesh.extents / spacing).astype(int) + 2 * MARGIN_CELLS + 1
    axes = [(np.arange(count) - 0.5 * (count - 1)) * spacing for count in counts]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    distance = mesh.signed_distance(nodes).reshape(counts)
    sharp = find_sharp_cells(mesh, spline_coefficients(distance), spacing)
    return DistanceGrid(distance, spacing, mesh, mesh.volume(), sharp)


def write_shape(path: Path, grid: DistanceGrid) -> None:
    """Write a shape file: distances, spacing, volume, the mesh, and the cells whose distances are computed from its triangles.

    Raises:
        InputError: The file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb") as file:
            np.savez_compressed(
                file,
                distance=grid.distance.astype(np.float32),
                spacing=np.float64(grid.spacing),
                volume=np.float64(grid.volume),
                vertices=grid.mesh.vertices.astype(np.float32),
                faces=grid.mesh.faces.astype(np.int32),
                sharp_cell=grid.sharp.cell.astype(np.int32),
                sharp_group=grid.sharp.group.astype(np.int32),
                sharp_start=grid.sharp.start.astype(np.int32),
                sharp_triangle=grid.sharp.triangle.astype(np.int32),
            )
    except OSError as error:
        came = f"a path that cannot be written ({error.strerror or error})"
        raise InputError(f"shape file {path}", came=came, expected="a writable path") from error


def read_shape(path: Path) -> DistanceGrid:
    """Read a shape file; read once as long as the file stays as it is.

    Raises:
        InputError: It is missing, unreadable or too large, or holds something else.
    """
    try:
        status = path.stat()
    except (OSError, ValueError) as error:
        raise InputError(f"shape file {path}", came="no such file", expected=EXPECTED) from error
    return _read(path, status.st_mtime_ns, status.st_size)


@functools.lru_cache(maxsize=32)
def _read(path: Path, _time: int, _size: int) -> DistanceGrid:
    argument = f"shape file {path}"
    with open_arrays(path, argument=argument, expected=EXPECTED) as file:
        distance = file.read("distance", shape=("X", "Y", "Z"), kinds="f", meaning="distances").astype(np.float64)
        spacing, volume = (float(file.read(name, shape=(), kinds="f", meaning="a number")) for name in ("spacing", "volume"))
        vertices = file.read("vertices", shape=("V", 3), kinds="f", meaning="corners").astype(np.float64)
        faces = file.read("faces", shape=("F", 3), kinds="ui", meaning="indices").astype(np.int64)
        sharp = _read_sharp(file)
    if not all(2 * MARGIN_CELLS < count <= MOST_NODES for count in distance.shape):
        raise InputError(argument, came=f"a grid of shape {distance.shape}", expected=f"up to {MOST_NODES} nodes along an axis")
    if not (spacing > 0.0 and volume > 0.0 and len(faces) and 0 <= int(faces.min()) <= int(faces.max()) < len(vertices)):
        raise InputError(argument, came="sizes or indices that do not fit", expected=EXPECTED)
    if not float(distance.min()) < 0.0 < _least_at_faces(distance):
        raise InputError(argument, came="distances of no closed surface inside the grid", expected=EXPECTED)
    if not sharp.fits(nodes=distance.size, faces=len(faces)):
        raise InputError(argument, came="indices of sharp cells that do not fit", expected=EXPECTED)
    return DistanceGrid(distance, spacing, Mesh(vertices, faces), volume, sharp)


def _read_sharp(file: ArrayFile) -> SharpCells:
    """The cells at sharp edges; none in files of older versions, which have the spline only."""
    if "sharp_cell" not in file:
        return SharpCells.none()
    sizes = {"cell": "C", "group": "C", "start": "G", "triangle": "T"}
    read = {name: file.read(f"sharp_{name}", shape=(size,), kinds="ui", meaning="indices") for name, size in sizes.items()}
    return SharpCells(**{name: indices.astype(np.int64) for name, indices in read.items()})


def _least_at_faces(distance: NDArray[np.float64]) -> float:
    return min(float(np.take(distance, (0, -1), axis=axis).min()) for axis in range(3))
