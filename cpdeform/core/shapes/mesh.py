"""Shapes from triangle meshes: a tool and a body, given by a shape file with a signed-distance grid."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.meshes.grid import DistanceGrid, read_shape
from cpdeform.core.model import PositiveFloat, Vector3
from cpdeform.core.shapes.base import Array, Shape
from cpdeform.core.shapes.body import BodyBase
from cpdeform.core.shapes.tool import ToolBase

if TYPE_CHECKING:
    from torch import Tensor


@dataclasses.dataclass(frozen=True, eq=False)
class ShapeMesh(Shape):
    """The inside of a mesh. Distances are the quadratic B-spline through those at the grid's nodes."""

    grid: DistanceGrid

    def distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """See `Shape`; beyond the grid, the distance at its nearest point and the way there."""
        import torch

        coefficients = torch.as_tensor(self.grid.coefficients).to(x)
        counts, spacing = coefficients.shape, self.grid.spacing
        weights, bases, beyond = [], [], torch.zeros_like(x)
        for place, count in zip((x, y, z), counts, strict=True):
            along = place / spacing + 0.5 * (count - 1)
            inside = along.clamp(1.0, count - 2.0)
            beyond = beyond + (along - inside).square()
            base = inside.detach().round()
            offset = inside - base
            weights.append((0.5 * (0.5 - offset).square(), 0.75 - offset.square(), 0.5 * (0.5 + offset).square()))
            bases.append(base.long().clamp(1, count - 2))
        total = torch.zeros_like(x)
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    node = (bases[0] + i - 1, bases[1] + j - 1, bases[2] + k - 1)
                    total = total + weights[0][i] * weights[1][j] * weights[2][k] * coefficients[node]
        far = beyond > 0.0
        way = torch.where(far, beyond, torch.ones_like(beyond)).sqrt() * spacing
        return total + torch.where(far, way, torch.zeros_like(way))

    def quick_distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """See `Shape`: linear between the nodes."""
        import torch

        distance, spacing = torch.as_tensor(self.grid.distance).to(x), self.grid.spacing
        ends = [0.5 * spacing * (count - 1) for count in distance.shape]
        places = [place / end for place, end in zip((x, y, z), ends, strict=True)]
        # A norm over the first axis of stacked components takes ten times as long as this sum.
        beyond = torch.zeros_like(x)
        for place, end in zip(places, ends, strict=True):
            beyond = beyond + ((place.abs() - 1.0).clamp(min=0.0) * end).square()
        beyond = beyond.sqrt()
        # the order of the axes is the other way round in what grid_sample takes
        at = torch.stack(places[::-1], dim=-1).reshape(1, 1, 1, -1, 3)
        found = torch.nn.functional.grid_sample(distance[None, None], at, padding_mode="border", align_corners=True)
        result: Tensor = found.reshape(x.shape) + beyond
        return result

    def half_extents(self, axes: Tensor) -> Tensor:
        """See `Shape`; those of the box around the mesh's own box."""
        return axes @ axes.new_tensor(0.5 * self.grid.mesh.extents)

    def surface(self, *, rows: int, columns: int) -> Array:
        """Points (R, C, 3) spread over the surface, in no order; see `triangles`."""
        mesh = self.grid.mesh
        corners = mesh.vertices[mesh.faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        generator = np.random.default_rng(0)
        chosen = generator.choice(len(area), size=rows * columns, p=area / area.sum())
        first, second = generator.uniform(size=(2, rows * columns, 1))
        first, second = np.where(first + second > 1.0, 1.0 - first, first), np.where(first + second > 1.0, 1.0 - second, second)
        base = corners[chosen]
        points = base[:, 0] + first * (base[:, 1] - base[:, 0]) + second * (base[:, 2] - base[:, 0])
        return np.asarray(points.reshape(rows, columns, 3))

    def triangles(self) -> tuple[Array, NDArray[np.int64]]:
        """See `Shape`: the mesh's own."""
        return self.grid.mesh.vertices, self.grid.mesh.faces

    @property
    def volume(self) -> float:
        """See `Shape`."""
        return self.grid.volume


class ToolMesh(ToolBase):
    """A tool of any shape.

    Attributes:
        file: Shape file, see `cpdeform.core.meshes.grid.write_shape`; in a task file relative to it.
        scale: Factor of the file's lengths.
    """

    kind: Literal["Mesh"] = "Mesh"
    file: Path
    scale: PositiveFloat = 1.0

    @property
    def grid(self) -> DistanceGrid:
        """The signed distances, length units.

        Raises:
            InputError: The file cannot be used.
        """
        return read_shape(self.file).scaled(self.scale)

    def shape(self, *, gap: Tensor | float | None = None) -> ShapeMesh:
        """See `ToolBase`."""
        return ShapeMesh(self.grid)

    @property
    def kernel_lengths(self) -> tuple[float, ...]:
        """The distance between nodes, and the grid's numbers of nodes."""
        grid = self.grid
        x, y, z = (float(count) for count in grid.distance.shape)
        return (grid.spacing, x, y, z)

    @property
    def kernel_grid(self) -> Array:
        """See `ToolBase`."""
        return self.grid.kernel_numbers


class BodyMesh(BodyBase):
    """Clay of any shape; its `position` is the middle of the shape's box.

    Attributes:
        file: Shape file, see `ToolMesh`.
        scale: Factor of the file's lengths.
    """

    kind: Literal["mesh"] = "mesh"
    file: Path
    scale: PositiveFloat = 1.0

    def shape(self) -> ShapeMesh:
        """See `BodyBase`."""
        return ShapeMesh(read_shape(self.file).scaled(self.scale))

    @property
    def half_extents(self) -> Vector3:
        """See `BodyBase`."""
        x, y, z = (0.5 * float(edge) for edge in self.shape().grid.mesh.extents)
        return x, y, z
