"""Small scenes and states on which simulators are checked."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.scene import Scene
from cpdeform.core.simulator import Simulator, SimulatorCapabilities
from cpdeform.core.state import State
from cpdeform.testing.report import Skip

SimulatorFactory = Callable[..., Simulator]
"""Called as ``factory(scene, batch_size=..., device=..., dtype=...)``: a `Simulator` class, or a partial of one."""

TILTED = (0.8, 0.36, 0.36, math.sqrt(1.0 - 0.64 - 2 * 0.36**2))
ALL_MOTIONS = (0.02, 0.02, 0.02, 0.3, 0.3, 0.3)
EXAMPLES: dict[str, dict[str, Any]] = {
    "Sphere": {"radius": 0.03, "position": (0.5, 0.135, 0.5), "action_scale": (0.02, 0.02, 0.02)},
    "Capsule": {"radius": 0.03, "height": 0.06, "position": (0.47, 0.15, 0.5)},
    "Box": {"half_extents": (0.03, 0.02, 0.04), "rounding": 0.01, "position": (0.5, 0.13, 0.47)},
    "Cylinder": {"radius": 0.03, "half_height": 0.03, "position": (0.52, 0.13, 0.52)},
    "Torus": {"major_radius": 0.04, "tube_radius": 0.02, "position": (0.503, 0.123, 0.498)},
    "RollingPin": {
        "radius": 0.03,
        "height": 0.06,
        "position": (0.5, 0.137, 0.5),
        "rotation_wxyz": (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0),
        "action_scale": (0.3, 0.07, 0.005),
    },
    "Chopsticks": {
        "radius": 0.02,
        "height": 0.1,
        "gap": 0.08,
        "position": (0.5, 0.2, 0.5),
        "rotation_wxyz": (1.0, 0.0, 0.0, 0.0),
        "action_scale": (0.02, 0.02, 0.02, 0.04, 0.04, 0.04, 0.02),
    },
    # an ellipsoid of the half axes 0.03, 0.02 and 0.04, the inside of an icosphere
    "Mesh": {"file": str(Path(__file__).with_name("ellipsoid.npz")), "position": (0.5, 0.128, 0.49)},
}
"""One tool of each kind, in touch with the block of `resting`."""


def example_tool(kind: str, **changes: Any) -> dict[str, Any]:
    """Description of a tool in touch with the block of `resting`, tilted and with all motions where its kind has them.

    Raises:
        Skip: There is no example of this kind.
    """
    if kind not in EXAMPLES:
        raise Skip(f"There is no example of a tool of kind {kind}; pass a scene that holds one.")
    return {"kind": kind, "action_scale": ALL_MOTIONS, "rotation_wxyz": TILTED, **EXAMPLES[kind], **changes}


def resting(*tools: dict[str, Any], **changes: Any) -> Scene:
    """A block of 300 particles on the floor on a coarse grid, five substeps a step, with tools.

    Raises:
        Skip: This version of the scene does not know a tool.
    """
    body = {"kind": "box", "position": (0.5, 0.06, 0.5), "widths": (0.12, 0.1, 0.12), "particle_count": 300}
    content = {"bodies": [body], "tools": tools, "grid_size": 32, "substeps": 5, **changes}
    try:
        return Scene.model_validate(content)
    except ValidationError as error:
        kinds = ", ".join(tool["kind"] for tool in tools)
        raise Skip(f"The scene model does not accept the example of {kinds}: {error.errors()[0]['msg']}") from error


def floating(**changes: Any) -> Scene:
    """A block in the middle of the domain, away from walls, without gravity and tools."""
    body = {"kind": "box", "position": (0.5, 0.5, 0.5), "widths": (0.2, 0.15, 0.1), "particle_count": 400}
    return resting(**{"bodies": [body], "gravity_parameter": (0.0, 0.0, 0.0), **changes})


@dataclasses.dataclass(frozen=True)
class SimulatorBench:
    """A simulator under test.

    Attributes:
        factory: Makes it.
        capabilities: What it declares.
        device: Where it is tested.
        scene: Scene of the checks that need no particular one.
    """

    factory: SimulatorFactory
    capabilities: SimulatorCapabilities
    device: torch.device
    scene: Scene

    @property
    def double(self) -> bool:
        """Whether it is tested in double precision; it is where double is declared."""
        return torch.float64 in self.capabilities.dtypes

    @property
    def dtype(self) -> torch.dtype:
        """The type it is tested in."""
        return torch.float64 if self.double else self.capabilities.dtypes[0]

    def bound(self, double: float, single: float) -> float:
        """A bound for the type it is tested in."""
        return double if self.double else single

    def make(self, scene: Scene, *, batch_size: int = 1) -> Simulator:
        """Build the simulator for a scene."""
        return self.factory(scene, batch_size=batch_size, device=self.device, dtype=self.dtype)

    def require_gradient(self) -> None:
        """Leave a check that needs gradients.

        Raises:
            Skip: The simulator declares that it is not differentiable.
        """
        if not self.capabilities.differentiable:
            raise Skip("It declares that it is not differentiable.")


def default_scene(kinds: tuple[str, ...]) -> Scene:
    """A block on the floor with one tool of each of the first two declared kinds."""
    tools = []
    for kind in kinds:
        try:
            resting(example_tool(kind))
        except Skip:
            continue
        tools.append(example_tool(kind))
    return resting(*tools[:2])


def noise_like(tensor: Tensor, generator: torch.Generator, size: float = 1.0) -> Tensor:
    """Gaussian noise in the shape of a tensor, the same on every device and in every type."""
    return size * torch.randn(tensor.shape, generator=generator, dtype=torch.float64).to(tensor)


def stirred(simulator: Simulator, *, batch_size: int = 1, seed: int = 0) -> State:
    """A start with random velocities and strains on both sides of the yield surface, other ones in each world."""
    generator = torch.Generator().manual_seed(seed)
    state = simulator.initial_state(batch_size=batch_size)
    return dataclasses.replace(
        state,
        velocity=noise_like(state.velocity, generator, 0.5),
        affine=noise_like(state.affine, generator, 20.0),
        elastic_strain=noise_like(state.elastic_strain, generator, 0.02),
    )


def random_actions(simulator: Simulator, *, batch_size: int = 1, steps: int = 2, seed: int = 1) -> Tensor:
    """Random actions (B, T, A) in [-1, 1], far enough from the bounds for central differences."""
    generator = torch.Generator().manual_seed(seed)
    shape = (batch_size, steps, simulator.scene.action_size)
    like = torch.empty(shape, dtype=simulator.dtype, device=simulator.device)
    return noise_like(like, generator, 0.5).clamp(-0.95, 0.95)


def no_actions(simulator: Simulator, *, batch_size: int = 1, steps: int = 2) -> Tensor:
    """Actions (B, T, A) of tools that do not move."""
    return torch.zeros(batch_size, steps, simulator.scene.action_size, dtype=simulator.dtype, device=simulator.device)


def largest_difference(first: Tensor, second: Tensor) -> float:
    """Largest absolute difference of two tensors; infinite where their shapes differ."""
    if first.shape != second.shape:
        return float("inf")
    return float((first.double() - second.double()).abs().max()) if first.numel() else 0.0


def state_difference(first: State, second: State) -> float:
    """Largest absolute difference of any number of two states, in the state's units."""
    fields = [field.name for field in dataclasses.fields(State)]
    return max(largest_difference(getattr(first, name), getattr(second, name)) for name in fields)


def complain_about_scene(scene: Scene | None) -> None:
    """Raise unless a scene given by the author of a simulator is a `Scene`.

    Raises:
        InputError: It is something else.
    """
    if scene is not None and not isinstance(scene, Scene):
        raise InputError("scene", came=type(scene).__name__, expected="a cpdeform.core.scene.Scene, or None")
