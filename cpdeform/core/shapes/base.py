"""What every shape answers."""

from __future__ import annotations

import abc
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor

Array = NDArray[np.float64]
RandomNumbers = np.random.Generator | np.random.RandomState


class Shape(abc.ABC):
    """A solid in its local frame, lengths in units of the domain edge.

    Distances are torch functions, differentiable with finite gradients everywhere: where there is no gradient (a sphere's centre,
    a box's medial planes), autograd returns one element of the subdifferential, of length at most 1.
    """

    @abc.abstractmethod
    def distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """Signed distance (...) of the points with the coordinates x, y, z (...) to the surface, negative inside, length units."""

    def quick_distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """As `distance`, for searches over very many points that need no gradient; a little less exact where that is quicker."""
        return self.distance(x, y, z)

    @abc.abstractmethod
    def half_extents(self, axes: Tensor) -> Tensor:
        """Half edges of the smallest box around the solid that is centred on the local origin.

        Args:
            axes: The box's axes (3, 3), one a row, as absolute values of their components in the local frame.

        Returns:
            Half edges (3,) along these axes, length units.
        """

    @abc.abstractmethod
    def surface(self, *, rows: int, columns: int) -> Array:
        """The surface as a grid of points (R, C, 3), length units.

        Neighbours in the grid are neighbours on the surface, and the last column is the first one again, so that grid cells are
        the quadrilaterals of a closed mesh.

        Args:
            rows: Points from pole to pole, about.
            columns: Points around, about.
        """

    def triangles(self) -> tuple[Array, NDArray[np.int64]] | None:
        """Corners (V, 3), length units, and triangles (F, 3) of a surface that is no grid; None where `surface` is all of it."""
        return None

    @property
    @abc.abstractmethod
    def volume(self) -> float:
        """Volume, cubic length units."""

    def distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (...), length units, of points (..., 3), and its gradient (..., 3), which is the outward normal."""
        # Imported on use, here and below: models are read where torch's import would take longer than the command.
        import torch

        points = points.detach().requires_grad_()
        with torch.enable_grad():
            distance = self.distance(*points.unbind(-1))
            (gradient,) = torch.autograd.grad(distance.sum(), points)
        return distance.detach(), gradient

    def sample(self, count: int, generator: RandomNumbers) -> Array:
        """Points (count, 3) inside, uniformly at random, length units; those of a box around the solid that are inside it."""
        import torch

        half = self.half_extents(torch.eye(3, dtype=torch.float64)).numpy()
        found = np.empty((0, 3))
        while len(found) < count:
            points = generator.uniform(-1.0, 1.0, (4 * count, 3)) * half
            inside = self.distance(*torch.as_tensor(points).unbind(-1)) <= 0.0
            found = np.concatenate([found, points[inside.numpy()]])
        return found[:count]
