"""The simulator `example`: a substep as one differentiable function of tensors, a rollout, and the way back by autograd."""

from __future__ import annotations

import dataclasses
import math
from typing import ClassVar

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.final_gradient import check_final_gradient
from cpdeform.core.scene import Body, Scene
from cpdeform.core.simulator import RolloutGradient, Simulator, SimulatorCapabilities, Trajectory
from cpdeform.core.state import State
from cpdeform_example.grid import update_grid
from cpdeform_example.material import Material
from cpdeform_example.motion import move_tools
from cpdeform_example.shapes import TOOL_KINDS
from cpdeform_example.transfer import grid_to_particles, make_stencil, particles_to_grid

NUMBERS_PER_PARTICLE, NUMBERS_PER_NODE, NUMBERS_PER_CONTACT = 900, 20, 80
"""What autograd keeps of one substep for each particle, each node, and each pair of a node and a tool: measured, rounded up."""


class SimulatorExample(Simulator):
    """MLS-MPM with von Mises plasticity in plain PyTorch.

    Args:
        scene: What to simulate.
        batch_size: The most worlds that one call may hold.
        device: ``"cpu"``.
        dtype: `torch.float64` (default) or `torch.float32`.

    Raises:
        CapabilityError: The device, type or a tool is not supported.
        InputError: `batch_size` is below 1.
    """

    capabilities: ClassVar[SimulatorCapabilities] = SimulatorCapabilities(
        differentiable=True,
        devices=("cpu",),
        dtypes=(torch.float64, torch.float32),
        tool_kinds=TOOL_KINDS,
        deterministic_devices=("cpu",),
    )

    def __init__(
        self, scene: Scene, *, batch_size: int = 1, device: torch.device | str = "cpu", dtype: torch.dtype | None = None
    ) -> None:
        super().__init__(scene, batch_size=batch_size, device=device, dtype=dtype)
        self._material = Material(scene, dtype=self.dtype, device=self.device)

    def _substep(self, state: State, action: Tensor) -> State:
        """The state after one substep; every operation is one that autograd knows."""
        scene, mass = self.scene, self.scene.particle_volume  # density is 1
        poses = move_tools(scene, state.tool_pose, action)
        strain, stress = self._material.respond(state.elastic_strain, state.affine, scene.time_step)
        push = -scene.time_step * scene.particle_volume * 4.0 / scene.node_distance**2
        affine = scene.node_distance * (push * stress + mass * state.affine)
        stencil = make_stencil(state.position, scene.grid_size)
        momentum, node_mass = particles_to_grid(stencil, mass * state.velocity, affine, mass)
        node_velocity = update_grid(scene, stencil, momentum, node_mass, state.tool_pose, poses)
        velocity, affine = grid_to_particles(stencil, node_velocity, scene.grid_size)
        lower, upper = (velocity.new_tensor(corner) for corner in scene.domain)
        position = (state.position + scene.time_step * velocity).clamp(lower, upper)
        return State(position, velocity, affine, strain, poses)

    def _step(self, state: State, action: Tensor) -> State:
        """The state after one environment step with the action (B, A)."""
        for _ in range(self.scene.substeps):
            state = self._substep(state, action)
        return state

    def rollout(self, state: State, actions: Tensor) -> Trajectory:
        """Simulate T environment steps; see `Simulator.rollout`."""
        self.check_inputs(state, actions)
        states = [state.to(device=self.device, dtype=self.dtype).clone()]
        actions = actions.detach().to(device=self.device, dtype=self.dtype, copy=True)
        with torch.no_grad():
            for action in actions.unbind(1):
                states.append(self._step(states[-1], action))
        return Trajectory(
            positions=torch.stack([each.position for each in states], dim=1),
            tool_poses=torch.stack([each.tool_pose for each in states], dim=1),
            actions=actions.clone(),
            initial_state=states[0].clone(),
            final_state=states[-1],
            checkpoints=(actions, tuple(states[:-1])),
        )

    def vjp(
        self,
        trajectory: Trajectory,
        grad_positions: Tensor,
        grad_tools: Tensor | None = None,
        *,
        grad_final_state: State | None = None,
    ) -> RolloutGradient:
        """Pull gradients back through a rollout; see `Simulator.vjp`."""
        _check_gradients(trajectory, grad_positions, grad_tools)
        check_final_gradient(trajectory, grad_final_state)
        grad_poses = torch.zeros_like(trajectory.tool_poses) if grad_tools is None else grad_tools
        last = trajectory.step_count
        actions, starts = trajectory.checkpoints
        grad_actions = torch.zeros_like(actions)
        like = trajectory.final_state
        end = like.map(torch.zeros_like) if grad_final_state is None else grad_final_state.to(device=self.device, dtype=self.dtype)
        grad = _add(end, grad_positions[:, last], grad_poses[:, last])
        for step in reversed(range(last)):
            grad, grad_actions[:, step] = self._pull_back(starts[step], actions[:, step], grad)
            grad = _add(grad, grad_positions[:, step], grad_poses[:, step])
        return RolloutGradient(actions=grad_actions, initial_state=grad)

    def _pull_back(self, start: State, action: Tensor, grad: State) -> tuple[State, Tensor]:
        """Compute one step anew, with its graph, and pull the gradient of its end back to its start and its action."""
        with torch.enable_grad():
            start = start.map(lambda tensor: tensor.detach().requires_grad_())
            action = action.detach().requires_grad_()
            end = self._step(start, action)
        inputs = (*_tensors(start), action)
        *grads, grad_action = torch.autograd.grad(_tensors(end), inputs, _tensors(grad), materialize_grads=True)
        return State(*grads), grad_action

    def memory_estimate(self, step_count: int, *, worlds: int | None = None) -> int:
        """Bytes that a rollout and its `vjp` hold at their peak; see `Simulator.memory_estimate`.

        One environment step's graph, which is nearly all of it, and the checkpoints. Right while the bodies keep about their
        size: a body that scatters touches more nodes.
        """
        scene = self.scene
        nodes = sum(_touched_nodes(scene, body) for body in scene.bodies)
        substep = scene.particle_count * NUMBERS_PER_PARTICLE
        substep += nodes * (NUMBERS_PER_NODE + NUMBERS_PER_CONTACT * len(scene.tools))
        # a checkpoint, and snapshots of the positions in the trajectory and in its gradient
        checkpoint = scene.particle_count * (3 + 3 + 9 + 6 + 2 * 3)
        return (worlds or self.batch_size) * self.dtype.itemsize * (scene.substeps * substep + (step_count + 1) * checkpoint)


def _touched_nodes(scene: Scene, body: Body) -> int:
    """About the most nodes that a body's particles touch at the start."""
    box = math.prod(int(2.0 * half * scene.grid_size) + 4 for half in body.half_extents)
    return min(27 * body.particle_count, box)


def _add(grad: State, positions: Tensor, poses: Tensor) -> State:
    """Add the gradient of a step's snapshots to that of its state."""
    position = grad.position + positions.to(grad.position)
    return dataclasses.replace(grad, position=position, tool_pose=grad.tool_pose + poses.to(grad.tool_pose))


def _tensors(state: State) -> tuple[Tensor, ...]:
    return tuple(getattr(state, field.name) for field in dataclasses.fields(state))


def _check_gradients(trajectory: Trajectory, positions: Tensor, tools: Tensor | None) -> None:
    """Raise `InputError` unless the gradients fit a trajectory that can be pulled back."""
    if not isinstance(trajectory.checkpoints, tuple):
        raise InputError("trajectory", came="a trajectory without checkpoints", expected="one made by this simulator's rollout")
    pairs = {"grad_positions": (positions, trajectory.positions), "grad_tools": (tools, trajectory.tool_poses)}
    for name, (grad, like) in pairs.items():
        if grad is not None and grad.shape != like.shape:
            raise InputError(name, came=f"shape {tuple(grad.shape)}", expected=f"shape {tuple(like.shape)}")
