"""What backends with hand-written adjoints share: options, checks, and the sizes of what they keep for the way back."""

from __future__ import annotations

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.final_gradient import add_final_gradient, check_final_gradient
from cpdeform.core.machine import available_cores
from cpdeform.core.options import MOST_THREADS, whole_number
from cpdeform.core.scene import Scene
from cpdeform.core.simulator import Simulator, Trajectory
from cpdeform.core.state import State


class SimulatorCheckpointing(Simulator):
    """A simulator that keeps every substep of a rollout in memory, or one checkpoint per environment step.

    Args:
        scene: What to simulate.
        batch_size: The most worlds that one call may hold.
        device: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``.
        dtype: Floating-point type; defaults to the backend's first declared one.
        threads: Threads on the CPU; defaults to those the process may use.
        memory_budget: Bytes that a rollout may keep for its way back. Where all substeps fit, none is computed twice; otherwise
            one checkpoint per environment step is kept and the inside recomputed.

    Raises:
        CapabilityError: The device, type or a tool is not supported.
        InputError: An option is out of range.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        batch_size: int,
        device: torch.device | str,
        dtype: torch.dtype | None,
        threads: int | None,
        memory_budget: int,
    ) -> None:
        super().__init__(scene, batch_size=batch_size, device=device, dtype=dtype)
        self.threads = available_cores() if threads is None else whole_number("threads", threads, least=1, most=MOST_THREADS)
        self.memory_budget = whole_number("memory_budget", memory_budget, least=0, most=2**60)

    def for_scene(self, scene: Scene) -> Simulator:
        """See `Simulator`; threads and memory budget stay, too."""
        options = {"threads": self.threads, "memory_budget": self.memory_budget}
        return type(self)(scene, batch_size=self.batch_size, device=self.device, dtype=self.dtype, **options)

    def _own(self, tensor: Tensor) -> Tensor:
        """A copy of a tensor on the simulator's device and in its type, which the caller cannot write to."""
        return tensor.detach().to(device=self.device, dtype=self.dtype, copy=True, memory_format=torch.contiguous_format)

    def _incoming(
        self, trajectory: Trajectory, grad_positions: Tensor, grad_tools: Tensor | None, grad_final_state: State | None
    ) -> tuple[Tensor, Tensor | None, State | None]:
        """What `vjp` was given, on the simulator's device and in its type.

        Returns:
            Gradients with respect to positions (B, T+1, N, 3) and poses (B, T+1, M, 8), with what the final state adds to them; and
            that with respect to the final state, of which velocity, affine field and strain are left to be looked at. There an
            off-diagonal strain stands for one of its two matrix entries, as in the kernels.

        Raises:
            InputError: They do not fit the trajectory, or it cannot be gone back.
        """
        self._check_gradient(trajectory, grad_positions)
        if grad_tools is not None and grad_tools.shape != trajectory.tool_poses.shape:
            came, expected = (f"shape {tuple(like.shape)}" for like in (grad_tools, trajectory.tool_poses))
            raise InputError("grad_tools", came=came, expected=expected)
        check_final_gradient(trajectory, grad_final_state)
        positions = grad_positions.detach().to(device=self.device, dtype=self.dtype)
        poses = None if grad_tools is None else grad_tools.detach().to(device=self.device, dtype=self.dtype)
        if grad_final_state is None:
            return positions, poses, None
        final = grad_final_state.map(self._own)
        final.elastic_strain[..., 3:] *= 0.5
        return *add_final_gradient(trajectory, positions, poses, final.position, final.tool_pose), final

    def _check_gradient(self, trajectory: Trajectory, grad_positions: Tensor) -> None:
        """Raise `InputError` unless a trajectory can be gone back and the gradient fits it."""
        if not isinstance(trajectory.checkpoints, tuple):
            raise InputError("trajectory", came="a trajectory without checkpoints", expected="one made by this simulator's rollout")
        if grad_positions.shape != trajectory.positions.shape:
            raise InputError(
                "grad_positions", came=f"shape {tuple(grad_positions.shape)}", expected=f"shape {tuple(trajectory.positions.shape)}"
            )

    def _particle_bytes(self) -> int:
        return (3 + 3 + 9 + 6) * self.dtype.itemsize

    def _grid_bytes(self) -> int:
        """Bytes of a grid row of one world: the full grid on CUDA, on the CPU the box that the bodies touch at the start.

        The box has one node more upwards, where clay goes when it is pressed.
        """
        node, size = 4 * self.dtype.itemsize, self.scene.grid_size
        if self.device.type != "cpu":
            return node * size**3
        lower = [min(body.position[axis] - body.half_extents[axis] for body in self.scene.bodies) for axis in range(3)]
        upper = [max(body.position[axis] + body.half_extents[axis] for body in self.scene.bodies) for axis in range(3)]
        edges = [int(high * size - 0.5) - int(low * size - 0.5) + 3 for low, high in zip(lower, upper, strict=True)]
        return node * edges[0] * (edges[1] + 1) * edges[2]
