"""Signed distances of the tools in their local frames, outward normals, and the derivative of the normals.

The entries of a tool's `size`, lengths: Sphere (radius); Capsule, RollingPin and Chopsticks (radius, height); Box (half extents,
rounding); Cylinder (radius, half height); Torus (major radius, tube radius). Chopsticks are the capsule nearer to a point:
`part_centre` is its centre.
"""

import functools
from types import SimpleNamespace
from typing import Any

from cpdeform.backends.scene_numbers import BOX, CAPSULE, CHOPSTICKS, CYLINDER, ROLLING_PIN, SPHERE, TORUS
from cpdeform.backends.taichi.kernels_types import build_types
from cpdeform.backends.taichi.runtime import ti

TOOL_KINDS = ("Sphere", "Capsule", "Box", "Cylinder", "Torus", "RollingPin", "Chopsticks")
"""The kinds of tools that the functions below know; the simulator refuses others."""


@functools.cache
def build_distance(real: Any) -> SimpleNamespace:
    """Taichi functions of signed distances and rotations for one scalar type."""
    types = build_types(real)
    vec3, vec4 = types.vec3, types.vec4
    zero, half, one, two = 0.0, 0.5, 1.0, 2.0
    # PlasticineLab's length: finite gradient at zero
    length_regularization = 1e-8

    @ti.func
    def length(v):
        return ti.sqrt(v.dot(v) + real(length_regularization))

    @ti.func
    def box_offset(p, b):
        """Vector from the box's nearest point to p; zero inside."""
        return p - ti.min(ti.max(p, -b), b)

    @ti.func
    def largest_axis(q):
        axis = 0
        if q[1] > q[0]:
            axis = 1
        if q[2] > ti.max(q[0], q[1]):
            axis = 2
        return axis

    @ti.func
    def sign(x):
        result = real(one)
        if x < zero:
            result = real(-one)
        return result

    @ti.func
    def radial_unit(p):
        """Unit vector away from the y axis, and the distance from it."""
        r = ti.sqrt(p[0] * p[0] + p[2] * p[2] + real(length_regularization))
        return vec3(p[0] / r, zero, p[2] / r), r

    @ti.func
    def part_centre(kind, size, gap, p):
        """Centre of the part of a tool that is nearest to the local point p; zero but for chopsticks."""
        result = vec3(zero, zero, zero)
        if kind == CHOPSTICKS:
            result = vec3(half * gap * sign(p[0]), -half * size[1], zero)
        return result

    @ti.func
    def distance_and_normal(kind, size, p):
        """Signed distance and outward normal at the local point p, as (normal, distance)."""
        distance = real(zero)
        normal = vec3(zero, one, zero)
        if kind == SPHERE:
            r = length(p)
            distance = r - size[0]
            normal = p / r
        if kind == CAPSULE or kind == ROLLING_PIN or kind == CHOPSTICKS:
            h = half * size[1]
            q = vec3(p[0], p[1] - ti.min(ti.max(p[1], -h), h), p[2])
            r = length(q)
            distance = r - size[0]
            normal = q / r
        if kind == BOX:
            b = vec3(size[0], size[1], size[2])
            q = ti.abs(p) - b
            largest = q.max()
            if largest > zero:
                o = box_offset(p, b)
                r = ti.sqrt(o.dot(o))
                distance = r - size[3]
                normal = o / r
            else:
                distance = largest - size[3]
                axis = largest_axis(q)
                normal = vec3(zero, zero, zero)
                for a in ti.static(range(3)):
                    if a == axis:
                        normal[a] = sign(p[a])
        if kind == CYLINDER:
            u, r = radial_unit(p)
            side = r - size[0]
            top = ti.abs(p[1]) - size[1]
            up = vec3(zero, sign(p[1]), zero)
            if side > zero and top > zero:
                distance = ti.sqrt(side * side + top * top)
                normal = (side / distance) * u + (top / distance) * up
            else:
                distance = ti.max(side, top)
                normal = up
                if side > top:
                    normal = u
        if kind == TORUS:
            u, r = radial_unit(p)
            q = (r - size[0]) * u + vec3(zero, p[1], zero)
            s = length(q)
            distance = s - size[1]
            normal = q / s
        return normal, distance

    @ti.func
    def project(g, normal):
        return g - g.dot(normal) * normal

    @ti.func
    def normal_adjoint(kind, size, p, g):
        """(d normal / d p)^T g; the derivative is a symmetric matrix, the distance's Hessian."""
        result = vec3(zero, zero, zero)
        if kind == SPHERE:
            r = length(p)
            result = project(g, p / r) / r
        if kind == CAPSULE or kind == ROLLING_PIN or kind == CHOPSTICKS:
            h = half * size[1]
            q = vec3(p[0], p[1] - ti.min(ti.max(p[1], -h), h), p[2])
            r = length(q)
            result = project(g, q / r) / r
            if ti.abs(p[1]) < h:
                result[1] = zero
        if kind == BOX:
            b = vec3(size[0], size[1], size[2])
            q = ti.abs(p) - b
            if q.max() > zero:
                o = box_offset(p, b)
                r = ti.sqrt(o.dot(o))
                result = project(g, o / r) / r
                for axis in ti.static(range(3)):
                    if q[axis] <= zero:
                        result[axis] = zero
        if kind == CYLINDER:
            u, r = radial_unit(p)
            side = r - size[0]
            top = ti.abs(p[1]) - size[1]
            around = vec3(-u[2], zero, u[0])
            turn = g.dot(around) / r * around
            if side > zero and top > zero:
                d = ti.sqrt(side * side + top * top)
                normal = (side / d) * u + vec3(zero, sign(p[1]) * top / d, zero)
                across = project(vec3(zero, one, zero), normal)
                across = across / ti.max(ti.sqrt(across.dot(across)), real(1e-6))
                result = (side / d) * turn + g.dot(across) / d * across
            elif side > top:
                result = turn
        if kind == TORUS:
            u, r = radial_unit(p)
            q = (r - size[0]) * u + vec3(zero, p[1], zero)
            s = length(q)
            normal = q / s
            around = vec3(-u[2], zero, u[0])
            planar = g - g.dot(around) * around
            result = project(planar, normal) / s + ((r - size[0]) / (r * s)) * g.dot(around) * around
        return result

    @ti.func
    def pose_position(pose):
        return vec3(pose[0], pose[1], pose[2])

    @ti.func
    def pose_axis(pose):
        """Vector part of the pose's quaternion; its scalar part is pose[3]."""
        return vec3(pose[4], pose[5], pose[6])

    @ti.func
    def rotate(w, u, v):
        """Rotate v by the unit quaternion (w, u); by its inverse with (w, -u)."""
        c = u.cross(v)
        return v + two * (w * c + u.cross(c))

    @ti.func
    def rotate_adjoint(w, u, v, g):
        """Gradients with respect to the quaternion (vec4, wxyz)."""
        c = u.cross(v)
        gc = g.cross(u)
        gu = two * (w * v.cross(g) + c.cross(g) + v.cross(gc))
        return vec4(two * g.dot(c), gu[0], gu[1], gu[2])

    return SimpleNamespace(
        part_centre=part_centre,
        distance_and_normal=distance_and_normal,
        normal_adjoint=normal_adjoint,
        pose_position=pose_position,
        pose_axis=pose_axis,
        rotate=rotate,
        rotate_adjoint=rotate_adjoint,
    )
