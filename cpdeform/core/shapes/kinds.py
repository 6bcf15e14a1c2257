"""The list of all kinds of tools and bodies."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Any, get_args

from pydantic import Field

from cpdeform.core.shapes.body import BodyBase
from cpdeform.core.shapes.box import BodyBox, ToolBox
from cpdeform.core.shapes.chopsticks import ToolChopsticks
from cpdeform.core.shapes.cylinder import ToolCylinder
from cpdeform.core.shapes.mesh import BodyMesh, ToolMesh
from cpdeform.core.shapes.rod import ToolCapsule, ToolRollingPin
from cpdeform.core.shapes.sphere import BodySphere, ToolSphere
from cpdeform.core.shapes.tool import ToolBase
from cpdeform.core.shapes.torus import ToolTorus

Body = Annotated[BodyBox | BodySphere | BodyMesh, Field(discriminator="kind")]

Tool = Annotated[
    ToolSphere | ToolCapsule | ToolBox | ToolCylinder | ToolTorus | ToolRollingPin | ToolChopsticks | ToolMesh,
    Field(discriminator="kind"),
]
"""Kernels know a kind by its place in this list, those in C++ too: new kinds go to the end."""


def _by_kind(union: Any) -> dict[str, Any]:
    """The models of a union by the values of their field `kind`, in its order."""
    return {model.model_fields["kind"].default: model for model in get_args(get_args(union)[0])}


BODIES: Mapping[str, type[BodyBase]] = MappingProxyType(_by_kind(Body))
TOOLS: Mapping[str, type[ToolBase]] = MappingProxyType(_by_kind(Tool))
