"""Signed distances of the tools in their local frames, outward normals, and how these change.

The entries of a tool's `size`, lengths: Sphere (radius); Capsule, RollingPin and Chopsticks (radius, height); Box (half extents,
rounding); Cylinder (radius, half height); Torus (major radius, tube radius); Mesh (distance between nodes, numbers of nodes;
its numbers are in `values` from `grid_first` on). Chopsticks are the capsule nearer to a point: `part_centre` is its centre.
"""

import functools
from types import SimpleNamespace
from typing import Any

from cpdeform.backends.scene_numbers import BOX, CAPSULE, CHOPSTICKS, CYLINDER, MESH, ROLLING_PIN, SPHERE, TORUS
from cpdeform.backends.taichi.kernels_types import build_types
from cpdeform.backends.taichi.runtime import ti

TOOL_KINDS = ("Sphere", "Capsule", "Box", "Cylinder", "Torus", "RollingPin", "Chopsticks", "Mesh")
"""The kinds of tools that the functions below know; the simulator refuses others."""


@functools.cache
def build_distance(real: Any) -> SimpleNamespace:
    """Taichi functions of signed distances and rotations for one scalar type."""
    types = build_types(real)
    vec3, vec4 = types.vec3, types.vec4
    zero, half, three_quarters, one, two = 0.0, 0.5, 0.75, 1.0, 2.0
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
    def project(g, normal):
        return g - g.dot(normal) * normal

    @ti.func
    def spline(f):
        """Weights of a quadratic B-spline at three nodes, `f` from the middle one, and their derivatives."""
        weights = vec3(half * (half - f) * (half - f), three_quarters - f * f, half * (half + f) * (half + f))
        return weights, vec3(f - half, -two * f, f + half)

    @ti.func
    def mesh_place(along, size, count):
        """Where a coordinate lies in the grid: clipped, its nearest node, and how far it is beyond, in nodes."""
        u = along / size + half * (count - one)
        inside = ti.min(ti.max(u, one), count - two)
        base = ti.min(ti.cast(inside + half, ti.i32), ti.cast(count, ti.i32) - 2)
        return inside - ti.cast(base, real), base, u - inside

    @ti.func
    def numbers_at(values: ti.template(), first):
        return vec3(values[first], values[first + 1], values[first + 2])

    @ti.func
    def triangles_surface(values: ti.template(), lists, found, p, g):
        """As `surface`, of the nearest of the triangles in the list at `found`; see `SharpCells.kernel_numbers`."""
        least = real(1e30)
        way = vec3(zero, zero, zero)  # from the nearest place
        mean = vec3(zero, one, zero)  # the mean normal there
        edge = vec3(zero, zero, zero)  # along its edge; zero on a face or at a corner
        face = False
        for n in range(ti.cast(values[found], ti.i32)):
            t = lists + ti.cast(values[found + 1 + n], ti.i32)
            normal = numbers_at(values, t + 9)
            inside = True
            for i in ti.static(range(3)):
                corner = numbers_at(values, t + 3 * i)
                along = numbers_at(values, t + 3 * ((i + 1) % 3)) - corner
                if normal.cross(along).dot(p - corner) < zero:
                    inside = False
            if inside:
                height = (p - numbers_at(values, t)).dot(normal)
                if height * height < least:
                    least = height * height
                    way = height * normal
                    mean = normal
                    face = True
            else:
                for i in ti.static(range(3)):
                    corner = numbers_at(values, t + 3 * i)
                    along = numbers_at(values, t + 3 * ((i + 1) % 3)) - corner
                    share = ti.min(ti.max((p - corner).dot(along) / along.dot(along), real(zero)), real(one))
                    aside = p - corner - share * along
                    if aside.dot(aside) < least:
                        least = aside.dot(aside)
                        way = aside
                        face = False
                        edge = vec3(zero, zero, zero)
                        if share <= zero:
                            mean = numbers_at(values, t + 21 + 3 * i)
                        elif share >= one:
                            mean = numbers_at(values, t + 21 + 3 * ((i + 1) % 3))
                        else:
                            mean = numbers_at(values, t + 12 + 3 * i)
                            edge = along / ti.sqrt(along.dot(along))
        distance = way.dot(mean)
        result = mean
        bend = vec3(zero, zero, zero)
        if not face:
            distance = ti.sqrt(least) * sign(distance)
            if ti.abs(distance) >= real(1e-7):
                result = way / distance
                bend = project(g - g.dot(edge) * edge, result) / distance
        return result, distance, bend, real(one)

    @ti.func
    def spline_surface(values: ti.template(), first, size, p, g):
        """As `surface`: the quadratic B-spline of a mesh's distance; beyond the grid the way there is added."""
        fx, bx, ox = mesh_place(p[0], size[0], size[1])
        fy, by, oy = mesh_place(p[1], size[0], size[2])
        fz, bz, oz = mesh_place(p[2], size[0], size[3])
        wx, dx = spline(fx)
        wy, dy = spline(fy)
        wz, dz = spline(fz)
        curve = vec3(one, -two, one)
        distance = real(zero)
        gradient = vec3(zero, zero, zero)
        straight = vec3(zero, zero, zero)
        mixed = vec3(zero, zero, zero)
        for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
            node = ((bx + i - 1) * ti.cast(size[2], ti.i32) + by + j - 1) * ti.cast(size[3], ti.i32) + bz + k - 1
            c = values[first + node]
            xy, xz, yz = dx[i] * dy[j] * wz[k], dx[i] * wy[j] * dz[k], wx[i] * dy[j] * dz[k]
            distance += c * wx[i] * wy[j] * wz[k]
            gradient += c * vec3(dx[i] * wy[j] * wz[k], wx[i] * dy[j] * wz[k], wx[i] * wy[j] * dz[k])
            straight += c * vec3(curve[i] * wy[j] * wz[k], wx[i] * curve[j] * wz[k], wx[i] * wy[j] * curve[k])
            mixed += c * vec3(xy, xz, yz)
        steep = ti.max(ti.sqrt(gradient.dot(gradient)) / size[0], real(1e-3))
        normal = gradient / (steep * size[0])
        distance += ti.sqrt(ox * ox + oy * oy + oz * oz) * size[0]
        # The transposed derivative of the normal: an interpolated distance's Hessian does not vanish along the normal.
        a = project(g, normal)
        bend = vec3(
            straight[0] * a[0] + mixed[0] * a[1] + mixed[1] * a[2],
            mixed[0] * a[0] + straight[1] * a[1] + mixed[2] * a[2],
            mixed[1] * a[0] + mixed[2] * a[1] + straight[2] * a[2],
        )
        return normal, distance, bend / (steep * size[0] * size[0]), steep

    @ti.func
    def mesh_surface(values: ti.template(), first, size, p, g):
        """As `surface`, of a mesh: that of triangles at sharp edges, else that of `spline_surface`."""
        _, bx, _ = mesh_place(p[0], size[0], size[1])
        _, by, _ = mesh_place(p[1], size[0], size[2])
        _, bz, _ = mesh_place(p[2], size[0], size[3])
        rows, columns = ti.cast(size[2], ti.i32), ti.cast(size[3], ti.i32)
        nodes = ti.cast(size[1], ti.i32) * rows * columns
        found = ti.cast(values[first + nodes + (bx * rows + by) * columns + bz], ti.i32)
        distance = real(zero)
        normal = vec3(zero, one, zero)
        bend = vec3(zero, zero, zero)
        steepness = real(one)
        if found > 0:
            lists = first + 2 * nodes
            normal, distance, bend, steepness = triangles_surface(values, lists, lists + found, p, g)
        else:
            normal, distance, bend, steepness = spline_surface(values, first, size, p, g)
        return normal, distance, bend, steepness

    @ti.func
    def surface(values: ti.template(), first, kind, size, p, g):
        """Normal and signed distance at the local point p, and how the normal changes along g: (normal, distance, bend, steepness).

        All that kernels know of a kind. The derivative of a distance's gradient is a symmetric matrix, the distance's Hessian, so
        that `bend` is the adjoint of the normal, too; where it is not used, the compiler leaves it out. The steepness is the
        length of the distance's gradient, which is not 1 near the edges of a mesh's interpolated distance.
        """
        distance = real(zero)
        normal = vec3(zero, one, zero)
        bend = vec3(zero, zero, zero)
        steepness = real(one)
        if kind == SPHERE:
            r = length(p)
            distance = r - size[0]
            normal = p / r
            bend = project(g, normal) / r
        if kind == CAPSULE or kind == ROLLING_PIN or kind == CHOPSTICKS:
            h = half * size[1]
            q = vec3(p[0], p[1] - ti.min(ti.max(p[1], -h), h), p[2])
            moved = g
            if ti.abs(p[1]) < h:
                moved[1] = zero
            r = length(q)
            distance = r - size[0]
            normal = q / r
            bend = project(moved, normal) / r
        if kind == BOX:
            b = vec3(size[0], size[1], size[2])
            q = ti.abs(p) - b
            largest = q.max()
            if largest > zero:
                o = box_offset(p, b)
                moved = g
                for a in ti.static(range(3)):
                    if q[a] <= zero:
                        moved[a] = zero
                r = ti.sqrt(o.dot(o))
                distance = r - size[3]
                normal = o / r
                bend = project(moved, normal) / r
            else:
                distance = largest - size[3]
                axis = largest_axis(q)
                normal = vec3(zero, zero, zero)
                for a in ti.static(range(3)):
                    if a == axis:
                        normal[a] = sign(p[a])
        if kind == CYLINDER:
            u, r = radial_unit(p)
            turn = project(vec3(g[0], zero, g[2]), u) / r
            side = r - size[0]
            top = ti.abs(p[1]) - size[1]
            up = vec3(zero, sign(p[1]), zero)
            if side > zero and top > zero:
                distance = ti.sqrt(side * side + top * top)
                normal = (side / distance) * u + (top / distance) * up
                moved_side = g.dot(u)
                moved_top = g.dot(up)
                moved = moved_side * u + moved_top * up + side * turn
                bend = (moved - (side * moved_side + top * moved_top) / distance * normal) / distance
            else:
                distance = ti.max(side, top)
                normal = up
                if side > top:
                    normal = u
                    bend = turn
        if kind == TORUS:
            u, r = radial_unit(p)
            side = r - size[0]
            q = side * u + vec3(zero, p[1], zero)
            moved = g.dot(u) * u + side / r * project(vec3(g[0], zero, g[2]), u) + vec3(zero, g[1], zero)
            s = length(q)
            distance = s - size[1]
            normal = q / s
            bend = project(moved, normal) / s
        if kind == MESH:
            normal, distance, bend, steepness = mesh_surface(values, first, size, p, g)
        return normal, distance, bend, steepness

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
        surface=surface,
        pose_position=pose_position,
        pose_axis=pose_axis,
        rotate=rotate,
        rotate_adjoint=rotate_adjoint,
    )
