"""A lane: worlds that are launched together, substep by substep, forwards and backwards.

On the CPU a lane is one world, its grid covers the particles' bounding box, and particles may be split into blocks that scatter
to grid rows of their own, so that several threads work on one world. On CUDA a lane is the whole batch on the full grid.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any, Protocol

import warp as wp

from cpdeform.core.forking import LocalThreads


@dataclasses.dataclass(frozen=True)
class Particles:
    """Warp arrays (W, N): position, velocity, affine, elastic strain; or the gradients with respect to them."""

    position: Any
    velocity: Any
    affine: Any
    strain: Any

    @property
    def arrays(self) -> tuple[Any, Any, Any, Any]:
        """All four, in the order of the kernels' arguments."""
        return (self.position, self.velocity, self.affine, self.strain)


@dataclasses.dataclass(frozen=True)
class Substep:
    """What a substep's adjoint needs: the particles before it, and momentum and mass on the grid.

    Attributes:
        particles: Particles before the substep.
        grid: Momentum and mass (rows, nodes); the first W rows hold the sums.
        origin: First node of the grid along each axis.
        size: Nodes of the grid along each axis.
    """

    particles: Particles
    grid: Any
    origin: Any
    size: Any


@dataclasses.dataclass(frozen=True)
class Program:
    """What all lanes of a simulator share.

    Attributes:
        types: Vector types, see `kernels_types`.
        kernels: All kernels.
        parameters: Constants of the scene.
        tools: Tools.
        constants: Material of each particle.
        substeps: Substeps per environment step.
        device: Warp's name of the device.
    """

    types: SimpleNamespace
    kernels: SimpleNamespace
    parameters: Any
    tools: Any
    constants: Any
    substeps: int
    device: str


class Arrays(Protocol):
    """Where a lane gets its work space from."""

    def kept(self, shape: tuple[int, ...], dtype: Any, *, zero: bool = False) -> Any:
        """An array that outlives the substep: part of its record or of its result; filled with zeros if asked for."""

    def scratch(self, name: str, shape: tuple[int, ...], dtype: Any, *, zero: bool = False) -> Any:
        """An array that is read in the substep alone; the next one may be given the same under the same name."""


class FreshArrays:
    """Makes a new array for every request.

    Args:
        device: Warp's name of the device.
    """

    def __init__(self, device: str) -> None:
        self._device = device

    def kept(self, shape: tuple[int, ...], dtype: Any, *, zero: bool = False) -> Any:
        """See `Arrays.kept`."""
        return (wp.zeros if zero else wp.empty)(shape, dtype=dtype, device=self._device)

    def scratch(self, name: str, shape: tuple[int, ...], dtype: Any, *, zero: bool = False) -> Any:
        """See `Arrays.scratch`."""
        return self.kept(shape, dtype, zero=zero)


class Lane:
    """Runs substeps for W worlds.

    Args:
        program: Kernels and constants.
        worlds: Number of worlds W in this lane; 1 on the CPU.
        particle_count: Particles N of a world.
        pool: Threads for the blocks of one world; None for a single block.
        blocks: Number of blocks.
        arrays: Gives work space; defaults to new arrays each time.
        full_grid: Whether the grid is the whole one, whose size is known beforehand, on the CPU too.
    """

    def __init__(
        self,
        program: Program,
        *,
        worlds: int,
        particle_count: int,
        pool: LocalThreads | None = None,
        blocks: int = 1,
        arrays: Arrays | None = None,
        full_grid: bool = False,
    ) -> None:
        self.program = program
        self.worlds = worlds
        self.particle_count = particle_count
        self._pool = pool
        self.blocks = blocks if pool is not None else 1
        self._arrays = arrays or FreshArrays(program.device)
        self._boxed = program.device == "cpu" and not full_grid
        if self._boxed:
            self._bounds = wp.zeros(2, dtype=wp.vec3i, device="cpu")
            self._bounds_view = self._bounds.numpy()

    def _spread(self, count: int, launch: Callable[[int, int, int], None]) -> None:
        """Call `launch(block, first, count)` for every block of `count` items, in parallel."""
        if self._pool is None or self.blocks == 1:
            launch(0, 0, count)
            return
        edges = [count * block // self.blocks for block in range(self.blocks + 1)]
        futures = [
            self._pool.submit(launch, block, edges[block], edges[block + 1] - edges[block]) for block in range(1, self.blocks)
        ]
        launch(0, 0, edges[1])
        for future in futures:
            future.result()

    def _launch(self, kernel: Any, count: int, inputs: Sequence[Any]) -> None:
        wp.launch(kernel, dim=(self.worlds, count), inputs=list(inputs), device=self.program.device)

    def _grid_box(self, position: Any) -> tuple[Any, Any, int]:
        """Origin, size and number of nodes of a grid that holds all stencils."""
        n = self.program.parameters.grid_size
        if not self._boxed:
            return wp.vec3i(0, 0, 0), wp.vec3i(n, n, n), n**3
        wp.launch(self.program.kernels.bounds, dim=1, inputs=[position, self.program.parameters, self._bounds], device="cpu")
        low, high = self._bounds_view.tolist()
        size = [last - first + 1 for first, last in zip(low, high, strict=True)]
        return wp.vec3i(*low), wp.vec3i(*size), size[0] * size[1] * size[2]

    def _new_particles(self) -> Particles:
        types, shape = self.program.types, (self.worlds, self.particle_count)
        return Particles(*(self._arrays.kept(shape, dtype) for dtype in (types.vec3, types.vec3, types.mat33, types.vec6)))

    def forward(self, particles: Particles, poses: Any, frame: int, after: Particles | None = None) -> tuple[Substep, Particles]:
        """One substep.

        Args:
            particles: Particles before it.
            poses: Tool poses (W, frames, tools).
            frame: Number of the substep; tools move from this frame to the next.
            after: Where the particles after the substep go; defaults to arrays of their own.

        Returns:
            The record for the adjoint, and the particles after the substep.
        """
        program, kernels, node = self.program, self.program.kernels, self.program.types.vec4
        origin, size, nodes = self._grid_box(particles.position)
        grid = self._arrays.kept((self.blocks * self.worlds, nodes), node, zero=True)
        velocity = self._arrays.scratch("velocity", (self.worlds, nodes), node)
        after = after or self._new_particles()
        tools, box = (poses, program.tools, program.parameters, frame), (origin, size)
        matter = (*particles.arrays, program.constants, program.parameters)
        moved = (after.position, after.velocity, after.affine)

        def scatter(block: int, first: int, count: int) -> None:
            row = block * self.worlds
            self._launch(kernels.particles_to_grid, count, (*matter, first, row, *box, after.strain, grid))

        def update(block: int, first: int, count: int) -> None:
            self._launch(kernels.update_grid, count, (grid, self.blocks, *tools, first, *box, velocity))

        def gather(block: int, first: int, count: int) -> None:
            inputs = (particles.position, velocity, program.parameters, first, *box, *moved)
            self._launch(kernels.grid_to_particles, count, inputs)

        self._spread(self.particle_count, scatter)
        self._spread(nodes, update)
        self._spread(self.particle_count, gather)
        return Substep(particles, grid, origin, size), after

    def backward(self, substep: Substep, velocity_after: Any, poses: Any, frame: int, gradient: Particles, grad_poses: Any) -> None:
        """The adjoint of one substep, in place.

        Args:
            substep: Record of the substep.
            velocity_after: Particle velocities (W, N) after it.
            poses: Tool poses (W, frames, tools).
            frame: Number of the substep.
            gradient: Gradient with respect to the particles after the substep; becomes that before it.
            grad_poses: Gradient (blocks * W, frames, tools) with respect to the poses; added to.
        """
        program, kernels = self.program, self.program.kernels
        before, grid, box = substep.particles, substep.grid, (substep.origin, substep.size)
        nodes = grid.shape[1]
        node = program.types.vec4
        velocity = self._arrays.scratch("velocity", (self.worlds, nodes), node)
        grad_grid = self._arrays.scratch("gradient", (self.blocks * self.worlds, nodes), node, zero=True)
        tools = (poses, program.tools, program.parameters, frame)
        matter = (*before.arrays, program.constants, program.parameters)
        moved = (gradient.position, gradient.velocity, gradient.affine)

        def update(block: int, first: int, count: int) -> None:
            self._launch(kernels.update_grid, count, (grid, 1, *tools, first, *box, velocity))

        def scatter(block: int, first: int, count: int) -> None:
            row = block * self.worlds
            start = (before.position, velocity_after, velocity, program.parameters)
            self._launch(kernels.grid_to_particles_adjoint, count, (*start, first, row, *box, *moved, grad_grid))

        def update_adjoint(block: int, first: int, count: int) -> None:
            inputs = (grid, self.blocks, *tools, first, *box, grad_grid, block, grad_poses)
            self._launch(kernels.update_grid_adjoint, count, inputs)

        def gather(block: int, first: int, count: int) -> None:
            inputs = (*matter, first, *box, grad_grid, *gradient.arrays)
            self._launch(kernels.particles_to_grid_adjoint, count, inputs)

        self._spread(nodes, update)
        self._spread(self.particle_count, scatter)
        self._spread(nodes, update_adjoint)
        self._spread(self.particle_count, gather)
