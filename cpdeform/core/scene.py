"""What is simulated: bodies, material, manipulators and the discretisation, as validated frozen models.

Lengths are in units of the domain edge (the domain is the cube [0, 1]^3, y up), times in seconds, density is 1. The
constants are those of PlasticineLab [1]_, odd ones included, so that results compare.

References:
    .. [1] Huang et al., "PlasticineLab: A Soft-Body Manipulation Benchmark with Differentiable Physics", ICLR 2021.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from cpdeform.core.bounded import (
    MOST_PARTICLES,
    MOST_PARTS,
    MOST_STEPS,
    Coordinate,
    Length,
    Lengths3,
    NonNegativeFloat,
    PositiveFloat,
    Real,
    Seed,
    Whole,
)
from cpdeform.core.errors import InputError

Vector3 = tuple[Coordinate, Coordinate, Coordinate]
Quaternion = tuple[Real, Real, Real, Real]

WALL_NODES = 3
"""Width of the boundary layer at each face of the domain, in grid nodes."""


class FrozenModel(BaseModel):
    """Base of all data models: immutable, no unknown fields, no infinities."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Material(FrozenModel):
    """Fixed-corotated elasticity with von Mises plasticity.

    Attributes:
        youngs_modulus: Young's modulus E, stress units (density 1, lengths in domain edges, seconds).
        poisson_ratio: Poisson's ratio nu, dimensionless, in (-1, 0.5).
        yield_stress: Von Mises yield stress, stress units.
    """

    youngs_modulus: PositiveFloat = 5000.0
    poisson_ratio: Real = Field(default=0.2, gt=-1.0, lt=0.5)
    yield_stress: PositiveFloat = 50.0

    @property
    def shear_modulus(self) -> float:
        """First Lame parameter mu = E / (2 (1 + nu)), stress units."""
        return self.youngs_modulus / (2.0 * (1.0 + self.poisson_ratio))

    @property
    def lame_lambda(self) -> float:
        """Second Lame parameter lambda = E nu / ((1 + nu)(1 - 2 nu)), stress units."""
        return self.youngs_modulus * self.poisson_ratio / ((1.0 + self.poisson_ratio) * (1.0 - 2.0 * self.poisson_ratio))


class BodyBox(FrozenModel):
    """An axis-aligned block of clay.

    Attributes:
        position: Centre, length units.
        widths: Full edge lengths along x, y, z, length units.
        particle_count: Number of particles sampled uniformly in the block.
        material: Material of this body; the scene's material where absent.
    """

    kind: Literal["box"] = "box"
    position: Vector3
    widths: Lengths3
    particle_count: Whole = Field(default=10000, gt=0, le=MOST_PARTICLES)
    material: Material | None = None

    @property
    def half_extents(self) -> Vector3:
        """Half of the bounding box's edges, length units."""
        return (0.5 * self.widths[0], 0.5 * self.widths[1], 0.5 * self.widths[2])


class BodySphere(FrozenModel):
    """A ball of clay.

    Attributes:
        position: Centre, length units.
        radius: Radius, length units.
        particle_count: Number of particles sampled uniformly in the ball.
        material: Material of this body; the scene's material where absent.
    """

    kind: Literal["sphere"] = "sphere"
    position: Vector3
    radius: Length
    particle_count: Whole = Field(default=10000, gt=0, le=MOST_PARTICLES)
    material: Material | None = None

    @property
    def half_extents(self) -> Vector3:
        """Half of the bounding box's edges, length units."""
        return (self.radius, self.radius, self.radius)


Body = Annotated[BodyBox | BodySphere, Field(discriminator="kind")]


class ManipulatorBase(FrozenModel):
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
    def _check(self) -> ManipulatorBase:
        if len(self.action_scale) not in self.action_meanings:
            expected = " or ".join(f"{count} ({meaning})" for count, meaning in self.action_meanings.items())
            raise InputError("action_scale", came=f"{len(self.action_scale)} components", expected=expected)
        norm = sum(component * component for component in self.rotation_wxyz) ** 0.5
        if not 0.99 < norm < 1.01:
            raise InputError("rotation_wxyz", came=f"a norm of {norm:.4g}", expected="a unit quaternion (w, x, y, z)")
        if any(low > high for low, high in zip(self.lower_bound, self.upper_bound, strict=True)):
            raise InputError("lower_bound", came=f"{self.lower_bound}", expected=f"at most upper_bound = {self.upper_bound}")
        return self

    @property
    def action_size(self) -> int:
        """Number of action components this tool takes."""
        return len(self.action_scale)

    @property
    def movable(self) -> bool:
        """Whether any action moves this tool."""
        return any(scale > 0.0 for scale in self.action_scale)


class ManipulatorSphere(ManipulatorBase):
    """A ball. Attributes: radius, length units."""

    kind: Literal["Sphere"] = "Sphere"
    radius: Length


class ManipulatorRod(ManipulatorBase):
    """All points within `radius` of the segment y in [-height/2, height/2] of the local frame, length units."""

    radius: Length
    height: Length


class ManipulatorCapsule(ManipulatorRod):
    """A rod that is moved like any tool."""

    kind: Literal["Capsule"] = "Capsule"


class ManipulatorRollingPin(ManipulatorRod):
    """A rod that rolls.

    Its three actions turn it about its own axis (radians), rolling it sideways by 0.03 length units a radian, turn it about the
    vertical (radians), and lift it (length units).
    """

    kind: Literal["RollingPin"] = "RollingPin"
    action_meanings: ClassVar[Mapping[int, str]] = MappingProxyType({0: "fixed", 3: "roll, turn, lift"})


class ManipulatorChopsticks(ManipulatorBase):
    """Two parallel rods of `radius` and `height` at x = +-gap/2 of the local frame, whose origin is at their upper ends.

    Attributes:
        radius: Radius of a rod, length units.
        height: Length of a rod's segment, length units.
        gap: Start distance between the rods' axes, length units; actions never close it below 0.06.
    """

    kind: Literal["Chopsticks"] = "Chopsticks"
    radius: Length
    height: Length
    gap: Length = 0.06
    action_meanings: ClassVar[Mapping[int, str]] = MappingProxyType(
        {0: "fixed", 7: "translation, rotation in the tool's own frame, closing of the gap"}
    )


class ManipulatorBox(ManipulatorBase):
    """A block of `half_extents` (3,), grown by `rounding` on all sides, length units."""

    kind: Literal["Box"] = "Box"
    half_extents: Lengths3
    rounding: Coordinate = Field(default=0.0, ge=0.0)


class ManipulatorCylinder(ManipulatorBase):
    """A solid cylinder about the local y axis: `radius` and `half_height`, length units."""

    kind: Literal["Cylinder"] = "Cylinder"
    radius: Length
    half_height: Length


class ManipulatorTorus(ManipulatorBase):
    """A ring about the local y axis: `major_radius` to the tube's centre and `tube_radius`, length units."""

    kind: Literal["Torus"] = "Torus"
    major_radius: Length
    tube_radius: Length


Manipulator = Annotated[
    ManipulatorSphere
    | ManipulatorCapsule
    | ManipulatorBox
    | ManipulatorCylinder
    | ManipulatorTorus
    | ManipulatorRollingPin
    | ManipulatorChopsticks,
    Field(discriminator="kind"),
]


class Scene(FrozenModel):
    """Everything a simulator needs to know.

    Attributes:
        bodies: The clay, one entry a body, in the order of the particles.
        manipulators: The tools, in the order of the actions and of the pose tensor's second axis.
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
    manipulators: tuple[Manipulator, ...] = Field(default=(), max_length=MOST_PARTS)
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
        """Number of action components of all manipulators together."""
        return sum(manipulator.action_size for manipulator in self.manipulators)

    def material_of(self, body: int) -> Material:
        """Material of the body with the given index."""
        return self.bodies[body].material or self.material
