"""The base of the tools' models."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, ClassVar

from pydantic import Field, model_validator

from cpdeform.core.bounded import Real
from cpdeform.core.errors import InputError
from cpdeform.core.model import FrozenModel, NonNegativeFloat, Quaternion, Vector3
from cpdeform.core.shapes.base import Array, Shape

if TYPE_CHECKING:
    from torch import Tensor


class ToolBase(FrozenModel, abc.ABC):
    """A rigid tool, moved by actions or fixed.

    Attributes:
        position: Start position of the local origin, length units.
        rotation_wxyz: Start rotation as a unit quaternion (w, x, y, z), local frame to world frame.
        friction: Coulomb friction coefficient against the clay, dimensionless.
        action_scale: Motion per environment step at action 1: three translations (length units) and optionally three
            rotations (radians, world frame). Empty: the tool does not move. Kinds with motions of their own say so.
        lower_bound: The position is clipped to stay above this corner, length units.
        upper_bound: The position is clipped to stay below this corner, length units.
    """

    position: Vector3
    rotation_wxyz: Quaternion = (1.0, 0.0, 0.0, 0.0)
    friction: NonNegativeFloat = 0.9
    action_scale: tuple[Annotated[Real, Field(ge=0.0, le=1000.0)], ...] = ()
    lower_bound: Vector3 = (0.0, 0.0, 0.0)
    upper_bound: Vector3 = (1.0, 1.0, 1.0)

    action_meanings: ClassVar[Mapping[int, str]] = MappingProxyType({0: "fixed", 3: "translation", 6: "translation, rotation"})
    """What the possible numbers of action components stand for."""

    @model_validator(mode="after")
    def _check(self) -> ToolBase:
        if len(self.action_scale) not in self.action_meanings:
            expected = " or ".join(f"{count} ({meaning})" for count, meaning in self.action_meanings.items())
            raise InputError("action_scale", came=f"{len(self.action_scale)} components", expected=expected)
        norm = sum(component * component for component in self.rotation_wxyz) ** 0.5
        if not 0.99 < norm < 1.01:
            raise InputError("rotation_wxyz", came=f"a norm of {norm:.4g}", expected="a unit quaternion (w, x, y, z)")
        if any(low > high for low, high in zip(self.lower_bound, self.upper_bound, strict=True)):
            raise InputError("lower_bound", came=f"{self.lower_bound}", expected=f"at most upper_bound = {self.upper_bound}")
        return self

    @abc.abstractmethod
    def shape(self, *, gap: Tensor | float | None = None) -> Shape:
        """The solid that the tool is.

        Args:
            gap: Last number of the tool's pose, length units, for kinds whose shape depends on it; defaults to `start_gap`.
        """

    @property
    @abc.abstractmethod
    def kernel_lengths(self) -> tuple[float, ...]:
        """The lengths that simulators' kernels compute the shape from, at most four."""

    @property
    def kernel_grid(self) -> Array | None:
        """Numbers (K,) that simulators' kernels compute the shape from, too; None for shapes of few lengths."""
        return None

    @property
    def start_gap(self) -> float:
        """Last number of the start pose, length units; 0 for kinds without a gap."""
        return 0.0

    @property
    def thinnest_axis(self) -> int | None:
        """Local axis (0: x, 1: y, 2: z) across which a flat tool is thinnest; None for round tools, which press with any side."""
        return None

    @property
    def action_size(self) -> int:
        """Number of action components this tool takes."""
        return len(self.action_scale)

    @property
    def movable(self) -> bool:
        """Whether any action moves this tool."""
        return any(scale > 0.0 for scale in self.action_scale)


def shape_of(tool: ToolBase, *, gap: Tensor | float | None = None) -> Shape:
    """The solid that a tool is; see `ToolBase.shape`.

    Raises:
        InputError: It is no tool.
    """
    if not isinstance(tool, ToolBase):
        raise InputError("tool", came=type(tool).__name__, expected="a tool of cpdeform.core.scene")
    return tool.shape(gap=gap)
