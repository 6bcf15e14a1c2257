"""What is simulated: bodies, material, tools and the discretisation, as validated frozen models.

Lengths are in units of the domain edge (the domain is the cube [0, 1]^3, y up), times in seconds, density is 1. The
constants are those of PlasticineLab [1]_, odd ones included, so that results compare.

References:
    .. [1] Huang et al., "PlasticineLab: A Soft-Body Manipulation Benchmark with Differentiable Physics", ICLR 2021.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from cpdeform.core.bounded import (
    MOST_PARTICLES,
    MOST_PARTS,
    MOST_STEPS,
    Real,
    Seed,
    Whole,
)
from cpdeform.core.errors import InputError
from cpdeform.core.material import Material
from cpdeform.core.model import FrozenModel, NonNegativeFloat, PositiveFloat, Quaternion, Vector3
from cpdeform.core.old_names import current_scene
from cpdeform.core.shapes.body import BodyBase
from cpdeform.core.shapes.box import BodyBox, ToolBox
from cpdeform.core.shapes.chopsticks import ToolChopsticks
from cpdeform.core.shapes.cylinder import ToolCylinder
from cpdeform.core.shapes.kinds import Body, Tool
from cpdeform.core.shapes.mesh import BodyMesh, ToolMesh
from cpdeform.core.shapes.rod import ToolCapsule, ToolRod, ToolRollingPin
from cpdeform.core.shapes.sphere import BodySphere, ToolSphere
from cpdeform.core.shapes.tool import ToolBase
from cpdeform.core.shapes.torus import ToolTorus

__all__ = [
    "WALL_NODES",
    "Body",
    "BodyBase",
    "BodyBox",
    "BodyMesh",
    "BodySphere",
    "FrozenModel",
    "Material",
    "NonNegativeFloat",
    "PositiveFloat",
    "Quaternion",
    "Scene",
    "Tool",
    "ToolBase",
    "ToolBox",
    "ToolCapsule",
    "ToolChopsticks",
    "ToolCylinder",
    "ToolMesh",
    "ToolRod",
    "ToolRollingPin",
    "ToolSphere",
    "ToolTorus",
    "Vector3",
]

WALL_NODES = 3
"""Width of the boundary layer at each face of the domain, in grid nodes."""


class Scene(FrozenModel):
    """Everything a simulator needs to know.

    Attributes:
        bodies: The clay, one entry a body, in the order of the particles.
        tools: The tools, in the order of the actions and of the pose tensor's second axis.
        material: Material of bodies that name none.
        gravity_parameter: Gravity as the scene tables give it, dimensionless; the acceleration is `gravity_scale` times it.
        gravity_scale: Acceleration per unit of gravity parameter, length/second^2 (PlasticineLab's quirk: 30).
        ground_friction: 0 slips, below 10 Coulomb, 10 and above sticks; dimensionless.
        ground_height: Height of the floor, length units.
        grid_size: Grid nodes along each axis; the node distance dx is 1/grid_size.
        time_step: Seconds per substep.
        substeps: Substeps per environment step.
        softness: Decay rate of a tool's influence outside its surface, 1/length; 0 gives a hard boundary.
        sampling: ``"uniform"``, or ``"plasticinelab"`` for the very particles of PlasticineLab (with a seed of 0). Its published
            target grids are made of them: each holds the random density of that sample, without which the soft IoU with such
            a grid stays far below 1 even for the right shape.
        sampling_seed: Seed of the particle positions inside the bodies.
    """

    bodies: tuple[Body, ...] = Field(min_length=1, max_length=MOST_PARTS)
    tools: tuple[Tool, ...] = Field(default=(), max_length=MOST_PARTS)
    material: Material = Material()
    gravity_parameter: Vector3 = (0.0, -1.0, 0.0)
    gravity_scale: Real = Field(default=30.0, ge=0.0, le=1e6)
    ground_friction: NonNegativeFloat = 1.5
    ground_height: Real = Field(default=0.0, ge=0.0, le=1.0)
    grid_size: Whole = Field(default=64, ge=8, le=512)
    time_step: Real = Field(default=1e-4, ge=1e-12, le=1.0)
    substeps: Whole = Field(default=19, ge=1, le=MOST_STEPS)
    softness: Real = Field(default=666.0, ge=0.0, le=1e9)
    sampling: Literal["uniform", "plasticinelab"] = "uniform"
    sampling_seed: Seed = Field(default=0, le=2**32 - 1)

    @model_validator(mode="before")
    @classmethod
    def _take_old_names(cls, content: Any) -> Any:
        return current_scene(content)

    @model_validator(mode="after")
    def _check_particle_count(self) -> Scene:
        if self.particle_count > MOST_PARTICLES:
            came = f"{self.particle_count} particles of all bodies"
            raise InputError("bodies", came=came, expected=f"at most {MOST_PARTICLES}")
        return self

    @model_validator(mode="after")
    def _check_bodies_inside(self) -> Scene:
        lower, upper = self.domain
        for index, body in enumerate(self.bodies):
            for axis, name in enumerate("xyz"):
                low = body.position[axis] - body.half_extents[axis]
                high = body.position[axis] + body.half_extents[axis]
                if low < lower[axis] - 1e-6 or high > upper[axis] + 1e-6:
                    raise InputError(
                        f"bodies.{index}",
                        came=f"a body from {low:.4g} to {high:.4g} along {name}",
                        expected=f"one inside the domain, from {lower[axis]:.4g} to {upper[axis]:.4g}",
                        remedy="Move or shrink it.",
                    )
        return self

    @property
    def node_distance(self) -> float:
        """Distance dx between grid nodes, length units."""
        return 1.0 / self.grid_size

    @property
    def particle_volume(self) -> float:
        """Volume of a particle, (dx/2)^2 (PlasticineLab's quirk: a 2-D formula). Density is 1, so this is its mass, too."""
        return (0.5 * self.node_distance) ** 2

    @property
    def domain(self) -> tuple[Vector3, Vector3]:
        """Corners that particle positions are clipped to, length units."""
        upper = 1.0 - WALL_NODES * self.node_distance
        return (0.0, self.ground_height, 0.0), (upper, upper, upper)

    @property
    def resting_height(self) -> float:
        """Height that clay comes to rest at, length units: the top of the floor's boundary layer, whose nodes let nothing sink."""
        return (WALL_NODES + int(self.ground_height / self.node_distance)) * self.node_distance

    @property
    def gravity(self) -> Vector3:
        """Acceleration, length/second^2."""
        x, y, z = self.gravity_parameter
        return (self.gravity_scale * x, self.gravity_scale * y, self.gravity_scale * z)

    @property
    def particle_count(self) -> int:
        """Number of particles of all bodies together."""
        return sum(body.particle_count for body in self.bodies)

    @property
    def action_size(self) -> int:
        """Number of action components of all tools together."""
        return sum(tool.action_size for tool in self.tools)

    def material_of(self, body: int) -> Material:
        """Material of the body with the given index."""
        return self.bodies[body].material or self.material
