"""Signed distances of the tools in their local frames, outward normals, and how these change.

The entries of `Tool.size`, lengths: Sphere (radius); Capsule, RollingPin and Chopsticks (radius, height); Box (half extents,
rounding); Cylinder (radius, half height); Torus (major radius, tube radius); Mesh (distance between nodes, numbers of nodes;
its numbers are in `Parameters.grids` from `grid_first` on). Chopsticks are the capsule nearer to a point: `part_centre` is its
centre.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from cpdeform.backends.scene_numbers import BOX, CAPSULE, CHOPSTICKS, CYLINDER, MESH, ROLLING_PIN, SPHERE, TORUS
from cpdeform.backends.warp.kernels_types import build_types

TOOL_KINDS = ("Sphere", "Capsule", "Box", "Cylinder", "Torus", "RollingPin", "Chopsticks", "Mesh")
"""The kinds of tools that the functions below know; the simulator refuses others."""


@functools.cache
def build_distance(real: Any) -> SimpleNamespace:
    """Warp functions of signed distances and rotations for one scalar type."""
    types = build_types(real)
    vec3, vec4, vec8 = types.vec3, types.vec4, types.vec8
    zero, half, three_quarters, one, two = real(0.0), real(0.5), real(0.75), real(1.0), real(2.0)
    # PlasticineLab's length: finite gradient at zero
    length_regularization = real(1e-8)

    @wp.func
    def length(v: vec3):
        return wp.sqrt(wp.dot(v, v) + length_regularization)

    @wp.func
    def box_offset(p: vec3, b: vec3):
        """Vector from the box's nearest point to p; zero inside."""
        return p - wp.min(wp.max(p, -b), b)

    @wp.func
    def largest_axis(q: vec3):
        axis = int(0)
        if q[1] > q[axis]:
            axis = int(1)
        if q[2] > q[axis]:
            axis = int(2)
        return axis

    @wp.func
    def sign(x: real):
        result = one
        if x < zero:
            result = -one
        return result

    @wp.func
    def radial_unit(p: vec3):
        """Unit vector away from the y axis, and the distance from it."""
        r = wp.sqrt(p[0] * p[0] + p[2] * p[2] + length_regularization)
        return vec3(p[0] / r, zero, p[2] / r), r

    @wp.func
    def part_centre(kind: int, size: vec4, gap: real, p: vec3):
        """Centre of the part of a tool that is nearest to the local point p; zero but for chopsticks."""
        result = vec3(zero, zero, zero)
        if kind == wp.static(CHOPSTICKS):
            result = vec3(half * gap * sign(p[0]), -half * size[1], zero)
        return result

    @wp.func
    def project(g: vec3, normal: vec3):
        return g - wp.dot(g, normal) * normal

    @wp.func
    def spline(f: real):
        """Weights of a quadratic B-spline at three nodes, `f` from the middle one, and their derivatives."""
        weights = vec3(half * (half - f) * (half - f), three_quarters - f * f, half * (half + f) * (half + f))
        return weights, vec3(f - half, -two * f, f + half)

    @wp.func
    def mesh_place(along: real, size: real, count: real):
        """Where a coordinate lies in the grid: clipped, its nearest node, and how far it is beyond, in nodes."""
        u = along / size + half * (count - one)
        inside = wp.min(wp.max(u, one), count - two)
        base = wp.min(int(inside + half), int(count) - 2)
        return inside - real(base), base, u - inside

    @wp.func
    def grid_vector(grids: wp.array(dtype=real), first: int):
        return vec3(grids[first], grids[first + 1], grids[first + 2])

    @wp.func
    def triangles_surface(grids: wp.array(dtype=real), lists: int, found: int, p: vec3, g: vec3):
        """As `surface`, of the nearest of the triangles in the list at `found`; see `SharpCells.kernel_numbers`."""
        least = real(1e30)
        way = vec3(zero, zero, zero)  # from the nearest place
        mean = vec3(zero, one, zero)  # the mean normal there
        edge = vec3(zero, zero, zero)  # along its edge; zero on a face or at a corner
        face = int(0)
        for n in range(int(grids[found])):
            t = lists + int(grids[found + 1 + n])
            normal = grid_vector(grids, t + 9)
            inside = int(1)
            for i in range(3):
                corner = grid_vector(grids, t + 3 * i)
                along = grid_vector(grids, t + 3 * ((i + 1) % 3)) - corner
                if wp.dot(wp.cross(normal, along), p - corner) < zero:
                    inside = int(0)
            if inside == 1:
                height = wp.dot(p - grid_vector(grids, t), normal)
                if height * height < least:
                    least = height * height
                    way = height * normal
                    mean = normal
                    face = int(1)
            else:
                for i in range(3):
                    corner = grid_vector(grids, t + 3 * i)
                    along = grid_vector(grids, t + 3 * ((i + 1) % 3)) - corner
                    share = wp.min(wp.max(wp.dot(p - corner, along) / wp.dot(along, along), zero), one)
                    aside = p - corner - share * along
                    if wp.dot(aside, aside) < least:
                        least = wp.dot(aside, aside)
                        way = aside
                        face = int(0)
                        edge = vec3(zero, zero, zero)
                        if share <= zero:
                            mean = grid_vector(grids, t + 21 + 3 * i)
                        elif share >= one:
                            mean = grid_vector(grids, t + 21 + 3 * ((i + 1) % 3))
                        else:
                            mean = grid_vector(grids, t + 12 + 3 * i)
                            edge = along / wp.sqrt(wp.dot(along, along))
        distance = wp.dot(way, mean)
        result = mean
        bend = vec3(zero, zero, zero)
        if face == 0:
            distance = wp.sqrt(least) * sign(distance)
            if wp.abs(distance) >= real(1e-7):
                result = way / distance
                bend = project(g - wp.dot(g, edge) * edge, result) / distance
        return result, distance, bend, one

    @wp.func
    def spline_surface(grids: wp.array(dtype=real), first: int, size: vec4, p: vec3, g: vec3):
        """As `surface`: the quadratic B-spline of a mesh's distance; beyond the grid the way there is added."""
        fx, bx, ox = mesh_place(p[0], size[0], size[1])
        fy, by, oy = mesh_place(p[1], size[0], size[2])
        fz, bz, oz = mesh_place(p[2], size[0], size[3])
        wx, dx = spline(fx)
        wy, dy = spline(fy)
        wz, dz = spline(fz)
        curve = vec3(one, -two, one)
        distance = zero
        gradient = vec3(zero, zero, zero)
        straight = vec3(zero, zero, zero)
        mixed = vec3(zero, zero, zero)
        for n in range(27):
            i = n // 9
            j = (n // 3) % 3
            k = n % 3
            node = ((bx + i - 1) * int(size[2]) + by + j - 1) * int(size[3]) + bz + k - 1
            c = grids[first + node]
            xy, xz, yz = dx[i] * dy[j] * wz[k], dx[i] * wy[j] * dz[k], wx[i] * dy[j] * dz[k]
            distance += c * wx[i] * wy[j] * wz[k]
            gradient += c * vec3(dx[i] * wy[j] * wz[k], wx[i] * dy[j] * wz[k], wx[i] * wy[j] * dz[k])
            straight += c * vec3(curve[i] * wy[j] * wz[k], wx[i] * curve[j] * wz[k], wx[i] * wy[j] * curve[k])
            mixed += c * vec3(xy, xz, yz)
        steep = wp.max(wp.sqrt(wp.dot(gradient, gradient)) / size[0], real(1e-3))
        normal = gradient / (steep * size[0])
        distance += wp.sqrt(ox * ox + oy * oy + oz * oz) * size[0]
        # The transposed derivative of the normal: an interpolated distance's Hessian does not vanish along the normal.
        a = project(g, normal)
        bend = vec3(
            straight[0] * a[0] + mixed[0] * a[1] + mixed[1] * a[2],
            mixed[0] * a[0] + straight[1] * a[1] + mixed[2] * a[2],
            mixed[1] * a[0] + mixed[2] * a[1] + straight[2] * a[2],
        )
        return normal, distance, bend / (steep * size[0] * size[0]), steep

    @wp.func
    def mesh_surface(grids: wp.array(dtype=real), first: int, size: vec4, p: vec3, g: vec3):
        """As `surface`, of a mesh: that of triangles at sharp edges, else that of `spline_surface`."""
        fx, bx, ox = mesh_place(p[0], size[0], size[1])
        fy, by, oy = mesh_place(p[1], size[0], size[2])
        fz, bz, oz = mesh_place(p[2], size[0], size[3])
        nodes = int(size[1]) * int(size[2]) * int(size[3])
        found = int(grids[first + nodes + (bx * int(size[2]) + by) * int(size[3]) + bz])
        distance = zero
        normal = vec3(zero, one, zero)
        bend = vec3(zero, zero, zero)
        steepness = one
        if found > 0:
            lists = first + 2 * nodes
            normal, distance, bend, steepness = triangles_surface(grids, lists, lists + found, p, g)
        else:
            normal, distance, bend, steepness = spline_surface(grids, first, size, p, g)
        return normal, distance, bend, steepness

    @wp.func
    def surface(grids: wp.array(dtype=real), first: int, kind: int, size: vec4, p: vec3, g: vec3):
        """Normal and signed distance at the local point p, and how the normal changes along g: (normal, distance, bend, steepness).

        All that kernels know of a kind. The derivative of a distance's gradient is a symmetric matrix, the distance's Hessian, so
        that `bend` is the adjoint of the normal, too; where it is not used, the compiler leaves it out. The steepness is the
        length of the distance's gradient, which is not 1 near the edges of a mesh's interpolated distance.
        """
        distance = zero
        normal = vec3(zero, one, zero)
        bend = vec3(zero, zero, zero)
        steepness = one
        if kind == wp.static(SPHERE):
            r = length(p)
            distance = r - size[0]
            normal = p / r
            bend = project(g, normal) / r
        if kind == wp.static(CAPSULE) or kind == wp.static(ROLLING_PIN) or kind == wp.static(CHOPSTICKS):
            h = half * size[1]
            q = vec3(p[0], p[1] - wp.min(wp.max(p[1], -h), h), p[2])
            moved = g
            if wp.abs(p[1]) < h:
                moved = vec3(g[0], zero, g[2])
            r = length(q)
            distance = r - size[0]
            normal = q / r
            bend = project(moved, normal) / r
        if kind == wp.static(BOX):
            b = vec3(size[0], size[1], size[2])
            q = wp.abs(p) - b
            axis = largest_axis(q)
            if q[axis] > zero:
                o = box_offset(p, b)
                moved = wp.cw_mul(g, vec3(wp.step(-q[0]), wp.step(-q[1]), wp.step(-q[2])))
                r = wp.sqrt(wp.dot(o, o))
                distance = r - size[3]
                normal = o / r
                bend = project(moved, normal) / r
            else:
                distance = q[axis] - size[3]
                normal = vec3(zero, zero, zero)
                normal[axis] = sign(p[axis])
        if kind == wp.static(CYLINDER):
            u, r = radial_unit(p)
            turn = project(vec3(g[0], zero, g[2]), u) / r
            side = r - size[0]
            top = wp.abs(p[1]) - size[1]
            up = vec3(zero, sign(p[1]), zero)
            if side > zero and top > zero:
                distance = wp.sqrt(side * side + top * top)
                normal = (side / distance) * u + (top / distance) * up
                moved_side = wp.dot(g, u)
                moved_top = wp.dot(g, up)
                moved = moved_side * u + moved_top * up + side * turn
                bend = (moved - (side * moved_side + top * moved_top) / distance * normal) / distance
            else:
                distance = wp.max(side, top)
                normal = up
                if side > top:
                    normal = u
                    bend = turn
        if kind == wp.static(TORUS):
            u, r = radial_unit(p)
            side = r - size[0]
            q = side * u + vec3(zero, p[1], zero)
            moved = wp.dot(g, u) * u + side / r * project(vec3(g[0], zero, g[2]), u) + vec3(zero, g[1], zero)
            s = length(q)
            distance = s - size[1]
            normal = q / s
            bend = project(moved, normal) / s
        if kind == wp.static(MESH):
            normal, distance, bend, steepness = mesh_surface(grids, first, size, p, g)
        return normal, distance, bend, steepness

    @wp.func
    def pose_position(pose: vec8):
        return vec3(pose[0], pose[1], pose[2])

    @wp.func
    def pose_axis(pose: vec8):
        """Vector part of the pose's quaternion; its scalar part is pose[3]."""
        return vec3(pose[4], pose[5], pose[6])

    @wp.func
    def rotate(w: real, u: vec3, v: vec3):
        """Rotate v by the unit quaternion (w, u); by its inverse with (w, -u)."""
        c = wp.cross(u, v)
        return v + two * (w * c + wp.cross(u, c))

    @wp.func
    def rotate_adjoint(w: real, u: vec3, v: vec3, g: vec3):
        """Gradients with respect to the quaternion (vec4, wxyz)."""
        c = wp.cross(u, v)
        gc = wp.cross(g, u)
        gu = two * (w * wp.cross(v, g) + wp.cross(c, g) + wp.cross(v, gc))
        return vec4(two * wp.dot(g, c), gu[0], gu[1], gu[2])

    return SimpleNamespace(
        part_centre=part_centre,
        surface=surface,
        pose_position=pose_position,
        pose_axis=pose_axis,
        rotate=rotate,
        rotate_adjoint=rotate_adjoint,
    )
