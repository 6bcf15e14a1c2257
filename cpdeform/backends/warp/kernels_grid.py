"""The grid update: gravity, contact with the tools, walls and floor; and its adjoint.

A node's velocity passes through the tools in turn, then the walls. The adjoint recomputes a node's velocity before each
tool instead of storing it: contact nodes are few.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from cpdeform.backends.scene_numbers import CHOPSTICKS
from cpdeform.backends.warp.kernels_distance import build_distance
from cpdeform.backends.warp.kernels_types import KERNEL_OPTIONS, build_types
from cpdeform.core.scene import WALL_NODES


@functools.cache
def build_grid(real: Any) -> SimpleNamespace:
    """Warp kernels of the grid update for one scalar type."""
    types, geometry = build_types(real), build_distance(real)
    vec3, vec4, vec8, Parameters, Tool = types.vec3, types.vec4, types.vec8, types.Parameters, types.Tool
    surface, part_centre = geometry.surface, geometry.part_centre
    pose_position, pose_axis, rotate, rotate_adjoint = (
        geometry.pose_position,
        geometry.pose_axis,
        geometry.rotate,
        geometry.rotate_adjoint,
    )
    zero, half, one = real(0.0), real(0.5), real(1.0)
    smallest_mass = real(1e-12)
    smallest_influence = real(0.1)
    sticky_friction = real(10.0)
    norm_regularization = real(1e-8)
    wall = WALL_NODES

    @wp.func
    def influence(parameters: Parameters, distance: real):
        """Share of the contact velocity at a node; 0 where there is no contact."""
        k = zero
        if parameters.softness > zero:
            k = wp.min(wp.exp(-parameters.softness * distance), one)
            if k <= smallest_influence:
                k = zero
        elif distance <= zero:
            k = one
        return k

    @wp.func
    def surface_velocity(local: vec3, before: vec8, after: vec8, time_step: real):
        """Velocity of the tool's material at a local point; differences are taken before they lose digits."""
        turn = rotate(after[3], pose_axis(after), local) - rotate(before[3], pose_axis(before), local)
        return (pose_position(after) - pose_position(before) + turn) / time_step

    @wp.func
    def contact(parameters: Parameters, tool: Tool, before: vec8, after: vec8, node: vec3, velocity: vec3):
        """A node's velocity after contact with one tool."""
        local = rotate(before[3], -pose_axis(before), node - pose_position(before))
        centre = part_centre(tool.kind, tool.size, before[7], local)
        local_normal, distance, _bend, _steepness = surface(
            parameters.grids, tool.grid_first, tool.kind, tool.size, local - centre, vec3(zero, zero, zero)
        )
        k = influence(parameters, distance)
        result = velocity
        if k > zero:
            normal = rotate(before[3], pose_axis(before), local_normal)
            vc = surface_velocity(local, before, after, parameters.time_step)
            u = velocity - vc
            un = wp.dot(u, normal)
            t = u
            if un < zero:
                s = u - un * normal
                norm = wp.sqrt(wp.dot(s, s) + norm_regularization)
                t = (wp.max(zero, norm + tool.friction * un) / norm) * s
            result = vc + (one - k) * u + k * t
        return result

    @wp.func
    def contact_adjoint(
        parameters: Parameters,
        tool: Tool,
        before: vec8,
        after: vec8,
        node: vec3,
        velocity: vec3,
        g: vec3,
        grad_pose: wp.array3d(dtype=vec8),
        world: int,
        frame: int,
        index: int,
    ):
        """Gradient with respect to the velocity before contact; adds those of both poses to `grad_pose`."""
        local = rotate(before[3], -pose_axis(before), node - pose_position(before))
        centre = part_centre(tool.kind, tool.size, before[7], local)
        local_normal, distance, _bend, steepness = surface(
            parameters.grids, tool.grid_first, tool.kind, tool.size, local - centre, vec3(zero, zero, zero)
        )
        k = influence(parameters, distance)
        result = g
        if k > zero:
            normal = rotate(before[3], pose_axis(before), local_normal)
            vc = surface_velocity(local, before, after, parameters.time_step)
            u = velocity - vc
            un = wp.dot(u, normal)
            t = u
            gt = k * g
            gu = (one - k) * g
            gn = vec3(zero, zero, zero)
            if un < zero:
                s = u - un * normal
                norm = wp.sqrt(wp.dot(s, s) + norm_regularization)
                left = norm + tool.friction * un
                gun = zero
                gs = vec3(zero, zero, zero)
                t = vec3(zero, zero, zero)
                if left > zero:
                    ratio = left / norm
                    t = ratio * s
                    along = wp.dot(gt, s) / norm
                    # ratio = 1 + friction un / norm
                    gs = ratio * gt - (along * tool.friction * un / (norm * norm)) * s
                    gun = along * tool.friction
                gu += gs
                gun -= wp.dot(gs, normal)
                gn -= un * gs
                gu += gun * normal
                gn += gun * u
            else:
                gu += gt
            gk = wp.dot(g, t - u)
            gv = gu
            gvc = g - gu
            # surface velocity
            gvc = gvc / parameters.time_step
            gp_after = gvc
            gq_after = rotate_adjoint(after[3], pose_axis(after), local, gvc)
            gp_before = -gvc
            gq_before = -rotate_adjoint(before[3], pose_axis(before), local, gvc)
            gl = rotate(after[3], -pose_axis(after), gvc) - rotate(before[3], -pose_axis(before), gvc)
            # normal and influence
            gq_before += rotate_adjoint(before[3], pose_axis(before), local_normal, gn)
            _normal, _distance, gs, _steepness = surface(
                parameters.grids, tool.grid_first, tool.kind, tool.size, local - centre, rotate(before[3], -pose_axis(before), gn)
            )
            if parameters.softness > zero and distance > zero:
                gs -= (gk * parameters.softness * k * steepness) * local_normal
            gl += gs
            gap = zero
            if tool.kind == wp.static(CHOPSTICKS):
                gap = half * gs[0]
                if local[0] >= zero:
                    gap = -gap
            # local = R(before)^T (node - position)
            inverse = rotate_adjoint(before[3], -pose_axis(before), node - pose_position(before), gl)
            gq_before += vec4(inverse[0], -inverse[1], -inverse[2], -inverse[3])
            gp_before -= rotate(before[3], pose_axis(before), gl)
            wp.atomic_add(
                grad_pose,
                world,
                frame,
                index,
                vec8(gp_before[0], gp_before[1], gp_before[2], gq_before[0], gq_before[1], gq_before[2], gq_before[3], gap),
            )
            wp.atomic_add(
                grad_pose,
                world,
                frame + 1,
                index,
                vec8(gp_after[0], gp_after[1], gp_after[2], gq_after[0], gq_after[1], gq_after[2], gq_after[3], zero),
            )
            result = gv
        return result

    @wp.func
    def wall_blocks(parameters: Parameters, i: int, v: real):
        """Whether a wall (not the floor) stops a velocity component at node number i of its axis."""
        return (i < wall and v < zero) or (i > parameters.grid_size - wall and v > zero)

    @wp.func
    def floor_slip(parameters: Parameters, v: vec3):
        """Tangential velocity on the floor and its Coulomb factor, as (vec4: tangent, factor)."""
        tangent = vec3(v[0], zero, v[2])
        norm = wp.sqrt(wp.dot(tangent, tangent) + norm_regularization)
        return vec4(v[0], zero, v[2], wp.max(one + parameters.ground_friction * v[1] / norm, zero))

    @wp.func
    def boundary(parameters: Parameters, node: wp.vec3i, velocity: vec3):
        v = velocity
        if wall_blocks(parameters, node[0], v[0]):
            v[0] = zero
        if node[1] < parameters.ground_nodes and v[1] < zero:
            if parameters.ground_friction >= sticky_friction:
                v = vec3(zero, zero, zero)
            else:
                factor = one
                if parameters.ground_friction > zero:
                    slip = floor_slip(parameters, v)
                    factor = slip[3]
                v = vec3(factor * v[0], zero, factor * v[2])
        if node[1] > parameters.grid_size - wall and v[1] > zero:
            v[1] = zero
        if wall_blocks(parameters, node[2], v[2]):
            v[2] = zero
        return v

    @wp.func
    def boundary_adjoint(parameters: Parameters, node: wp.vec3i, velocity: vec3, gradient: vec3):
        v = velocity
        g = gradient
        block_x = wall_blocks(parameters, node[0], v[0])
        if block_x:
            v[0] = zero
        floor = node[1] < parameters.ground_nodes and v[1] < zero
        after = v
        slip = vec4(zero, zero, zero, one)
        if floor:
            if parameters.ground_friction > zero:
                slip = floor_slip(parameters, v)
            after = vec3(slip[3] * v[0], zero, slip[3] * v[2])
            if parameters.ground_friction >= sticky_friction:
                after = vec3(zero, zero, zero)
        if wall_blocks(parameters, node[2], after[2]):
            g[2] = zero
        if node[1] > parameters.grid_size - wall and after[1] > zero:
            g[1] = zero
        if floor:
            if parameters.ground_friction >= sticky_friction:
                g = vec3(zero, zero, zero)
            else:
                along = g[0] * v[0] + g[2] * v[2]
                g = vec3(slip[3] * g[0], zero, slip[3] * g[2])
                if parameters.ground_friction > zero and slip[3] > zero:
                    # factor = 1 + friction v_y / norm
                    norm = wp.sqrt(v[0] * v[0] + v[2] * v[2] + norm_regularization)
                    pull = parameters.ground_friction / norm
                    bend = -along * pull * v[1] / (norm * norm)
                    g = vec3(g[0] + bend * v[0], along * pull, g[2] + bend * v[2])
        if block_x:
            g[0] = zero
        return g

    @wp.func
    def node_number(index: int, origin: wp.vec3i, size: wp.vec3i):
        layer = size[1] * size[2]
        i = index // layer
        rest = index - i * layer
        j = rest // size[2]
        return wp.vec3i(origin[0] + i, origin[1] + j, origin[2] + rest - j * size[2])

    @wp.func
    def node_position(number: wp.vec3i, distance: real):
        return vec3(real(number[0]) * distance, real(number[1]) * distance, real(number[2]) * distance)

    @wp.func
    def gather_rows(grid: wp.array2d(dtype=vec4), world: int, worlds: int, rows: int, index: int):
        total = grid[world, index]
        for r in range(1, rows):
            total += grid[world + r * worlds, index]
        return total

    @wp.kernel(**KERNEL_OPTIONS)
    def update_grid(
        grid: wp.array2d(dtype=vec4),
        rows: int,
        poses: wp.array3d(dtype=vec8),
        tools: wp.array(dtype=Tool),
        parameters: Parameters,
        frame: int,
        first: int,
        origin: wp.vec3i,
        size: wp.vec3i,
        result: wp.array2d(dtype=vec4),
    ):
        """Velocities from momenta. The blocks' rows of `grid` are summed into its first."""
        world, local_index = wp.tid()
        index = first + local_index
        total = gather_rows(grid, world, result.shape[0], rows, index)
        if rows > 1:
            grid[world, index] = total
        v = vec3(zero, zero, zero)
        if total[3] > smallest_mass:
            number = node_number(index, origin, size)
            node = node_position(number, parameters.node_distance)
            v = vec3(total[0] / total[3], total[1] / total[3], total[2] / total[3]) + parameters.time_step * parameters.gravity
            for m in range(parameters.tool_count):
                v = contact(parameters, tools[m], poses[world, frame, m], poses[world, frame + 1, m], node, v)
            v = boundary(parameters, number, v)
        result[world, index] = vec4(v[0], v[1], v[2], zero)

    @wp.kernel(**KERNEL_OPTIONS)
    def update_grid_adjoint(
        grid: wp.array2d(dtype=vec4),
        rows: int,
        poses: wp.array3d(dtype=vec8),
        tools: wp.array(dtype=Tool),
        parameters: Parameters,
        frame: int,
        first: int,
        origin: wp.vec3i,
        size: wp.vec3i,
        grad_grid: wp.array2d(dtype=vec4),
        pose_row: int,
        grad_poses: wp.array3d(dtype=vec8),
    ):
        """Replaces the gradient of the velocities in `grad_grid` (rows summed into the first) by that of momentum and mass."""
        world, local_index = wp.tid()
        index = first + local_index
        worlds = poses.shape[0]
        total = grid[world, index]
        result = vec4(zero, zero, zero, zero)
        if total[3] > smallest_mass:
            incoming = gather_rows(grad_grid, world, worlds, rows, index)
            g = vec3(incoming[0], incoming[1], incoming[2])
            number = node_number(index, origin, size)
            node = node_position(number, parameters.node_distance)
            raw = vec3(total[0] / total[3], total[1] / total[3], total[2] / total[3])
            start = raw + parameters.time_step * parameters.gravity
            v = start
            for m in range(parameters.tool_count):
                v = contact(parameters, tools[m], poses[world, frame, m], poses[world, frame + 1, m], node, v)
            g = boundary_adjoint(parameters, number, v, g)
            for r in range(parameters.tool_count):
                last = parameters.tool_count - 1 - r
                w = start
                for m in range(last):
                    w = contact(parameters, tools[m], poses[world, frame, m], poses[world, frame + 1, m], node, w)
                g = contact_adjoint(
                    parameters,
                    tools[last],
                    poses[world, frame, last],
                    poses[world, frame + 1, last],
                    node,
                    w,
                    g,
                    grad_poses,
                    pose_row * worlds + world,
                    frame,
                    last,
                )
            inverse = one / total[3]
            result = vec4(inverse * g[0], inverse * g[1], inverse * g[2], -inverse * wp.dot(g, raw))
        grad_grid[world, index] = result

    return SimpleNamespace(update_grid=update_grid, update_grid_adjoint=update_grid_adjoint)
