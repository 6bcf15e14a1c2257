"""Motion of the manipulators under actions, and its adjoint: one thread follows one tool through all substeps."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from cpdeform.backends.warp.kernels_types import KERNEL_OPTIONS, build_types


@functools.cache
def build_motion(real: Any) -> SimpleNamespace:
    """Warp kernels of the tools' motion for one scalar type."""
    types = build_types(real)
    vec3, vec4, vec8, Tool = types.vec3, types.vec4, types.vec8, types.Tool
    zero, half, one = real(0.0), real(0.5), real(1.0)
    small_angle_squared = real(1e-6)

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
    def linear_motion(tool: Tool, actions: wp.array3d(dtype=real), world: int, step: int):
        o = tool.action_offset
        result = vec3(zero, zero, zero)
        if tool.action_size >= 3:
            for a in range(3):
                result[a] = tool.scale[a] * actions[world, step, o + a]
        return result

    @wp.func
    def angular_motion(tool: Tool, actions: wp.array3d(dtype=real), world: int, step: int):
        o = tool.action_offset + 3
        result = vec3(zero, zero, zero)
        if tool.action_size >= 6:
            for a in range(3):
                result[a] = tool.scale[a + 3] * actions[world, step, o + a]
        return result

    @wp.kernel(**KERNEL_OPTIONS)
    def move_tools(actions: wp.array3d(dtype=real), tools: wp.array(dtype=Tool), substeps: int, poses: wp.array3d(dtype=vec8)):
        """Fill frames 1.. of `poses` (worlds, steps * substeps + 1, tools) from frame 0."""
        world, m = wp.tid()
        tool = tools[m]
        pose = poses[world, 0, m]
        for frame in range(poses.shape[1] - 1):
            step = frame // substeps
            p = vec3(pose[0], pose[1], pose[2]) + linear_motion(tool, actions, world, step)
            if tool.action_size > 0:
                p = wp.min(wp.max(p, tool.lower), tool.upper)
            q = vec4(pose[3], pose[4], pose[5], pose[6])
            if tool.action_size >= 6:
                q = multiply(turn(angular_motion(tool, actions, world, step)), q)
            pose = vec8(p[0], p[1], p[2], q[0], q[1], q[2], q[3], pose[7])
            poses[world, frame + 1, m] = pose

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
            step = frame // substeps
            before = poses[world, frame, m]
            gp = vec3(g[0], g[1], g[2])
            if tool.action_size > 0:
                p = vec3(before[0], before[1], before[2]) + linear_motion(tool, actions, world, step)
                for a in range(3):
                    if p[a] < tool.lower[a] or p[a] > tool.upper[a]:
                        gp[a] = zero
                    grad_actions[world, step, o + a] = grad_actions[world, step, o + a] + tool.scale[a] * gp[a]
            gq = vec4(g[3], g[4], g[5], g[6])
            if tool.action_size >= 6:
                w = angular_motion(tool, actions, world, step)
                q = vec4(before[3], before[4], before[5], before[6])
                gw = turn_adjoint(w, multiply(gq, conjugate(q)))
                gq = multiply(conjugate(turn(w)), gq)
                for a in range(3):
                    grad_actions[world, step, o + 3 + a] = grad_actions[world, step, o + 3 + a] + tool.scale[a + 3] * gw[a]
            own = grad_poses[world, frame, m]
            g = vec8(gp[0], gp[1], gp[2], gq[0], gq[1], gq[2], gq[3], g[7]) + own
        grad_start[world, m] = g

    return SimpleNamespace(move_tools=move_tools, move_tools_adjoint=move_tools_adjoint)
