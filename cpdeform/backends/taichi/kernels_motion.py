"""Motion of the tools under actions, and its adjoint: one thread follows one tool through all substeps."""

import functools
from types import SimpleNamespace
from typing import Any

from cpdeform.backends.scene_numbers import CHOPSTICKS, ROLLING_PIN
from cpdeform.backends.taichi.kernels_distance import build_distance
from cpdeform.backends.taichi.kernels_types import build_types
from cpdeform.backends.taichi.runtime import ti


@functools.cache
def build_motion(real: Any) -> SimpleNamespace:
    """Taichi kernels of the tools' motion for one scalar type."""
    types, geometry = build_types(real), build_distance(real)
    vec3, vec4, vec8, array, load_tool = types.vec3, types.vec4, types.vec8, types.array, types.load_tool
    rotate, rotate_adjoint = geometry.rotate, geometry.rotate_adjoint
    zero, half, one = 0.0, 0.5, 1.0
    small_angle_squared = 1e-6
    # PlasticineLab's constants: how far a rolling pin rolls a radian, and the least gap between chopsticks, length units
    rolling_radius = 0.03
    smallest_gap = 0.06

    @ti.func
    def half_sine_ratio(angle_squared):
        """sin(angle/2)/angle, finite at zero."""
        result = half - angle_squared / 48.0
        if angle_squared > real(small_angle_squared):
            angle = ti.sqrt(angle_squared)
            result = ti.sin(half * angle) / angle
        return result

    @ti.func
    def half_sine_ratio_slope(angle_squared):
        """Derivative of `half_sine_ratio` with respect to the squared angle."""
        result = real(-1.0 / 48.0) + angle_squared / 1920.0
        if angle_squared > real(small_angle_squared):
            angle = ti.sqrt(angle_squared)
            result = (half * half * ti.cos(half * angle) / angle - half * ti.sin(half * angle) / angle_squared) / angle
        return result

    @ti.func
    def multiply(a, b):
        av, bv = vec3(a[1], a[2], a[3]), vec3(b[1], b[2], b[3])
        v = a[0] * bv + b[0] * av + av.cross(bv)
        return vec4(a[0] * b[0] - av.dot(bv), v[0], v[1], v[2])

    @ti.func
    def conjugate(a):
        return vec4(a[0], -a[1], -a[2], -a[3])

    @ti.func
    def turn(w):
        """Unit quaternion of a rotation vector."""
        angle_squared = w.dot(w)
        ratio = half_sine_ratio(angle_squared)
        return vec4(ti.cos(half * ti.sqrt(angle_squared)), ratio * w[0], ratio * w[1], ratio * w[2])

    @ti.func
    def turn_adjoint(w, g):
        angle_squared = w.dot(w)
        ratio = half_sine_ratio(angle_squared)
        gv = vec3(g[1], g[2], g[3])
        # d cos(angle/2) / d w = -1/2 sin(angle/2)/angle w
        along = 2.0 * half_sine_ratio_slope(angle_squared) * gv.dot(w) - half * ratio * g[0]
        return ratio * gv + along * w

    @ti.func
    def motion(tool, actions: ti.template(), world, step):
        """Motion of one substep: the tool's action components times their scales."""
        result = ti.Vector.zero(real, 7)
        for a in ti.static(range(7)):
            if a < tool.action_size:
                result[a] = tool.scale[a] * actions[world, step, tool.action_offset + a]
        return result

    @ti.func
    def rolling_direction(q):
        """Vertical cross the rod's downward axis: where a rolling pin goes, times `rolling_radius` a radian."""
        axis = rotate(q[0], vec3(q[1], q[2], q[3]), vec3(zero, -one, zero))
        return real(rolling_radius) * vec3(axis[2], zero, -axis[0])

    @ti.func
    def displacement(tool, w, q):
        result = vec3(w[0], w[1], w[2])
        if tool.kind == ROLLING_PIN:
            result = w[0] * rolling_direction(q)
            result[1] = w[2]
        return result

    @ti.func
    def turns(tool, w):
        """Rotation vectors of a substep, as (in the world's frame, in the tool's own frame)."""
        outer = vec3(zero, zero, zero)
        inner = vec3(zero, zero, zero)
        if tool.kind == ROLLING_PIN:
            outer = vec3(zero, -w[1], zero)
            inner = vec3(zero, w[0], zero)
        elif tool.kind == CHOPSTICKS:
            inner = vec3(w[3], w[4], w[5])
        else:
            outer = vec3(w[3], w[4], w[5])
        return outer, inner

    @ti.kernel
    def move_tools(actions: array(real, 3), tools: array(types.tool), substeps: ti.i32, tool_count: ti.i32, poses: array(vec8, 3)):
        """Fill frames 1.. of `poses` (worlds, steps * substeps + 1, tools) from frame 0."""
        for item in range(poses.shape[0] * tool_count):
            world, m = item // tool_count, item % tool_count
            tool = load_tool(tools, m)
            pose = poses[world, 0, m]
            for frame in range(poses.shape[1] - 1):
                if tool.action_size > 0:
                    w = motion(tool, actions, world, frame // substeps)
                    q = vec4(pose[3], pose[4], pose[5], pose[6])
                    p = vec3(pose[0], pose[1], pose[2]) + displacement(tool, w, q)
                    p = ti.min(ti.max(p, tool.lower), tool.upper)
                    if tool.action_size > 3 or tool.kind == ROLLING_PIN:
                        outer, inner = turns(tool, w)
                        q = multiply(turn(outer), multiply(q, turn(inner)))
                    gap = pose[7]
                    if tool.kind == CHOPSTICKS:
                        gap = ti.max(gap - w[6], real(smallest_gap))
                    pose = vec8(p[0], p[1], p[2], q[0], q[1], q[2], q[3], gap)
                poses[world, frame + 1, m] = pose

    @ti.func
    def motion_adjoint(tool, w, before, g):
        """Gradients with respect to a substep's motion and to the pose before it, from that of the pose after it."""
        gw = ti.Vector.zero(real, 7)
        gp = vec3(g[0], g[1], g[2])
        gq = vec4(g[3], g[4], g[5], g[6])
        q = vec4(before[3], before[4], before[5], before[6])
        p = vec3(before[0], before[1], before[2]) + displacement(tool, w, q)
        for a in ti.static(range(3)):
            if p[a] < tool.lower[a] or p[a] > tool.upper[a]:
                gp[a] = zero
        gap = g[7]
        if tool.kind == CHOPSTICKS:
            if before[7] - w[6] < real(smallest_gap):
                gap = zero
            gw[6] = -gap
        if tool.action_size > 3 or tool.kind == ROLLING_PIN:
            outer, inner = turns(tool, w)
            own = turn(inner)
            go = turn_adjoint(outer, multiply(gq, conjugate(multiply(q, own))))
            rest = multiply(conjugate(turn(outer)), gq)
            gi = turn_adjoint(inner, multiply(conjugate(q), rest))
            gq = multiply(rest, conjugate(own))
            if tool.kind == ROLLING_PIN:
                gw[0] = gi[1]
                gw[1] = -go[1]
            elif tool.kind == CHOPSTICKS:
                for a in ti.static(range(3)):
                    gw[3 + a] = gi[a]
            else:
                for a in ti.static(range(3)):
                    gw[3 + a] = go[a]
        if tool.kind == ROLLING_PIN:
            gw[0] = gw[0] + gp.dot(rolling_direction(q))
            gw[2] = gp[1]
            ga = (real(rolling_radius) * w[0]) * vec3(-gp[2], zero, gp[0])
            gq += rotate_adjoint(q[0], vec3(q[1], q[2], q[3]), vec3(zero, -one, zero), ga)
        else:
            for a in ti.static(range(3)):
                gw[a] = gp[a]
        return gw, vec8(gp[0], gp[1], gp[2], gq[0], gq[1], gq[2], gq[3], gap)

    @ti.kernel
    def move_tools_adjoint(
        actions: array(real, 3),
        tools: array(types.tool),
        substeps: ti.i32,
        tool_count: ti.i32,
        poses: array(vec8, 3),
        grad_poses: array(vec8, 3),
        grad_actions: array(real, 3),
        grad_start: array(vec8, 2),
    ):
        """Pull gradients of all frames back to the actions and to frame 0."""
        for item in range(poses.shape[0] * tool_count):
            world, m = item // tool_count, item % tool_count
            tool = load_tool(tools, m)
            frames = poses.shape[1]
            g = grad_poses[world, frames - 1, m]
            for r in range(frames - 1):
                frame = frames - 2 - r
                if tool.action_size > 0:
                    step = frame // substeps
                    gw, gb = motion_adjoint(tool, motion(tool, actions, world, step), poses[world, frame, m], g)
                    g = gb
                    for a in ti.static(range(7)):
                        if a < tool.action_size:
                            o = tool.action_offset + a
                            grad_actions[world, step, o] = grad_actions[world, step, o] + tool.scale[a] * gw[a]
                g = g + grad_poses[world, frame, m]
            grad_start[world, m] = g

    return SimpleNamespace(move_tools=move_tools, move_tools_adjoint=move_tools_adjoint)
