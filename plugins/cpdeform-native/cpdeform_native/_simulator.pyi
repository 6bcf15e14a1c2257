from collections.abc import Sequence
from typing import Any

from numpy.typing import NDArray

MAX_TOOLS: int

def instruction_sets() -> list[str]: ...

class Scene:
    def __init__(
        self,
        *,
        time_step: float,
        node_distance: float,
        particle_mass: float,
        gravity: Sequence[float],
        softness: float,
        ground_friction: float,
        ground_nodes: int,
        wall_nodes: int,
        lower: Sequence[float],
        upper: Sequence[float],
        grid_size: int,
        substeps: int,
        particle_count: int,
    ) -> None: ...
    def add_tool(
        self,
        *,
        kind: int,
        size: Sequence[float],
        friction: float,
        action_size: int,
        scale: Sequence[float],
        lower: Sequence[float],
        upper: Sequence[float],
        grid: NDArray[Any] | None = None,
    ) -> None: ...

class CheckpointsFloat:
    @property
    def worlds(self) -> int: ...
    @property
    def steps(self) -> int: ...
    @property
    def nbytes(self) -> int: ...

class CheckpointsDouble(CheckpointsFloat): ...

class SimulatorFloat:
    def __init__(self, scene: Scene, material: NDArray[Any], threads: int, instruction_set: str) -> None: ...
    @property
    def instruction_set(self) -> str: ...
    def release_memory(self) -> None: ...
    def made(self, checkpoints: object) -> bool: ...
    # position, velocity, affine, strain, pose, actions; out: positions, poses, last_velocity, last_affine, last_strain
    def rollout(self, worlds: int, steps: int, *arrays: NDArray[Any], keep: bool) -> CheckpointsFloat: ...
    def vjp(
        self,
        checkpoints: CheckpointsFloat,
        actions: NDArray[Any],
        grad_positions: NDArray[Any],
        grad_poses: NDArray[Any] | None,
        grad_last_velocity: NDArray[Any] | None,
        grad_last_affine: NDArray[Any] | None,
        grad_last_strain: NDArray[Any] | None,
        grad_actions: NDArray[Any],
        grad_position: NDArray[Any],
        grad_velocity: NDArray[Any],
        grad_affine: NDArray[Any],
        grad_strain: NDArray[Any],
        grad_pose: NDArray[Any],
    ) -> None: ...

class SimulatorDouble(SimulatorFloat): ...
