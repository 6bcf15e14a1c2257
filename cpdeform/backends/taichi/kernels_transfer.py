"""Transfers of a particle to and from the grid, and their adjoints.

MLS-MPM with quadratic B-splines [1]_. The affine term is linear in the stencil offset, so a node costs one multiply-add of four
floats (momentum and mass). `first` is the number of a world's first node in the array of all nodes; a grid covers the nodes of a
`Box`.

References:
    .. [1] Hu et al., "A Moving Least Squares Material Point Method", SIGGRAPH 2018.
"""

import functools
from types import SimpleNamespace
from typing import Any

from cpdeform.backends.taichi.kernels_material import build_material
from cpdeform.backends.taichi.kernels_types import AFFINE, POSITION, STRAIN, VELOCITY, build_types
from cpdeform.backends.taichi.runtime import ti


@functools.cache
def build_transfer(real: Any, atomic: bool) -> SimpleNamespace:
    """Taichi functions that move a particle's data to and from the grid, for one scalar type.

    Args:
        real: `ti.f32` or `ti.f64`.
        atomic: Whether several threads add to the same row of the grid.
    """
    types, law = build_types(real), build_material(real)
    vec3, vec4, vec6, vec3i, mat33, apply = types.vec3, types.vec4, types.vec6, types.vec3i, types.mat33, types.apply
    trial_strain, material, material_adjoint, trial_adjoint = (
        law.trial_strain,
        law.material,
        law.material_adjoint,
        law.trial_adjoint,
    )
    entries, symmetric, eigen, stress_of = law.entries, law.symmetric, law.eigen, law.stress_of
    elastic_stress, elastic_adjoint = law.elastic_stress, law.elastic_adjoint
    zero, half, one, two, four = 0.0, 0.5, 1.0, 2.0, 4.0

    @ti.func
    def load3(record, first: ti.template()):
        return vec3(record[first], record[first + 1], record[first + 2])

    @ti.func
    def load_affine(record):
        return mat33([record[AFFINE + a] for a in range(9)])

    @ti.func
    def load_strain(record):
        return vec6([record[STRAIN + a] for a in range(6)])

    @ti.func
    def base_along(x, parameters: ti.template()):
        # truncation, not floor: a particle in the lowest half cell keeps a stencil that starts at node 0; and a position that
        # is not finite keeps inside the grid, where it spreads nan instead of writing to foreign memory
        return ti.min(ti.max(ti.cast(x * parameters.inverse_distance - half, ti.i32), 0), parameters.grid_size - 3)

    @ti.func
    def base_node(x, parameters: ti.template()):
        return vec3i(base_along(x[0], parameters), base_along(x[1], parameters), base_along(x[2], parameters))

    @ti.func
    def first_node(base, box: ti.template()):
        """Number of the stencil's first node among those of the box."""
        offset = base - box.origin
        return (offset[0] * box.size[1] + offset[1]) * box.size[2] + offset[2]

    @ti.func
    def clip(x, lower, upper):
        # unlike min and max, comparisons let nan through
        result = x
        if x < lower:
            result = lower
        if x > upper:
            result = upper
        return result

    @ti.func
    def fraction(x, base, inverse_distance):
        return x * inverse_distance - ti.cast(base, real)

    @ti.func
    def weights(f):
        a = 1.5 - f
        b = f - one
        c = f - half
        return vec3(half * a * a, 0.75 - b * b, half * c * c)

    @ti.func
    def weight_slopes(f):
        return vec3(f - 1.5, two * (one - f), f - half)

    @ti.func
    def column(m, j: ti.template()):
        return vec4(m[0, j], m[1, j], m[2, j], zero)

    @ti.func
    def extend(v, w):
        return vec4(v[0], v[1], v[2], w)

    @ti.func
    def first_three(v):
        return vec3(v[0], v[1], v[2])

    @ti.func
    def columns(a, b, c):
        return mat33(a[0], b[0], c[0], a[1], b[1], c[1], a[2], b[2], c[2])

    @ti.func
    def add(grid: ti.template(), n, value):
        if ti.static(atomic):
            grid[n] += value
        else:
            grid[n] = grid[n] + value

    @ti.func
    def scatter(grid: ti.template(), node, box: ti.template(), wx, wy, wz, start, ax, ay, az):
        """Add w (start + i ax + j ay + k az) to the 27 nodes."""
        for i in range(3):
            for j in range(3):
                w = wx[i] * wy[j]
                value = start + ti.cast(i, real) * ax + ti.cast(j, real) * ay
                n = node + (i * box.size[1] + j) * box.size[2]
                add(grid, n, (w * wz[0]) * value)
                add(grid, n + 1, (w * wz[1]) * (value + az))
                add(grid, n + 2, (w * wz[2]) * (value + two * az))

    @ti.func
    def particle_to_grid(
        before: ti.template(),
        after: ti.template(),
        materials: ti.template(),
        parameters: ti.template(),
        box: ti.template(),
        p,
        q,
        grid: ti.template(),
        first,
    ):
        """Particle p of a world, number q of all: its new strain to `after`, its momentum and mass to the grid."""
        record = before[q]
        x, c = load3(record, POSITION), load_affine(record)
        trial = trial_strain(load_strain(record), c, parameters.time_step)
        k = materials[p]
        new, stress = material(trial, k[0], k[1], k[2])
        for a in ti.static(range(6)):
            after[q][STRAIN + a] = new[a]
        base = base_node(x, parameters)
        f = fraction(x, base, parameters.inverse_distance)
        a = parameters.node_distance * (parameters.stress_scale * stress + parameters.particle_mass * c)
        momentum = parameters.particle_mass * load3(record, VELOCITY) - apply(a, f)
        scatter(
            grid,
            first + first_node(base, box),
            box,
            weights(f[0]),
            weights(f[1]),
            weights(f[2]),
            extend(momentum, parameters.particle_mass),
            column(a, 0),
            column(a, 1),
            column(a, 2),
        )

    @ti.func
    def grid_to_particle(
        before: ti.template(), after: ti.template(), parameters: ti.template(), box: ti.template(), q, grid: ti.template(), first
    ):
        """New velocity, affine field and position of particle number q of all."""
        x = load3(before[q], POSITION)
        base = base_node(x, parameters)
        f = fraction(x, base, parameters.inverse_distance)
        wx, wy, wz = weights(f[0]), weights(f[1]), weights(f[2])
        node = first + first_node(base, box)
        total = vec4(zero, zero, zero, zero)
        bx = vec4(zero, zero, zero, zero)
        by = vec4(zero, zero, zero, zero)
        bz = vec4(zero, zero, zero, zero)
        for i in range(3):
            for j in range(3):
                n = node + (i * box.size[1] + j) * box.size[2]
                w = wx[i] * wy[j]
                middle = wz[1] * grid[n + 1]
                last = wz[2] * grid[n + 2]
                line = w * (wz[0] * grid[n] + middle + last)
                total = total + line
                bx = bx + ti.cast(i, real) * line
                by = by + ti.cast(j, real) * line
                bz = bz + w * (middle + two * last)
        v = first_three(total)
        scale = four * parameters.inverse_distance
        c = columns(first_three(bx) - f[0] * v, first_three(by) - f[1] * v, first_three(bz) - f[2] * v)
        moved = x + parameters.time_step * v
        for a in ti.static(range(3)):
            after[q][POSITION + a] = clip(moved[a], parameters.lower[a], parameters.upper[a])
            after[q][VELOCITY + a] = v[a]
            for b in ti.static(range(3)):
                after[q][AFFINE + 3 * a + b] = scale * c[a, b]

    @ti.func
    def grid_to_particle_adjoint(
        before: ti.template(),
        after: ti.template(),
        gradient: ti.template(),
        parameters: ti.template(),
        box: ti.template(),
        q,
        grid: ti.template(),
        velocities,
        gradients,
    ):
        """Adds the gradient of the grid's velocities to the nodes from `gradients` on; the velocities start at `velocities`.

        The gradient of the position becomes that of the old position as far as this stage goes.
        """
        x, v, g = load3(before[q], POSITION), load3(after[q], VELOCITY), gradient[q]
        base = base_node(x, parameters)
        f = fraction(x, base, parameters.inverse_distance)
        wx, wy, wz = weights(f[0]), weights(f[1]), weights(f[2])
        dx, dy, dz = weight_slopes(f[0]), weight_slopes(f[1]), weight_slopes(f[2])
        gx = load3(g, POSITION)
        moved = x + parameters.time_step * v
        for a in ti.static(range(3)):
            if moved[a] < parameters.lower[a] or moved[a] > parameters.upper[a]:
                gx[a] = real(zero)
        gv = load3(g, VELOCITY) + parameters.time_step * gx
        gc = (four * parameters.inverse_distance) * load_affine(g)
        start = extend(gv - apply(gc, f), zero)
        ax, ay, az = column(gc, 0), column(gc, 1), column(gc, 2)
        node = first_node(base, box)
        scatter(grid, gradients + node, box, wx, wy, wz, start, ax, ay, az)
        sx, sy, sz = real(zero), real(zero), real(zero)
        for i in range(3):
            for j in range(3):
                n = velocities + node + (i * box.size[1] + j) * box.size[2]
                value = start + ti.cast(i, real) * ax + ti.cast(j, real) * ay
                g0 = grid[n].dot(value)
                g1 = grid[n + 1].dot(value + az)
                g2 = grid[n + 2].dot(value + two * az)
                line = wz[0] * g0 + wz[1] * g1 + wz[2] * g2
                sx += dx[i] * wy[j] * line
                sy += wx[i] * dy[j] * line
                sz += wx[i] * wy[j] * (dz[0] * g0 + dz[1] * g1 + dz[2] * g2)
        slope = vec3(sx, sy, sz) - apply(gc.transpose(), v)
        for a in ti.static(range(3)):
            gradient[q][POSITION + a] = gx[a] + parameters.inverse_distance * slope[a]

    @ti.func
    def particle_to_grid_adjoint(
        before: ti.template(),
        gradient: ti.template(),
        materials: ti.template(),
        parameters: ti.template(),
        box: ti.template(),
        p,
        q,
        grid: ti.template(),
        first,
    ):
        """Turns the gradient after the substep (in place) into that before it; strain as entries of a symmetric matrix."""
        record, g = before[q], gradient[q]
        x, c, e = load3(record, POSITION), load_affine(record), load_strain(record)
        k = materials[p]
        trial = trial_strain(e, c, parameters.time_step)
        values, u0, u1, u2 = vec3(zero), vec3(zero), vec3(zero), vec3(zero)
        inside, stress = elastic_stress(trial, k[0], k[1], k[2])
        if not inside:
            values, u0, u1, u2 = eigen(trial)
            stress = stress_of(values, u0, u1, u2, k[0], k[1], k[2])
        base = base_node(x, parameters)
        f = fraction(x, base, parameters.inverse_distance)
        wx, wy, wz = weights(f[0]), weights(f[1]), weights(f[2])
        dx, dy, dz = weight_slopes(f[0]), weight_slopes(f[1]), weight_slopes(f[2])
        a = parameters.node_distance * (parameters.stress_scale * stress + parameters.particle_mass * c)
        start = extend(parameters.particle_mass * load3(record, VELOCITY) - apply(a, f), parameters.particle_mass)
        ax, ay, az = column(a, 0), column(a, 1), column(a, 2)
        node = first + first_node(base, box)
        total = vec4(zero, zero, zero, zero)
        bx = vec4(zero, zero, zero, zero)
        by = vec4(zero, zero, zero, zero)
        bz = vec4(zero, zero, zero, zero)
        sx, sy, sz = real(zero), real(zero), real(zero)
        for i in range(3):
            for j in range(3):
                n = node + (i * box.size[1] + j) * box.size[2]
                value = start + ti.cast(i, real) * ax + ti.cast(j, real) * ay
                n0 = grid[n]
                n1 = grid[n + 1]
                n2 = grid[n + 2]
                g0 = n0.dot(value)
                g1 = n1.dot(value + az)
                g2 = n2.dot(value + two * az)
                w = wx[i] * wy[j]
                middle = wz[1] * n1
                last = wz[2] * n2
                row = w * (wz[0] * n0 + middle + last)
                total = total + row
                bx = bx + ti.cast(i, real) * row
                by = by + ti.cast(j, real) * row
                bz = bz + w * (middle + two * last)
                line = wz[0] * g0 + wz[1] * g1 + wz[2] * g2
                sx += dx[i] * wy[j] * line
                sy += wx[i] * dy[j] * line
                sz += w * (dz[0] * g0 + dz[1] * g1 + dz[2] * g2)
        gp = first_three(total)
        ga = parameters.node_distance * columns(
            first_three(bx) - f[0] * gp, first_three(by) - f[1] * gp, first_three(bz) - f[2] * gp
        )
        slope = vec3(sx, sy, sz) - apply(a.transpose(), gp)
        gs = (half * parameters.stress_scale) * (ga + ga.transpose())
        gn = symmetric(load_strain(g))
        gt = ti.Matrix.zero(real, 3, 3)
        if inside:
            gt = elastic_adjoint(trial, k[0], k[1], gn, gs)
        else:
            gt = material_adjoint(values, u0, u1, u2, k[0], k[1], k[2], gn, gs)
        ge, gd = trial_adjoint(e, c, parameters.time_step, gt)
        strain = entries(ge)
        for i in ti.static(range(3)):
            gradient[q][POSITION + i] = g[POSITION + i] + parameters.inverse_distance * slope[i]
            gradient[q][VELOCITY + i] = parameters.particle_mass * gp[i]
            for j in ti.static(range(3)):
                gradient[q][AFFINE + 3 * i + j] = parameters.particle_mass * ga[i, j] + gd[i, j]
        for i in ti.static(range(6)):
            gradient[q][STRAIN + i] = strain[i]

    return SimpleNamespace(
        load3=load3,
        base_node=base_node,
        particle_to_grid=particle_to_grid,
        grid_to_particle=grid_to_particle,
        grid_to_particle_adjoint=grid_to_particle_adjoint,
        particle_to_grid_adjoint=particle_to_grid_adjoint,
    )
