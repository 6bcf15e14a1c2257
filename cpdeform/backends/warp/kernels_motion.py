"""Motion of the tools under actions, and its adjoint: one thread follows one tool through all substeps."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from cpdeform.backends.scene_numbers import CHOPSTICKS, ROLLING_PIN
from cpdeform.backends.warp.kernels_distance import build_distance
from cpdeform.backends.warp.kernels_types import KERNEL_OPTIONS, build_types


@functools.cache
def build_motion(real: Any) -> SimpleNamespace:
    """Warp kernels of the tools' motion for one scalar type."""
    types, geometry = build_types(real), build_distance(real)
    vec3, vec4, vec7, vec8, Tool = types.vec3, types.vec4, types.vec7, types.vec8, types.Tool
    rotate, rotate_adjoint = geometry.rotate, geometry.rotate_adjoint
    zero, half, one = real(0.0), real(0.5), real(1.0)
    small_angle_squared = real(1e-6)
    # PlasticineLab's constants: how far a rolling pin rolls a radian, and the least gap between chopsticks, length units
    rolling_radius = real(0.03)
    smallest_gap = real(0.06)

    @wp.func
    def half_sine_ratio(angle_squared: real):
        """sin(angle/2)/angle, finite at zero."""
        result = half - angle_squared / real(48.0)
        if angle_squared > small_angle_squared:
            angle = wp.sqrt(angle_squared)
            result = wp.sin(half * angle) / angle
        return result

    @wp.func
    def half_sine_ratio_slope(angle_squared: real):
        """Derivative of `half_sine_ratio` with respect to the squared angle."""
        result = -one / real(48.0) + angle_squared / real(1920.0)
        if angle_squared > small_angle_squared:
            angle = wp.sqrt(angle_squared)
            result = (half * half * wp.cos(half * angle) / angle - half * wp.sin(half * angle) / angle_squared) / angle
        return result

    @wp.func
    def multiply(a: vec4, b: vec4):
        av, bv = vec3(a[1], a[2], a[3]), vec3(b[1], b[2], b[3])
        v = a[0] * bv + b[0] * av + wp.cross(av, bv)
        return vec4(a[0] * b[0] - wp.dot(av, bv), v[0], v[1], v[2])

    @wp.func
    def conjugate(a: vec4):
        return vec4(a[0], -a[1], -a[2], -a[3])

    @wp.func
    def turn(w: vec3):
        """Unit quaternion of a rotation vector."""
        angle_squared = wp.dot(w, w)
        ratio = half_sine_ratio(angle_squared)
        return vec4(wp.cos(half * wp.sqrt(angle_squared)), ratio * w[0], ratio * w[1], ratio * w[2])

    @wp.func
    def turn_adjoint(w: vec3, g: vec4):
        angle_squared = wp.dot(w, w)
        ratio = half_sine_ratio(angle_squared)
        gv = vec3(g[1], g[2], g[3])
        # d cos(angle/2) / d w = -1/2 sin(angle/2)/angle w
        along = real(2.0) * half_sine_ratio_slope(angle_squared) * wp.dot(gv, w) - half * ratio * g[0]
        return ratio * gv + along * w

    @wp.func
    def motion(tool: Tool, actions: wp.array3d(dtype=real), world: int, step: int):
        """Motion of one substep: the tool's action components times their scales."""
        result = vec7()
        for a in range(tool.action_size):
            result[a] = tool.scale[a] * actions[world, step, tool.action_offset + a]
        return result

    @wp.func
    def rolling_direction(q: vec4):
        """Vertical cross the rod's downward axis: where a rolling pin goes, times `rolling_radius` a radian."""
        axis = rotate(q[0], vec3(q[1], q[2], q[3]), vec3(zero, -one, zero))
        return rolling_radius * vec3(axis[2], zero, -axis[0])

    @wp.func
    def displacement(tool: Tool, w: vec7, q: vec4):
        result = vec3(w[0], w[1], w[2])
        if tool.kind == wp.static(ROLLING_PIN):
            result = w[0] * rolling_direction(q)
            result[1] = w[2]
        return result

    @wp.func
    def turns(tool: Tool, w: vec7):
        """Rotation vectors of a substep, as (in the world's frame, in the tool's own frame)."""
        outer = vec3(zero, zero, zero)
        inner = vec3(zero, zero, zero)
        if tool.kind == wp.static(ROLLING_PIN):
            outer = vec3(zero, -w[1], zero)
            inner = vec3(zero, w[0], zero)
        elif tool.kind == wp.static(CHOPSTICKS):
            inner = vec3(w[3], w[4], w[5])
        else:
            outer = vec3(w[3], w[4], w[5])
        return outer, inner

    @wp.kernel(**KERNEL_OPTIONS)
    def move_tools(actions: wp.array3d(dtype=real), tools: wp.array(dtype=Tool), substeps: int, poses: wp.array3d(dtype=vec8)):
        """Fill frames 1.. of `poses` (worlds, steps * substeps + 1, tools) from frame 0."""
        world, m = wp.tid()
        tool = tools[m]
        pose = poses[world, 0, m]
        for frame in range(poses.shape[1] - 1):
            if tool.action_size > 0:
                w = motion(tool, actions, world, frame // substeps)
                q = vec4(pose[3], pose[4], pose[5], pose[6])
                p = vec3(pose[0], pose[1], pose[2]) + displacement(tool, w, q)
                p = wp.min(wp.max(p, tool.lower), tool.upper)
                if tool.action_size > 3 or tool.kind == wp.static(ROLLING_PIN):
                    outer, inner = turns(tool, w)
                    q = multiply(turn(outer), multiply(q, turn(inner)))
                gap = pose[7]
                if tool.kind == wp.static(CHOPSTICKS):
                    gap = wp.max(gap - w[6], smallest_gap)
                pose = vec8(p[0], p[1], p[2], q[0], q[1], q[2], q[3], gap)
            poses[world, frame + 1, m] = pose

    @wp.func
    def motion_adjoint(tool: Tool, w: vec7, before: vec8, g: vec8):
        """Gradients with respect to a substep's motion and to the pose before it, from that of the pose after it."""
        gw = vec7()
        gp = vec3(g[0], g[1], g[2])
        gq = vec4(g[3], g[4], g[5], g[6])
        q = vec4(before[3], before[4], before[5], before[6])
        p = vec3(before[0], before[1], before[2]) + displacement(tool, w, q)
        for a in range(3):
            if p[a] < tool.lower[a] or p[a] > tool.upper[a]:
                gp[a] = zero
        gap = g[7]
        if tool.kind == wp.static(CHOPSTICKS):
            if before[7] - w[6] < smallest_gap:
                gap = zero
            gw[6] = -gap
        if tool.action_size > 3 or tool.kind == wp.static(ROLLING_PIN):
            outer, inner = turns(tool, w)
            own = turn(inner)
            go = turn_adjoint(outer, multiply(gq, conjugate(multiply(q, own))))
            rest = multiply(conjugate(turn(outer)), gq)
            gi = turn_adjoint(inner, multiply(conjugate(q), rest))
            gq = multiply(rest, conjugate(own))
            if tool.kind == wp.static(ROLLING_PIN):
                gw[0] = gi[1]
                gw[1] = -go[1]
            elif tool.kind == wp.static(CHOPSTICKS):
                for a in range(3):
                    gw[3 + a] = gi[a]
            else:
                for a in range(3):
                    gw[3 + a] = go[a]
        if tool.kind == wp.static(ROLLING_PIN):
            gw[0] = gw[0] + wp.dot(gp, rolling_direction(q))
            gw[2] = gp[1]
            ga = (rolling_radius * w[0]) * vec3(-gp[2], zero, gp[0])
            gq += rotate_adjoint(q[0], vec3(q[1], q[2], q[3]), vec3(zero, -one, zero), ga)
        else:
            for a in range(3):
                gw[a] = gp[a]
        return gw, vec8(gp[0], gp[1], gp[2], gq[0], gq[1], gq[2], gq[3], gap)

    @wp.kernel(**KERNEL_OPTIONS)
    def move_tools_adjoint(
        actions: wp.array3d(dtype=real),
        tools: wp.array(dtype=Tool),
        substeps: int,
        poses: wp.array3d(dtype=vec8),
        grad_poses: wp.array3d(dtype=vec8),
        grad_actions: wp.array3d(dtype=real),
        grad_start: wp.array2d(dtype=vec8),
    ):
        """Pull gradients of all frames back to the actions and to frame 0."""
        world, m = wp.tid()
        tool = tools[m]
        o = tool.action_offset
        frames = poses.shape[1]
        g = grad_poses[world, frames - 1, m]
        for r in range(frames - 1):
            frame = frames - 2 - r
            if tool.action_size > 0:
                step = frame // substeps
                gw, gb = motion_adjoint(tool, motion(tool, actions, world, step), poses[world, frame, m], g)
                g = gb
                for a in range(tool.action_size):
                    grad_actions[world, step, o + a] = grad_actions[world, step, o + a] + tool.scale[a] * gw[a]
            g = g + grad_poses[world, frame, m]
        grad_start[world, m] = g

    return SimpleNamespace(move_tools=move_tools, move_tools_adjoint=move_tools_adjoint)
