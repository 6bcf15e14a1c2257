"""The simulator interface: a batched rollout and its vector-Jacobian product.

Backends never touch autograd; `differentiable_rollout` wraps the pair once, for all of them.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import Any, ClassVar

import torch
from torch import Tensor

from cpdeform.core.errors import CapabilityError, InputError, brief
from cpdeform.core.options import whole_number
from cpdeform.core.scene import Scene
from cpdeform.core.state import State, initial_state

MOST_WORLDS = 1_000_000
"""Worlds of a batch at most."""


@dataclasses.dataclass(frozen=True)
class SimulatorCapabilities:
    """What a backend declares that it can do; checked before a run starts.

    Attributes:
        differentiable: Whether `Simulator.vjp` is implemented.
        devices: Device types that work, of ``"cpu"`` and ``"cuda"``.
        dtypes: Floating-point types that work; the first is the default.
        manipulator_kinds: Values of `Manipulator.kind` that work.
        deterministic_devices: Device types on which a repeated rollout is equal bit for bit.
    """

    differentiable: bool
    devices: tuple[str, ...]
    dtypes: tuple[torch.dtype, ...]
    manipulator_kinds: tuple[str, ...]
    deterministic_devices: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """What happened during T environment steps in B worlds.

    Attributes:
        positions: Particle positions (B, T+1, N, 3) at the start and after each step, length units.
        manipulator_poses: Tool poses (B, T+1, M, 8) at the same times; see `State.manipulator_pose`.
        actions: The actions (B, T, A) that were executed, in [-1, 1].
        initial_state: State of B worlds before the first step.
        final_state: State of B worlds after the last step.
        checkpoints: What the backend's `vjp` needs to go back; opaque, owned by the simulator that made it.
    """

    positions: Tensor
    manipulator_poses: Tensor
    actions: Tensor
    initial_state: State
    final_state: State
    checkpoints: Any = None

    @property
    def step_count(self) -> int:
        """Number of environment steps T."""
        return int(self.actions.shape[1])


@dataclasses.dataclass(frozen=True)
class RolloutGradient:
    """Gradient of a scalar with respect to the inputs of a rollout.

    Attributes:
        actions: Gradient (B, T, A) with respect to the actions.
        initial_state: Gradient with respect to every tensor of the initial state, in the same shapes. The entries for the
            off-diagonal `elastic_strain` numbers are derivatives by that number (both matrix entries at once).
    """

    actions: Tensor
    initial_state: State


class Simulator(abc.ABC):
    """A batch of worlds of elastoplastic clay and rigid tools.

    Args:
        scene: What to simulate.
        batch_size: The most worlds that one call may hold.
        device: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``.
        dtype: Floating-point type; the backend's first declared one where absent.

    Raises:
        CapabilityError: The backend does not support the device, the type or a manipulator of the scene.
        InputError: `batch_size` is below 1 or no number, `device` is no device, or CUDA is asked for where there is none.
    """

    capabilities: ClassVar[SimulatorCapabilities]

    def __init__(
        self, scene: Scene, *, batch_size: int = 1, device: torch.device | str = "cpu", dtype: torch.dtype | None = None
    ) -> None:
        self.scene = scene
        self.batch_size = whole_number("batch_size", batch_size, least=1, most=MOST_WORLDS)
        self.device = _device(device)
        self.dtype = dtype or self.capabilities.dtypes[0]
        self._check_capabilities()

    def _check_capabilities(self) -> None:
        name, can = type(self).__name__, self.capabilities
        if self.device.type not in can.devices:
            devices = ", ".join(can.devices)
            raise CapabilityError(f"{name} runs on {devices}, not on {self.device.type}; choose one of these devices.")
        if self.device.type == "cuda" and not torch.cuda.is_available():
            raise InputError("device", came=str(self.device), expected="a CUDA device", remedy='None was found; use device "cpu".')
        if self.dtype not in can.dtypes:
            raise CapabilityError(f"{name} computes in {', '.join(map(str, can.dtypes))}, not in {self.dtype}.")
        for index, manipulator in enumerate(self.scene.manipulators):
            if manipulator.kind not in can.manipulator_kinds:
                raise CapabilityError(
                    f"{name} has no manipulator of kind {manipulator.kind} (manipulators.{index}); "
                    f"it has {', '.join(can.manipulator_kinds)}. Choose another backend or tool."
                )

    def initial_state(self, *, batch_size: int | None = None) -> State:
        """The scene's start in `batch_size` worlds (this simulator's batch size where absent), on its device."""
        return initial_state(self.scene, batch_size=batch_size or self.batch_size, device=self.device, dtype=self.dtype)

    def check_inputs(self, state: State, actions: Tensor) -> None:
        """Raise `InputError` unless state and actions fit this simulator; for backends to call first in `rollout`."""
        expected = (state.batch_size, "T", self.scene.action_size)
        if actions.ndim != 3 or actions.shape[0] != state.batch_size or actions.shape[2] != self.scene.action_size:
            raise InputError("actions", came=f"shape {tuple(actions.shape)}", expected=f"shape {expected}")
        if actions.shape[1] < 1:
            raise InputError("actions", came="0 environment steps", expected="at least one step")
        if state.batch_size > self.batch_size:
            raise InputError(
                "state",
                came=f"{state.batch_size} worlds",
                expected=f"at most batch_size = {self.batch_size}",
                remedy="Build the simulator with a larger batch_size.",
            )
        if state.particle_count != self.scene.particle_count:
            raise InputError("state", came=f"{state.particle_count} particles", expected=f"{self.scene.particle_count} particles")
        if state.manipulator_pose.shape[1] != len(self.scene.manipulators):
            count = state.manipulator_pose.shape[1]
            raise InputError("state", came=f"{count} manipulators", expected=f"{len(self.scene.manipulators)} manipulators")

    @abc.abstractmethod
    def rollout(self, state: State, actions: Tensor) -> Trajectory:
        """Simulate T environment steps.

        Args:
            state: Start of B worlds; not modified.
            actions: Actions (B, T, A) in [-1, 1], the manipulators' components one after the other.

        Returns:
            The trajectory, with the checkpoints that `vjp` needs.

        Raises:
            InputError: Shapes do not fit the scene.
        """

    @abc.abstractmethod
    def vjp(self, trajectory: Trajectory, grad_positions: Tensor, grad_manipulators: Tensor | None = None) -> RolloutGradient:
        """Pull gradients back through a rollout.

        Args:
            trajectory: Made by this simulator's `rollout`.
            grad_positions: Gradient (B, T+1, N, 3) of a scalar with respect to `trajectory.positions`.
            grad_manipulators: Gradient (B, T+1, M, 8) with respect to `trajectory.manipulator_poses`; zero where absent.

        Returns:
            The gradient with respect to the actions and the initial state.

        Raises:
            CapabilityError: The backend is not differentiable.
        """

    @abc.abstractmethod
    def memory_estimate(self, step_count: int, *, worlds: int | None = None) -> int:
        """Bytes that a rollout and its `vjp` hold at their peak, above what was there before the rollout.

        It covers all that the two calls make: trajectory with checkpoints, gradients, work space; and the caller's gradient of
        the positions (B, T+1, N, 3). It does not cover the state and the actions given, the simulator's own constants and
        compiled kernels, or an objective. `cpdeform bench simulators` measures the same and shows both.

        Args:
            step_count: Environment steps T.
            worlds: Number of worlds B; this simulator's `batch_size` where absent.

        Returns:
            Bytes; within a fifth of what is measured while the bodies stay about as large as they are at the start.
        """

    def release_memory(self) -> None:  # noqa: B027 - most backends keep nothing
        """Give back to the system what is kept between rollouts to be used again; trajectories stay usable."""


def _device(device: torch.device | str) -> torch.device:
    """The device of a name."""
    try:
        return torch.device(device)
    except (RuntimeError, TypeError) as error:
        raise InputError("device", came=brief(repr(device), 60), expected='"cpu", "cuda" or "cuda:N"') from error


class _RolloutFunction(torch.autograd.Function):
    """Bridge from a simulator's rollout and vjp to autograd."""

    @staticmethod
    def forward(ctx: Any, simulator: Simulator, made: list[Trajectory], actions: Tensor, *state: Tensor) -> tuple[Tensor, Tensor]:
        """Run the rollout; append its trajectory to `made`, since autograd returns nothing but tensors."""
        trajectory = simulator.rollout(State(*(tensor.detach() for tensor in state)), actions.detach())
        made.append(trajectory)
        ctx.simulator, ctx.trajectory = simulator, trajectory
        return trajectory.positions, trajectory.manipulator_poses

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        """Pull the gradients back through the simulator."""
        gradient = ctx.simulator.vjp(ctx.trajectory, grads[0], grads[1])
        start = gradient.initial_state
        state = (start.position, start.velocity, start.affine, start.elastic_strain, start.manipulator_pose)
        return (None, None, gradient.actions, *state)


def differentiable_rollout(simulator: Simulator, state: State, actions: Tensor) -> Trajectory:
    """Run a rollout whose positions and manipulator poses carry gradients to the actions and the initial state.

    Args:
        simulator: Any differentiable backend.
        state: Start of B worlds.
        actions: Actions (B, T, A) in [-1, 1].

    Returns:
        A trajectory whose `positions` (B, T+1, N, 3) and `manipulator_poses` (B, T+1, M, 8) are part of the autograd graph.
        Its `final_state` holds velocities and strains without gradient.

    Raises:
        CapabilityError: The simulator is not differentiable.
    """
    if not simulator.capabilities.differentiable:
        raise CapabilityError(f"{type(simulator).__name__} is not differentiable; choose a backend that is.")
    tensors = (state.position, state.velocity, state.affine, state.elastic_strain, state.manipulator_pose)
    made: list[Trajectory] = []
    positions, poses = _RolloutFunction.apply(simulator, made, actions, *tensors)  # type: ignore[no-untyped-call]
    return dataclasses.replace(made[0], positions=positions, manipulator_poses=poses)
