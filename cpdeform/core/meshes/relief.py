"""A grey-scale picture as a relief that is pressed into a board: black is deepest."""

from __future__ import annotations

import dataclasses
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.errors import InputError, MissingExtraError
from cpdeform.core.meshes.mesh import Array
from cpdeform.core.reading.boundary import boundary

PICTURES = (".png", ".jpg", ".jpeg", ".bmp")
EXPECTED = "a picture in a .png, .jpg or .bmp file"
MOST_PIXELS = 50_000_000
LONGEST_EDGE = 256
"""Pixels along the longer edge that a relief keeps; finer detail is finer than particles."""


def read_relief(path: Path) -> Array:
    """Read a picture as depths.

    Args:
        path: A picture. Where it is transparent it counts as white.

    Returns:
        Depths (rows, columns), 0 for white and 1 for black; the first row is the picture's upper edge.

    Raises:
        InputError: The file cannot be read, or is one single grey.
        MissingExtraError: The extra `meshes` is not installed.
    """
    try:
        from PIL import Image
    except ImportError as error:
        raise MissingExtraError("goal", "picture", module="PIL", install='pip install "cpdeform[meshes]"') from error
    argument = f"picture {path}"
    with boundary(argument, expected=EXPECTED), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with Image.open(path) as picture:
            if picture.width * picture.height > MOST_PIXELS:
                raise InputError(argument, came=f"{picture.width} x {picture.height} pixels", expected=f"at most {MOST_PIXELS}")
            layers = picture.convert("RGBA")
            grey = Image.alpha_composite(Image.new("RGBA", layers.size, "white"), layers).convert("L")
            grey.thumbnail((LONGEST_EDGE, LONGEST_EDGE))
            depth = 1.0 - np.asarray(grey, dtype=np.float64) / 255.0
    if not np.ptp(depth) > 0.02:
        raise InputError(argument, came="a picture of one single grey", expected="dark strokes on a light ground")
    return np.asarray(depth)


@dataclasses.dataclass(frozen=True)
class Relief:
    """A board with a relief in its upper face, of the board's own volume. It is a `cpdeform.core.meshes.filling.Fillable`.

    Clay that is pressed down has to go somewhere: the whole face lies as much higher as makes up for it.

    Attributes:
        lower: Lower corner (3,) of the board, length units.
        widths: Its edges (3,) before the relief is pressed in, length units.
        depths: Depths (rows, columns) in [0, 1], rows along z, columns along x.
        depth: Depth of 1, length units.
    """

    lower: Array
    widths: Array
    depths: Array
    depth: float

    @property
    def heights(self) -> Array:
        """Heights (rows, columns) of the upper face, length units."""
        return np.asarray(self.lower[1] + self.widths[1] - self.depth * (self.depths - self.depths.mean()))

    @property
    def corners(self) -> tuple[Array, Array]:
        """Lower and upper corner (3,) of a box around the board, length units."""
        upper = self.lower + self.widths
        upper[1] = self.heights.max()
        return self.lower, upper

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Whether each of the points (K, 3), length units, is inside: (K,)."""
        from scipy.ndimage import map_coordinates

        within = (points - self.lower) / self.widths
        rows, columns = self.depths.shape
        place = np.stack([within[:, 2] * rows - 0.5, within[:, 0] * columns - 0.5])
        height = map_coordinates(self.heights, place, order=1, mode="nearest")
        sides = ((within[:, [0, 2]] >= 0.0) & (within[:, [0, 2]] <= 1.0)).all(axis=1)
        return np.asarray(sides & (points[:, 1] >= self.lower[1]) & (points[:, 1] <= height))
