"""The kernels of a substep, forwards and backwards: one launch each, over all worlds.

A launch is cut into units, a world and a block of its particles and nodes, which `LANES` threads work on. On the CPU every unit
adds to rows of its own in the grid and in the poses' gradient, so sums have a fixed order and nothing is atomic; on CUDA a unit is
one particle or node, and adds atomically to its world's row.
"""

import functools
from types import SimpleNamespace
from typing import Any

from cpdeform.backends.taichi.kernels_grid import build_grid
from cpdeform.backends.taichi.kernels_transfer import build_transfer
from cpdeform.backends.taichi.kernels_types import (
    BLOCKS,
    BOX_SIZE,
    GRID_SIZE,
    LANES,
    ORIGIN,
    PARTICLES,
    POSITION,
    WORLDS,
    build_types,
)
from cpdeform.backends.taichi.runtime import ti


@functools.cache
def build_substep(real: Any, on_cuda: bool) -> SimpleNamespace:
    """Taichi kernels of a substep for one scalar type and kind of device."""
    types, transfer, grid = build_types(real), build_transfer(real, on_cuda), build_grid(real, on_cuda)
    vec3, vec3i, vec4, vec8, array = types.vec3, types.vec3i, types.vec4, types.vec8, types.array
    load_parameters, load_box = types.load_parameters, types.load_box
    # threads of a CUDA block; on the CPU every lane is a task of the thread pool
    block_dim = 128 if on_cuda else 1

    @ti.func
    def blocks_of(numbers: ti.template(), items):
        """Blocks that a world's particles or nodes are cut into."""
        return items if ti.static(on_cuda) else numbers[BLOCKS]

    @ti.func
    def lanes_of(numbers: ti.template(), items):
        """Threads of a loop over all worlds' particles or nodes."""
        return numbers[WORLDS] * items if ti.static(on_cuda) else numbers[LANES]

    @ti.func
    def row_of(numbers: ti.template(), world, block):
        """Row of the grid, and of the poses' gradient, that a unit adds to."""
        return world if ti.static(on_cuda) else world + block * numbers[WORLDS]

    @ti.func
    def edge(items, blocks, block):
        """First item of a block."""
        return ti.min((items + blocks - 1) // blocks * block, items)

    @ti.func
    def clear(work: ti.template(), first, nodes):
        """Empty the row of a unit. On CUDA rows belong to worlds, and are cleared before the launch."""
        if ti.static(not on_cuda):
            for n in range(first, first + nodes):
                work[n] = vec4(0.0, 0.0, 0.0, 0.0)

    @ti.kernel
    def bounds(particles: array(types.record), values: array(real), numbers: array(ti.i32)):
        """Write the box of nodes that holds the stencils of all particles of all worlds (CPU only)."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            parameters = load_parameters(values, numbers)
            low, high = vec3i(numbers[GRID_SIZE]), vec3i(0)
            for q in range(numbers[WORLDS] * numbers[PARTICLES]):
                base = transfer.base_node(transfer.load3(particles[q], POSITION), parameters)
                low = ti.min(low, base)
                high = ti.max(high, base)
            for a in ti.static(range(3)):
                numbers[ORIGIN + a] = low[a]
                numbers[BOX_SIZE + a] = high[a] + 3 - low[a]

    @ti.func
    def update_velocities(
        lane,
        values: ti.template(),
        numbers: ti.template(),
        tools: ti.template(),
        poses: ti.template(),
        frame,
        rows: ti.template(),
        row_count,
        velocities,
        total: ti.template(),
        work: ti.template(),
    ):
        """One lane's nodes: momenta and masses, summed over `row_count` rows, to `total`, and velocities to `work`."""
        parameters, box, worlds = load_parameters(values, numbers), load_box(numbers), numbers[WORLDS]
        blocks = blocks_of(numbers, box.nodes)
        unit = lane
        while unit < worlds * blocks:
            world, block = unit % worlds, unit // worlds
            for index in range(edge(box.nodes, blocks, block), edge(box.nodes, blocks, block + 1)):
                n = world * box.nodes + index
                moved = grid.sum_rows(rows, n, worlds * box.nodes, row_count)
                total[n] = moved
                work[velocities + n] = grid.update_node(moved, parameters, values, tools, poses, world, frame, box, index)
            unit += lanes_of(numbers, box.nodes)

    @ti.kernel
    def forward(
        before: array(types.record),
        after: array(types.record),
        materials: array(vec3),
        values: array(real),
        numbers: array(ti.i32),
        tools: array(types.tool),
        poses: array(vec8, 3),
        frame: ti.i32,
        rows: ti.i32,
        total: array(vec4),
        work: array(vec4),
    ):
        """A substep.

        `work` holds `rows` times the nodes of all worlds that particles add momentum and mass to, then the nodes' velocities;
        `total` gets the sums of the rows.
        """
        ti.loop_config(block_dim=block_dim, block_dim_adaptive=False)
        for lane in range(lanes_of(numbers, numbers[PARTICLES])):
            parameters, box = load_parameters(values, numbers), load_box(numbers)
            worlds, count = numbers[WORLDS], numbers[PARTICLES]
            blocks = blocks_of(numbers, count)
            unit = lane
            while unit < worlds * blocks:
                world, block = unit % worlds, unit // worlds
                first = row_of(numbers, world, block) * box.nodes
                clear(work, first, box.nodes)
                for p in range(edge(count, blocks, block), edge(count, blocks, block + 1)):
                    q = world * count + p
                    transfer.particle_to_grid(before, after, materials, parameters, box, p, q, work, first)
                unit += lanes_of(numbers, count)
        ti.loop_config(block_dim=block_dim, block_dim_adaptive=False)
        for lane in range(lanes_of(numbers, load_box(numbers).nodes)):
            velocities = rows * numbers[WORLDS] * load_box(numbers).nodes
            update_velocities(lane, values, numbers, tools, poses, frame, work, rows, velocities, total, work)
        ti.loop_config(block_dim=block_dim, block_dim_adaptive=False)
        for lane in range(lanes_of(numbers, numbers[PARTICLES])):
            parameters, box = load_parameters(values, numbers), load_box(numbers)
            worlds, count = numbers[WORLDS], numbers[PARTICLES]
            blocks = blocks_of(numbers, count)
            unit = lane
            while unit < worlds * blocks:
                world, block = unit % worlds, unit // worlds
                first = (rows * worlds + world) * box.nodes
                for p in range(edge(count, blocks, block), edge(count, blocks, block + 1)):
                    transfer.grid_to_particle(before, after, parameters, box, world * count + p, work, first)
                unit += lanes_of(numbers, count)

    @ti.kernel
    def backward(
        before: array(types.record),
        after: array(types.record),
        gradient: array(types.record),
        materials: array(vec3),
        values: array(real),
        numbers: array(ti.i32),
        tools: array(types.tool),
        poses: array(vec8, 3),
        grad_poses: array(vec8, 3),
        frame: ti.i32,
        rows: ti.i32,
        total: array(vec4),
        work: array(vec4),
    ):
        """The adjoint of a substep: turns `gradient` after it into that before it and adds to rows of `grad_poses`.

        `work` is laid out as forwards; its rows hold gradients with respect to the nodes' velocities, and in the
        end the first ones those of momentum and mass.
        """
        ti.loop_config(block_dim=block_dim, block_dim_adaptive=False)
        for lane in range(lanes_of(numbers, load_box(numbers).nodes)):
            velocities = rows * numbers[WORLDS] * load_box(numbers).nodes
            update_velocities(lane, values, numbers, tools, poses, frame, total, 1, velocities, total, work)
        ti.loop_config(block_dim=block_dim, block_dim_adaptive=False)
        for lane in range(lanes_of(numbers, numbers[PARTICLES])):
            parameters, box = load_parameters(values, numbers), load_box(numbers)
            worlds, count = numbers[WORLDS], numbers[PARTICLES]
            blocks = blocks_of(numbers, count)
            unit = lane
            while unit < worlds * blocks:
                world, block = unit % worlds, unit // worlds
                velocities = (rows * worlds + world) * box.nodes
                gradients = row_of(numbers, world, block) * box.nodes
                clear(work, gradients, box.nodes)
                for p in range(edge(count, blocks, block), edge(count, blocks, block + 1)):
                    q = world * count + p
                    transfer.grid_to_particle_adjoint(before, after, gradient, parameters, box, q, work, velocities, gradients)
                unit += lanes_of(numbers, count)
        ti.loop_config(block_dim=block_dim, block_dim_adaptive=False)
        for lane in range(lanes_of(numbers, load_box(numbers).nodes)):
            parameters, box, worlds = load_parameters(values, numbers), load_box(numbers), numbers[WORLDS]
            blocks = blocks_of(numbers, box.nodes)
            unit = lane
            while unit < worlds * blocks:
                world, block = unit % worlds, unit // worlds
                row = row_of(numbers, world, block)
                for index in range(edge(box.nodes, blocks, block), edge(box.nodes, blocks, block + 1)):
                    n = world * box.nodes + index
                    incoming = grid.sum_rows(work, n, worlds * box.nodes, rows)
                    work[n] = grid.update_node_adjoint(
                        total[n], incoming, parameters, values, tools, poses, world, frame, box, index, grad_poses, row
                    )
                unit += lanes_of(numbers, box.nodes)
        ti.loop_config(block_dim=block_dim, block_dim_adaptive=False)
        for lane in range(lanes_of(numbers, numbers[PARTICLES])):
            parameters, box = load_parameters(values, numbers), load_box(numbers)
            worlds, count = numbers[WORLDS], numbers[PARTICLES]
            blocks = blocks_of(numbers, count)
            unit = lane
            while unit < worlds * blocks:
                world, block = unit % worlds, unit // worlds
                for p in range(edge(count, blocks, block), edge(count, blocks, block + 1)):
                    q = world * count + p
                    transfer.particle_to_grid_adjoint(before, gradient, materials, parameters, box, p, q, work, world * box.nodes)
                unit += lanes_of(numbers, count)

    return SimpleNamespace(bounds=bounds, forward=forward, backward=backward)
