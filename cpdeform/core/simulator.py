"""The simulator interface: a batched rollout and its vector-Jacobian product.

Backends never touch autograd; `differentiable_rollout` wraps the pair once, for all of them.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from cpdeform.core.errors import CapabilityError, InputError, brief
from cpdeform.core.final_gradient import pull_back, state_tensors
from cpdeform.core.forking import prepare_for_forks
from cpdeform.core.options import whole_number
from cpdeform.core.portable import Portable
from cpdeform.core.scene import Scene
from cpdeform.core.simulator_inputs import check_values
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
        tool_kinds: Values of `Tool.kind` that work.
        deterministic_devices: Device types on which a repeated rollout is equal bit for bit.
    """

    differentiable: bool
    devices: tuple[str, ...]
    dtypes: tuple[torch.dtype, ...]
    tool_kinds: tuple[str, ...]
    deterministic_devices: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """What happened during T environment steps in B worlds.

    Attributes:
        positions: Particle positions (B, T+1, N, 3) at the start and after each step, length units.
        tool_poses: Tool poses (B, T+1, M, 8) at the same times; see `State.tool_pose`.
        actions: The actions (B, T, A) that were executed, in [-1, 1].
        initial_state: State of B worlds before the first step; a copy of what was given.
        final_state: State of B worlds after the last step.
        checkpoints: What the backend's `vjp` needs to go back; opaque, owned by the simulator that made it. It shares no memory
            with what the caller gave or got, so that the gradient is that of what was rolled out whatever they write to since.
    """

    positions: Tensor
    tool_poses: Tensor
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


class Simulator(Portable, abc.ABC):
    """A batch of worlds of elastoplastic clay and rigid tools.

    Args:
        scene: What to simulate.
        batch_size: The most worlds that one call may hold.
        device: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``.
        dtype: Floating-point type; defaults to the backend's first declared one.

    Raises:
        CapabilityError: The backend does not support the device, the type or a tool of the scene.
        InputError: `batch_size` is below 1 or no number, `device` is no device, or CUDA is asked for where there is none.
    """

    capabilities: ClassVar[SimulatorCapabilities]

    def __init__(
        self, scene: Scene, *, batch_size: int = 1, device: torch.device | str = "cpu", dtype: torch.dtype | None = None
    ) -> None:
        prepare_for_forks()
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
        for index, tool in enumerate(self.scene.tools):
            if tool.kind not in can.tool_kinds:
                raise CapabilityError(
                    f"{name} has no tool of kind {tool.kind} (tools.{index}); "
                    f"it has {', '.join(can.tool_kinds)}. Choose another backend or tool."
                )

    def initial_state(self, *, batch_size: int | None = None) -> State:
        """The scene's start in `batch_size` worlds (defaults to this simulator's batch size), on its device."""
        return initial_state(self.scene, batch_size=batch_size or self.batch_size, device=self.device, dtype=self.dtype)

    def check_inputs(self, state: State, actions: Tensor) -> None:
        """Raise `InputError` unless state and actions fit this simulator; for backends to call first in `rollout`.

        Shapes must be the scene's, and numbers finite and sensible, see `check_values`: what backends would make of others differs.
        """
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
        if state.tool_pose.shape[1] != len(self.scene.tools):
            count = state.tool_pose.shape[1]
            raise InputError("state", came=f"{count} tools", expected=f"{len(self.scene.tools)} tools")
        check_values(self.scene, state, actions)

    @abc.abstractmethod
    def rollout(self, state: State, actions: Tensor) -> Trajectory:
        """Simulate T environment steps.

        Args:
            state: Start of B worlds; not modified, and free to be changed afterwards.
            actions: Actions (B, T, A) in [-1, 1], the tools' components one after the other.

        Returns:
            The trajectory, with the checkpoints that `vjp` needs.

        Raises:
            InputError: Shapes do not fit the scene, or numbers are not finite or make no sense. A rollout from sensible ones may
                still end in numbers that are not finite.
        """

    def simulate(self, state: State, actions: Tensor) -> Trajectory:
        """Simulate T environment steps without a way back: as `rollout`, but the trajectory keeps no checkpoints.

        Backends that can skip the work of keeping them override this; the numbers are those of `rollout`.

        Args:
            state: As for `rollout`.
            actions: As for `rollout`.

        Raises:
            InputError: As for `rollout`.
        """
        return dataclasses.replace(self.rollout(state, actions), checkpoints=None)

    @abc.abstractmethod
    def vjp(
        self,
        trajectory: Trajectory,
        grad_positions: Tensor,
        grad_tools: Tensor | None = None,
        *,
        grad_final_state: State | None = None,
    ) -> RolloutGradient:
        """Pull gradients back through a rollout.

        Args:
            trajectory: Made by this simulator's `rollout`.
            grad_positions: Gradient (B, T+1, N, 3) of a scalar with respect to `trajectory.positions`.
            grad_tools: Gradient (B, T+1, M, 8) with respect to `trajectory.tool_poses`; defaults to zero.
            grad_final_state: Gradient with respect to every tensor of `trajectory.final_state`, in its shapes; defaults to zero.
                Those of positions and tools add to what the other two say about the last step. The entries for the off-diagonal
                `elastic_strain` numbers are as in `RolloutGradient.initial_state`, which is what the rollout after this one gives.

        Returns:
            The gradient with respect to the actions and the initial state.

        Raises:
            CapabilityError: The backend is not differentiable.
            InputError: The shapes do not fit the trajectory, or another simulator made it.
        """

    @abc.abstractmethod
    def memory_estimate(self, step_count: int, *, worlds: int | None = None) -> int:
        """Bytes that a rollout and its `vjp` hold at their peak, above what was there before the rollout.

        It covers all that the two calls make: trajectory with checkpoints, gradients, work space; and the caller's gradient of
        the positions (B, T+1, N, 3). It does not cover the state and the actions given, the simulator's own constants and
        compiled kernels, or an objective. `cpdeform bench simulators` measures the same and shows both.

        Args:
            step_count: Environment steps T.
            worlds: Number of worlds B; defaults to this simulator's `batch_size`.

        Returns:
            Bytes; within a fifth of what is measured while the bodies stay about as large as they are at the start.
        """

    def for_scene(self, scene: Scene) -> Simulator:
        """A simulator of another scene with the same batch size, device and type.

        Backends with options of their own hand them on.

        Args:
            scene: What to simulate.

        Raises:
            CapabilityError: The backend does not support a tool of the scene.
        """
        return type(self)(scene, batch_size=self.batch_size, device=self.device, dtype=self.dtype)

    def release_memory(self) -> None:
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
    def forward(ctx: Any, simulator: Simulator, made: list[Trajectory], actions: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        """Run the rollout; append its trajectory to `made`, since autograd returns nothing but tensors."""
        trajectory = simulator.rollout(State(*(tensor.detach() for tensor in state)), actions.detach())
        made.append(trajectory)
        # what is returned will refer to `ctx`: were `ctx` to refer back, neither would ever be collected, so it gets other tensors
        ctx.simulator, ctx.trajectory = simulator, _detached(trajectory)
        ctx.set_materialize_grads(False)
        return trajectory.positions, trajectory.tool_poses, *state_tensors(trajectory.final_state)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        """Pull the gradients back through the simulator; those of outputs that nothing depends on are None."""
        gradient = pull_back(ctx.simulator, ctx.trajectory, grads[0], grads[1], grads[2:])
        return (None, None, gradient.actions, *state_tensors(gradient.initial_state))


def _detached(trajectory: Trajectory) -> Trajectory:
    """The same numbers in tensors that know of no autograd graph."""
    return dataclasses.replace(
        trajectory,
        positions=trajectory.positions.detach(),
        tool_poses=trajectory.tool_poses.detach(),
        actions=trajectory.actions.detach(),
        initial_state=trajectory.initial_state.map(Tensor.detach),
        final_state=trajectory.final_state.map(Tensor.detach),
    )


def differentiable_rollout(simulator: Simulator, state: State, actions: Tensor) -> Trajectory:
    """Run a rollout that carries gradients to the actions and the initial state.

    A closed loop is a chain of these, one step each::

        for _ in range(steps):
            trajectory = differentiable_rollout(simulator, state, policy(state).unsqueeze(1))
            state = trajectory.final_state

    Args:
        simulator: Any differentiable backend.
        state: Start of B worlds.
        actions: Actions (B, T, A) in [-1, 1].

    Returns:
        A trajectory whose `positions` (B, T+1, N, 3), `tool_poses` (B, T+1, M, 8) and `final_state`, with all its tensors,
        are part of the autograd graph. It can be differentiated once.

    Raises:
        CapabilityError: The simulator is not differentiable. Or, in `backward`, its `vjp` takes no gradient of the final state, and
            that is needed.
    """
    if not simulator.capabilities.differentiable:
        raise CapabilityError(f"{type(simulator).__name__} is not differentiable; choose a backend that is.")
    made: list[Trajectory] = []
    positions, poses, *final = _RolloutFunction.apply(simulator, made, actions, *state_tensors(state))  # type: ignore[no-untyped-call]
    return dataclasses.replace(made[0], positions=positions, tool_poses=poses, final_state=State(*final))
