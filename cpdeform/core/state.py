"""The state of a batch of worlds, as plain tensors that any backend can take."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.sampling import sample_particles
from cpdeform.core.scene import Scene

STRAIN_COMPONENTS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Matrix entries that the six numbers of `State.elastic_strain` stand for."""


@dataclasses.dataclass(frozen=True)
class State:
    """Particles and tools of B worlds.

    Attributes:
        position: Particle positions (B, N, 3), length units.
        velocity: Particle velocities (B, N, 3), length/second.
        affine: Affine velocity field C of APIC (B, N, 3, 3), 1/second.
        elastic_strain: Elastic left Cauchy-Green deformation minus identity, b - I with b = F F^T, as its six entries
            xx, yy, zz, xy, xz, yz (B, N, 6), dimensionless. The material model is isotropic, so F enters through b only.
        tool_pose: Position (length units), unit quaternion wxyz, gap (length units) of each tool (B, M, 8).
    """

    position: Tensor
    velocity: Tensor
    affine: Tensor
    elastic_strain: Tensor
    tool_pose: Tensor

    def __post_init__(self) -> None:
        worlds, particles = self.position.shape[:2] if self.position.ndim == 3 else (0, 0)
        tools = self.tool_pose.shape[1] if self.tool_pose.ndim == 3 else 0
        expected = {
            "position": (worlds, particles, 3),
            "velocity": (worlds, particles, 3),
            "affine": (worlds, particles, 3, 3),
            "elastic_strain": (worlds, particles, 6),
            "tool_pose": (worlds, tools, 8),
        }
        for name, shape in expected.items():
            came = tuple(getattr(self, name).shape)
            if came != shape or not worlds:
                raise InputError(
                    f"State.{name}", came=f"shape {came}", expected=f"shape {shape}", remedy="The first axis is the world (batch)."
                )

    @property
    def batch_size(self) -> int:
        """Number of worlds B."""
        return int(self.position.shape[0])

    @property
    def particle_count(self) -> int:
        """Number of particles N of a world."""
        return int(self.position.shape[1])

    def tensors(self) -> dict[str, Tensor]:
        """The tensors by their names, which `torch.save` writes and `torch.load` reads in its safe mode.

        ``torch.save(state.tensors(), path)``, and ``State(**torch.load(path))`` is the state again.
        """
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    def map(self, function: Callable[[Tensor], Tensor]) -> State:
        """Apply `function` to every tensor."""
        return State(**{field.name: function(getattr(self, field.name)) for field in dataclasses.fields(self)})

    def to(self, *, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> State:
        """Move to a device and/or convert to a floating-point type."""
        return self.map(lambda tensor: tensor.to(device=device, dtype=dtype))

    def clone(self) -> State:
        """Copy every tensor, outside of any autograd graph."""
        return self.map(lambda tensor: tensor.detach().clone())

    def fork(self, batch_size: int) -> State:
        """Copy a single world into `batch_size` worlds."""
        if self.batch_size != 1:
            came = f"a state of {self.batch_size} worlds"
            raise InputError("State.fork", came=came, expected="a single world", remedy="Use select(world) first.")
        return self.map(lambda tensor: tensor.expand(batch_size, *tensor.shape[1:]).contiguous())

    def select(self, world: int) -> State:
        """Return one world as a batch of one."""
        return self.map(lambda tensor: tensor[world : world + 1])

    def with_tools(self, pose: Tensor) -> State:
        """Return this state with other tool poses (B, M, 8)."""
        return dataclasses.replace(self, tool_pose=pose.to(self.position))


def tool_pose(scene: Scene) -> Tensor:
    """Start poses (M, 8) of the scene's tools, float64: position, unit quaternion wxyz, gap."""
    rows = []
    for tool in scene.tools:
        norm = sum(component**2 for component in tool.rotation_wxyz) ** 0.5
        rotation = [component / norm for component in tool.rotation_wxyz]
        rows.append([*tool.position, *rotation, tool.start_gap])
    return torch.tensor(rows, dtype=torch.float64).reshape(len(rows), 8)


def initial_state(
    scene: Scene, *, batch_size: int = 1, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32
) -> State:
    """The scene's start: particles at rest and undeformed, tools at their start poses.

    Args:
        scene: The scene to sample.
        batch_size: Number of identical worlds B.
        device: Where the tensors live.
        dtype: Floating-point type.

    Returns:
        A state of B worlds.
    """
    position = torch.as_tensor(sample_particles(scene), dtype=torch.float64).unsqueeze(0)
    count = position.shape[1]
    state = State(
        position=position,
        velocity=torch.zeros(1, count, 3, dtype=torch.float64),
        affine=torch.zeros(1, count, 3, 3, dtype=torch.float64),
        elastic_strain=torch.zeros(1, count, 6, dtype=torch.float64),
        tool_pose=tool_pose(scene).unsqueeze(0),
    )
    return state.to(device=device, dtype=dtype).fork(batch_size)


def elastic_strain_from_gradient(deformation_gradient: Tensor) -> Tensor:
    """Elastic strain (..., 6) = entries of F F^T - I of deformation gradients F (..., 3, 3), dimensionless."""
    identity = torch.eye(3, dtype=deformation_gradient.dtype, device=deformation_gradient.device)
    displacement = deformation_gradient - identity
    strain = displacement + displacement.mT + displacement @ displacement.mT
    return torch.stack([strain[..., row, column] for row, column in STRAIN_COMPONENTS], dim=-1)
