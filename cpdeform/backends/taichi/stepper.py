"""A stepper: takes all worlds of a call through substeps, forwards and backwards."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from cpdeform.backends.taichi.kernels_types import BOX_SIZE, RECORD_SIZE
from cpdeform.backends.taichi.scene_arrays import make_numbers
from cpdeform.core.errors import InputError
from cpdeform.core.scene import Scene

LARGEST_ARRAY = 2**31 - 1
"""Numbers in an array; Taichi's indices have 32 bits."""


@dataclasses.dataclass(frozen=True)
class Substep:
    """What a substep's adjoint needs.

    Attributes:
        before: Particles (W N, 21) before it, see `kernels_types`.
        after: Particles after it.
        numbers: The launch's whole numbers, with the box of nodes that the grid covers.
        total: Momentum and mass (W nodes, 4) on the grid.
    """

    before: Tensor
    after: Tensor
    numbers: Tensor
    total: Tensor


@dataclasses.dataclass(frozen=True)
class Program:
    """What all calls of a simulator share.

    Attributes:
        scene: The scene.
        kernels: All kernels.
        values: Constants of the scene.
        tools: Tools (M, 22).
        materials: Material (N, 3) of each particle.
        on_cuda: Whether the kernels are CUDA's.
    """

    scene: Scene
    kernels: SimpleNamespace
    values: Tensor
    tools: Tensor
    materials: Tensor
    on_cuda: bool


class Stepper:
    """Runs substeps for W worlds.

    Args:
        program: Kernels and constants.
        worlds: Number of worlds W.
        threads: Threads on the CPU. They share out the worlds, or the particles and nodes of each where worlds are fewer.
    """

    def __init__(self, program: Program, *, worlds: int, threads: int) -> None:
        self.program = program
        self.worlds = worlds
        self._like = program.values
        self.rows = threads if worlds < threads and not program.on_cuda else 1
        numbers = make_numbers(program.scene, worlds=worlds, blocks=self.rows, lanes=threads)
        self._numbers = numbers.to(program.values.device)
        self._work = self._like.new_empty(0, 4)
        self._check_size(worlds * program.scene.particle_count * RECORD_SIZE)

    def _check_size(self, count: int) -> None:
        if count > LARGEST_ARRAY:
            raise InputError(
                "state", came=f"{self.worlds} worlds, an array of {count} numbers", expected=f"at most {LARGEST_ARRAY} numbers",
                remedy="Call it with fewer worlds at a time.",
            )  # fmt: skip

    def _workspace(self, nodes: int) -> Tensor:
        """Room for the rows that particles add to and the nodes' velocities; valid until the next call."""
        rows = self.rows * self.worlds * nodes
        size = rows + self.worlds * nodes
        if self._work.shape[0] < size:
            self._check_size(4 * size)
            self._work = self._like.new_empty(size, 4)
        if self.program.on_cuda:
            # on the CPU the kernels do, since torch's threads would keep the cores busy while they wait for more
            self._work[:rows].zero_()
        return self._work

    def _box(self, particles: Tensor) -> tuple[Tensor, int]:
        """The launch's whole numbers with the box that holds all stencils, and how many nodes that has."""
        if self.program.on_cuda:
            return self._numbers, self.program.scene.grid_size**3
        numbers = self._numbers.clone()
        self.program.kernels.bounds(particles, self.program.values, numbers)
        x, y, z = numbers[BOX_SIZE:].tolist()
        return numbers, x * y * z

    def forward(self, before: Tensor, poses: Tensor, frame: int) -> Substep:
        """One substep.

        Args:
            before: Particles (W N, 21) before it.
            poses: Tool poses (W, frames, tools, 8).
            frame: Number of the substep; tools move from this frame to the next.
        """
        program = self.program
        numbers, nodes = self._box(before)
        after = torch.empty_like(before)
        total = self._like.new_empty(self.worlds * nodes, 4)
        arguments: tuple[Any, ...] = (program.materials, program.values, numbers, program.tools, poses, frame, self.rows)
        program.kernels.forward(before, after, *arguments, total, self._workspace(nodes))
        return Substep(before, after, numbers, total)

    def backward(self, substep: Substep, poses: Tensor, frame: int, gradient: Tensor, grad_poses: Tensor) -> None:
        """The adjoint of one substep, in place.

        Args:
            substep: Record of the substep.
            poses: Tool poses (W, frames, tools, 8).
            frame: Number of the substep.
            gradient: Gradient (W N, 21) with respect to the particles after the substep; becomes that before it.
            grad_poses: Gradient (rows W, frames, tools, 8) with respect to the poses; added to.
        """
        program = self.program
        work = self._workspace(substep.total.shape[0] // self.worlds)
        matter: tuple[Any, ...] = (substep.before, substep.after, gradient, program.materials, program.values, substep.numbers)
        program.kernels.backward(*matter, program.tools, poses, grad_poses, frame, self.rows, substep.total, work)
