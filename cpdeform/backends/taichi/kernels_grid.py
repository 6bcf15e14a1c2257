"""The grid update: gravity, contact with the tools, walls and floor; and its adjoint.

A node's velocity passes through the tools in turn, then the walls. The adjoint recomputes a node's velocity before each
tool instead of storing it: contact nodes are few.
"""

import functools
from types import SimpleNamespace
from typing import Any

from cpdeform.backends.scene_numbers import CHOPSTICKS
from cpdeform.backends.taichi.kernels_distance import build_distance
from cpdeform.backends.taichi.kernels_types import build_types
from cpdeform.backends.taichi.runtime import ti
from cpdeform.core.scene import WALL_NODES


@functools.cache
def build_grid(real: Any, atomic: bool) -> SimpleNamespace:
    """Taichi functions of one node's update, for one scalar type.

    Args:
        real: `ti.f32` or `ti.f64`.
        atomic: Whether several threads add to the same row of the poses' gradient.
    """
    types, geometry = build_types(real), build_distance(real)
    vec3, vec3i, vec4, vec8, load_tool = types.vec3, types.vec3i, types.vec4, types.vec8, types.load_tool
    surface, part_centre = geometry.surface, geometry.part_centre
    pose_position, pose_axis, rotate, rotate_adjoint = (
        geometry.pose_position,
        geometry.pose_axis,
        geometry.rotate,
        geometry.rotate_adjoint,
    )
    zero, half, one = 0.0, 0.5, 1.0
    smallest_mass = 1e-12
    smallest_influence = 0.1
    sticky_friction = 10.0
    norm_regularization = 1e-8
    wall = WALL_NODES

    @ti.func
    def influence(parameters: ti.template(), distance):
        """Share of the contact velocity at a node; 0 where there is no contact."""
        k = real(zero)
        if parameters.softness > zero:
            k = ti.min(ti.exp(-parameters.softness * distance), one)
            if k <= real(smallest_influence):
                k = real(zero)
        elif distance <= zero:
            k = real(one)
        return k

    @ti.func
    def surface_velocity(local, before, after, time_step):
        """Velocity of the tool's material at a local point; differences are taken before they lose digits."""
        turn = rotate(after[3], pose_axis(after), local) - rotate(before[3], pose_axis(before), local)
        return (pose_position(after) - pose_position(before) + turn) / time_step

    @ti.func
    def contact(parameters: ti.template(), values: ti.template(), tool: ti.template(), before, after, node, velocity):
        """A node's velocity after contact with one tool."""
        local = rotate(before[3], -pose_axis(before), node - pose_position(before))
        centre = part_centre(tool.kind, tool.size, before[7], local)
        local_normal, distance, _bend, _steepness = surface(
            values, tool.grid_first, tool.kind, tool.size, local - centre, vec3(zero, zero, zero)
        )
        k = influence(parameters, distance)
        result = velocity
        if k > zero:
            normal = rotate(before[3], pose_axis(before), local_normal)
            vc = surface_velocity(local, before, after, parameters.time_step)
            u = velocity - vc
            un = u.dot(normal)
            t = u
            if un < zero:
                s = u - un * normal
                norm = ti.sqrt(s.dot(s) + real(norm_regularization))
                t = (ti.max(zero, norm + tool.friction * un) / norm) * s
            result = vc + (one - k) * u + k * t
        return result

    @ti.func
    def add(grad_poses: ti.template(), row, frame, index, value):
        if ti.static(atomic):
            grad_poses[row, frame, index] += value
        else:
            grad_poses[row, frame, index] = grad_poses[row, frame, index] + value

    @ti.func
    def contact_adjoint(
        parameters: ti.template(),
        values: ti.template(),
        tool: ti.template(),
        before,
        after,
        node,
        velocity,
        g,
        grad_poses: ti.template(),
        row,
        frame,
        index,
    ):
        """Gradient with respect to the velocity before contact; adds those of both poses to `grad_poses`."""
        local = rotate(before[3], -pose_axis(before), node - pose_position(before))
        centre = part_centre(tool.kind, tool.size, before[7], local)
        local_normal, distance, _bend, steepness = surface(
            values, tool.grid_first, tool.kind, tool.size, local - centre, vec3(zero, zero, zero)
        )
        k = influence(parameters, distance)
        result = g
        if k > zero:
            normal = rotate(before[3], pose_axis(before), local_normal)
            vc = surface_velocity(local, before, after, parameters.time_step)
            u = velocity - vc
            un = u.dot(normal)
            t = u
            gt = k * g
            gu = (one - k) * g
            gn = vec3(zero, zero, zero)
            if un < zero:
                s = u - un * normal
                norm = ti.sqrt(s.dot(s) + real(norm_regularization))
                left = norm + tool.friction * un
                gun = real(zero)
                gs = vec3(zero, zero, zero)
                t = vec3(zero, zero, zero)
                if left > zero:
                    ratio = left / norm
                    t = ratio * s
                    along = gt.dot(s) / norm
                    # ratio = 1 + friction un / norm
                    gs = ratio * gt - (along * tool.friction * un / (norm * norm)) * s
                    gun = along * tool.friction
                gu += gs
                gun -= gs.dot(normal)
                gn -= un * gs
                gu += gun * normal
                gn += gun * u
            else:
                gu += gt
            gk = g.dot(t - u)
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
                values, tool.grid_first, tool.kind, tool.size, local - centre, rotate(before[3], -pose_axis(before), gn)
            )
            if parameters.softness > zero and distance > zero:
                gs -= (gk * parameters.softness * k * steepness) * local_normal
            gl += gs
            gap = real(zero)
            if tool.kind == CHOPSTICKS:
                gap = half * gs[0]
                if local[0] >= zero:
                    gap = -gap
            # local = R(before)^T (node - position)
            inverse = rotate_adjoint(before[3], -pose_axis(before), node - pose_position(before), gl)
            gq_before += vec4(inverse[0], -inverse[1], -inverse[2], -inverse[3])
            gp_before -= rotate(before[3], pose_axis(before), gl)
            change_before = vec8(
                gp_before[0], gp_before[1], gp_before[2], gq_before[0], gq_before[1], gq_before[2], gq_before[3], gap
            )
            change_after = vec8(gp_after[0], gp_after[1], gp_after[2], gq_after[0], gq_after[1], gq_after[2], gq_after[3], zero)
            add(grad_poses, row, frame, index, change_before)
            add(grad_poses, row, frame + 1, index, change_after)
            result = gv
        return result

    @ti.func
    def wall_blocks(parameters: ti.template(), i, v):
        """Whether a wall (not the floor) stops a velocity component at node number i of its axis."""
        return (i < wall and v < zero) or (i > parameters.grid_size - wall and v > zero)

    @ti.func
    def floor_slip(parameters: ti.template(), v):
        """Tangential velocity on the floor and its Coulomb factor, as (vec4: tangent, factor)."""
        tangent = vec3(v[0], zero, v[2])
        norm = ti.sqrt(tangent.dot(tangent) + real(norm_regularization))
        return vec4(v[0], zero, v[2], ti.max(one + parameters.ground_friction * v[1] / norm, zero))

    @ti.func
    def boundary(parameters: ti.template(), node, velocity):
        v = velocity
        if wall_blocks(parameters, node[0], v[0]):
            v[0] = real(zero)
        if node[1] < parameters.ground_nodes and v[1] < zero:
            if parameters.ground_friction >= sticky_friction:
                v = vec3(zero, zero, zero)
            else:
                factor = real(one)
                if parameters.ground_friction > zero:
                    slip = floor_slip(parameters, v)
                    factor = slip[3]
                v = vec3(factor * v[0], zero, factor * v[2])
        if node[1] > parameters.grid_size - wall and v[1] > zero:
            v[1] = real(zero)
        if wall_blocks(parameters, node[2], v[2]):
            v[2] = real(zero)
        return v

    @ti.func
    def boundary_adjoint(parameters: ti.template(), node, velocity, gradient):
        v = velocity
        g = gradient
        block_x = wall_blocks(parameters, node[0], v[0])
        if block_x:
            v[0] = real(zero)
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
            g[2] = real(zero)
        if node[1] > parameters.grid_size - wall and after[1] > zero:
            g[1] = real(zero)
        if floor:
            if parameters.ground_friction >= sticky_friction:
                g = vec3(zero, zero, zero)
            else:
                along = g[0] * v[0] + g[2] * v[2]
                g = vec3(slip[3] * g[0], zero, slip[3] * g[2])
                if parameters.ground_friction > zero and slip[3] > zero:
                    # factor = 1 + friction v_y / norm
                    norm = ti.sqrt(v[0] * v[0] + v[2] * v[2] + real(norm_regularization))
                    pull = parameters.ground_friction / norm
                    bend = -along * pull * v[1] / (norm * norm)
                    g = vec3(g[0] + bend * v[0], along * pull, g[2] + bend * v[2])
        if block_x:
            g[0] = real(zero)
        return g

    @ti.func
    def node_number(index, box: ti.template()):
        layer = box.size[1] * box.size[2]
        i = index // layer
        rest = index - i * layer
        j = rest // box.size[2]
        return box.origin + vec3i(i, j, rest - j * box.size[2])

    @ti.func
    def sum_rows(grid: ti.template(), first, distance, rows):
        total = grid[first]
        for r in range(1, rows):
            total = total + grid[first + r * distance]
        return total

    @ti.func
    def free_velocity(total, parameters: ti.template()):
        return vec3(total[0], total[1], total[2]) / total[3] + parameters.time_step * parameters.gravity

    @ti.func
    def after_contact(
        parameters: ti.template(),
        values: ti.template(),
        tools: ti.template(),
        count,
        poses: ti.template(),
        world,
        frame,
        node,
        velocity,
    ):
        """Velocity after contact with the first `count` tools."""
        v = velocity
        for m in range(count):
            v = contact(parameters, values, load_tool(tools, m), poses[world, frame, m], poses[world, frame + 1, m], node, v)
        return v

    @ti.func
    def update_node(
        total,
        parameters: ti.template(),
        values: ti.template(),
        tools: ti.template(),
        poses: ti.template(),
        world,
        frame,
        box: ti.template(),
        index,
    ):
        """Velocity of a node (and a zero) from its momentum and mass."""
        v = vec3(zero, zero, zero)
        if total[3] > real(smallest_mass):
            number = node_number(index, box)
            node = parameters.node_distance * ti.cast(number, real)
            v = free_velocity(total, parameters)
            v = after_contact(parameters, values, tools, parameters.tool_count, poses, world, frame, node, v)
            v = boundary(parameters, number, v)
        return vec4(v[0], v[1], v[2], zero)

    @ti.func
    def update_node_adjoint(
        total,
        incoming,
        parameters: ti.template(),
        values: ti.template(),
        tools: ti.template(),
        poses: ti.template(),
        world,
        frame,
        box: ti.template(),
        index,
        grad_poses: ti.template(),
        row,
    ):
        """Gradient of momentum and mass from that of the velocity; those of the poses are added to a row of `grad_poses`."""
        result = vec4(zero, zero, zero, zero)
        if total[3] > real(smallest_mass):
            g = vec3(incoming[0], incoming[1], incoming[2])
            number = node_number(index, box)
            node = parameters.node_distance * ti.cast(number, real)
            start = free_velocity(total, parameters)
            # from the last stage, the boundary, back to the first tool: each needs the velocity that it was given
            for r in range(parameters.tool_count + 1):
                m = parameters.tool_count - r
                v = after_contact(parameters, values, tools, m, poses, world, frame, node, start)
                if r == 0:
                    g = boundary_adjoint(parameters, number, v, g)
                else:
                    before, after = poses[world, frame, m], poses[world, frame + 1, m]
                    g = contact_adjoint(
                        parameters, values, load_tool(tools, m), before, after, node, v, g, grad_poses, row, frame, m
                    )
            inverse = one / total[3]
            raw = inverse * vec3(total[0], total[1], total[2])
            result = vec4(inverse * g[0], inverse * g[1], inverse * g[2], -inverse * g.dot(raw))
        return result

    return SimpleNamespace(sum_rows=sum_rows, update_node=update_node, update_node_adjoint=update_node_adjoint)
