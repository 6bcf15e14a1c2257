"""Transfers between particles and grid, and their adjoints.

MLS-MPM with quadratic B-splines [1]_. The affine term is linear in the stencil offset, so a node costs one multiply-add of four
floats (momentum and mass). Kernels run over (world, particle); `row` is the first grid row of the launch and a grid covers the
nodes `origin` .. `origin + size - 1`.

References:
    .. [1] Hu et al., "A Moving Least Squares Material Point Method", SIGGRAPH 2018.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from cpdeform.backends.warp.kernels_material import build_material
from cpdeform.backends.warp.kernels_types import KERNEL_OPTIONS, build_types


@functools.cache
def build_transfer(real: Any) -> SimpleNamespace:
    """Warp kernels that move data between particles and grid, for one scalar type."""
    types, law = build_types(real), build_material(real)
    vec3, vec4, vec6, mat33, Parameters = types.vec3, types.vec4, types.vec6, types.mat33, types.Parameters
    trial_strain, material, material_adjoint, trial_adjoint = (
        law.trial_strain,
        law.material,
        law.material_adjoint,
        law.trial_adjoint,
    )
    entries, symmetric, eigen, stress_of = law.entries, law.symmetric, law.eigen, law.stress_of
    elastic_stress, elastic_adjoint = law.elastic_stress, law.elastic_adjoint
    zero, half, one, two = real(0.0), real(0.5), real(1.0), real(2.0)
    four = real(4.0)

    @wp.func
    def base_along(x: real, parameters: Parameters):
        # truncation, not floor: a particle in the lowest half cell keeps a stencil that starts at node 0; and a position that
        # is not finite keeps inside the grid, where it spreads nan instead of writing to foreign memory
        return wp.min(wp.max(int(x * parameters.inverse_distance - half), 0), parameters.grid_size - 3)

    @wp.func
    def base_node(x: vec3, parameters: Parameters):
        return wp.vec3i(base_along(x[0], parameters), base_along(x[1], parameters), base_along(x[2], parameters))

    @wp.func
    def clip(x: real, lower: real, upper: real):
        # unlike min and max, comparisons let nan through
        result = x
        if x < lower:
            result = lower
        if x > upper:
            result = upper
        return result

    @wp.func
    def fraction(x: vec3, base: wp.vec3i, inverse_distance: real):
        return vec3(
            x[0] * inverse_distance - real(base[0]),
            x[1] * inverse_distance - real(base[1]),
            x[2] * inverse_distance - real(base[2]),
        )

    @wp.func
    def weights(f: real):
        a = real(1.5) - f
        b = f - one
        c = f - half
        return vec3(half * a * a, real(0.75) - b * b, half * c * c)

    @wp.func
    def weight_slopes(f: real):
        return vec3(f - real(1.5), two * (one - f), f - half)

    @wp.func
    def column(m: mat33, j: int):
        return vec3(m[0, j], m[1, j], m[2, j])

    @wp.func
    def extend(v: vec3, w: real):
        return vec4(v[0], v[1], v[2], w)

    @wp.func
    def first_three(v: vec4):
        return vec3(v[0], v[1], v[2])

    @wp.func
    def scatter(
        grid: wp.array2d(dtype=vec4),
        row: int,
        base: wp.vec3i,
        origin: wp.vec3i,
        size: wp.vec3i,
        wx: vec3,
        wy: vec3,
        wz: vec3,
        start: vec4,
        ax: vec4,
        ay: vec4,
        az: vec4,
    ):
        """Add w (start + i ax + j ay + k az) to the 27 nodes."""
        node = ((base[0] - origin[0]) * size[1] + base[1] - origin[1]) * size[2] + base[2] - origin[2]
        steps = vec3(zero, one, two)
        for i in range(3):
            for j in range(3):
                w = wx[i] * wy[j]
                value = start + steps[i] * ax + steps[j] * ay
                n = node + (i * size[1] + j) * size[2]
                wp.atomic_add(grid, row, n, (w * wz[0]) * value)
                wp.atomic_add(grid, row, n + 1, (w * wz[1]) * (value + az))
                wp.atomic_add(grid, row, n + 2, (w * wz[2]) * (value + two * az))

    @wp.kernel(**KERNEL_OPTIONS)
    def bounds(
        position: wp.array2d(dtype=vec3),
        parameters: Parameters,
        result: wp.array(dtype=wp.vec3i),
    ):
        """Lowest and highest node of any stencil of world 0 (a single thread; CPU only)."""
        low = wp.vec3i(parameters.grid_size, parameters.grid_size, parameters.grid_size)
        high = wp.vec3i(0, 0, 0)
        for p in range(position.shape[1]):
            base = base_node(position[0, p], parameters)
            low = wp.min(low, base)
            high = wp.max(high, base)
        result[0] = low
        result[1] = high + wp.vec3i(2, 2, 2)

    @wp.kernel(**KERNEL_OPTIONS)
    def particles_to_grid(
        position: wp.array2d(dtype=vec3),
        velocity: wp.array2d(dtype=vec3),
        affine: wp.array2d(dtype=mat33),
        strain: wp.array2d(dtype=vec6),
        constants: wp.array(dtype=vec3),
        parameters: Parameters,
        first: int,
        row: int,
        origin: wp.vec3i,
        size: wp.vec3i,
        new_strain: wp.array2d(dtype=vec6),
        grid: wp.array2d(dtype=vec4),
    ):
        world, index = wp.tid()
        p = first + index
        c = affine[world, p]
        trial = trial_strain(strain[world, p], c, parameters.time_step)
        k = constants[p]
        new, stress = material(trial, k[0], k[1], k[2])
        new_strain[world, p] = new
        x = position[world, p]
        base = base_node(x, parameters)
        f = fraction(x, base, parameters.inverse_distance)
        a = parameters.node_distance * (parameters.stress_scale * stress + parameters.particle_mass * c)
        momentum = parameters.particle_mass * velocity[world, p] - a * f
        scatter(
            grid,
            row + world,
            base,
            origin,
            size,
            weights(f[0]),
            weights(f[1]),
            weights(f[2]),
            extend(momentum, parameters.particle_mass),
            extend(column(a, 0), zero),
            extend(column(a, 1), zero),
            extend(column(a, 2), zero),
        )

    @wp.kernel(**KERNEL_OPTIONS)
    def grid_to_particles(
        position: wp.array2d(dtype=vec3),
        grid: wp.array2d(dtype=vec4),
        parameters: Parameters,
        first: int,
        origin: wp.vec3i,
        size: wp.vec3i,
        new_position: wp.array2d(dtype=vec3),
        new_velocity: wp.array2d(dtype=vec3),
        new_affine: wp.array2d(dtype=mat33),
    ):
        world, index = wp.tid()
        p = first + index
        x = position[world, p]
        base = base_node(x, parameters)
        f = fraction(x, base, parameters.inverse_distance)
        wx, wy, wz = weights(f[0]), weights(f[1]), weights(f[2])
        node = ((base[0] - origin[0]) * size[1] + base[1] - origin[1]) * size[2] + base[2] - origin[2]
        total = vec4(zero, zero, zero, zero)
        bx, by, bz = total, total, total
        steps = vec3(zero, one, two)
        for i in range(3):
            for j in range(3):
                n = node + (i * size[1] + j) * size[2]
                middle = wz[1] * grid[world, n + 1]
                last = wz[2] * grid[world, n + 2]
                w = wx[i] * wy[j]
                line = w * (wz[0] * grid[world, n] + middle + last)
                total += line
                bx += steps[i] * line
                by += steps[j] * line
                bz += w * (middle + two * last)
        v = first_three(total)
        scale = four * parameters.inverse_distance
        c0 = scale * (first_three(bx) - f[0] * v)
        c1 = scale * (first_three(by) - f[1] * v)
        c2 = scale * (first_three(bz) - f[2] * v)
        new_velocity[world, p] = v
        new_affine[world, p] = mat33(c0[0], c1[0], c2[0], c0[1], c1[1], c2[1], c0[2], c1[2], c2[2])
        moved = x + parameters.time_step * v
        lower, upper = parameters.lower, parameters.upper
        new_position[world, p] = vec3(
            clip(moved[0], lower[0], upper[0]), clip(moved[1], lower[1], upper[1]), clip(moved[2], lower[2], upper[2])
        )

    @wp.kernel(**KERNEL_OPTIONS)
    def grid_to_particles_adjoint(
        position: wp.array2d(dtype=vec3),
        new_velocity: wp.array2d(dtype=vec3),
        grid: wp.array2d(dtype=vec4),
        parameters: Parameters,
        first: int,
        row: int,
        origin: wp.vec3i,
        size: wp.vec3i,
        grad_position: wp.array2d(dtype=vec3),
        grad_velocity: wp.array2d(dtype=vec3),
        grad_affine: wp.array2d(dtype=mat33),
        grad_grid: wp.array2d(dtype=vec4),
    ):
        """Adds to `grad_grid`; `grad_position` becomes that of the old position as far as this stage goes."""
        world, index = wp.tid()
        p = first + index
        x = position[world, p]
        v = new_velocity[world, p]
        base = base_node(x, parameters)
        f = fraction(x, base, parameters.inverse_distance)
        wx, wy, wz = weights(f[0]), weights(f[1]), weights(f[2])
        dx, dy, dz = weight_slopes(f[0]), weight_slopes(f[1]), weight_slopes(f[2])
        gx = grad_position[world, p]
        moved = x + parameters.time_step * v
        for a in range(3):
            if moved[a] < parameters.lower[a] or moved[a] > parameters.upper[a]:
                gx[a] = zero
        gv = grad_velocity[world, p] + parameters.time_step * gx
        gc = (four * parameters.inverse_distance) * grad_affine[world, p]
        start = extend(gv - gc * f, zero)
        ax, ay, az = extend(column(gc, 0), zero), extend(column(gc, 1), zero), extend(column(gc, 2), zero)
        scatter(grad_grid, row + world, base, origin, size, wx, wy, wz, start, ax, ay, az)
        node = ((base[0] - origin[0]) * size[1] + base[1] - origin[1]) * size[2] + base[2] - origin[2]
        sx, sy, sz = zero, zero, zero
        steps = vec3(zero, one, two)
        for i in range(3):
            for j in range(3):
                n = node + (i * size[1] + j) * size[2]
                value = start + steps[i] * ax + steps[j] * ay
                g0 = wp.dot(grid[world, n], value)
                g1 = wp.dot(grid[world, n + 1], value + az)
                g2 = wp.dot(grid[world, n + 2], value + two * az)
                line = wz[0] * g0 + wz[1] * g1 + wz[2] * g2
                sx += dx[i] * wy[j] * line
                sy += wx[i] * dy[j] * line
                sz += wx[i] * wy[j] * (dz[0] * g0 + dz[1] * g1 + dz[2] * g2)
        slope = vec3(sx, sy, sz) - wp.transpose(gc) * v
        grad_position[world, p] = gx + parameters.inverse_distance * slope

    @wp.kernel(**KERNEL_OPTIONS)
    def particles_to_grid_adjoint(
        position: wp.array2d(dtype=vec3),
        velocity: wp.array2d(dtype=vec3),
        affine: wp.array2d(dtype=mat33),
        strain: wp.array2d(dtype=vec6),
        constants: wp.array(dtype=vec3),
        parameters: Parameters,
        first: int,
        origin: wp.vec3i,
        size: wp.vec3i,
        grad_grid: wp.array2d(dtype=vec4),
        grad_position: wp.array2d(dtype=vec3),
        grad_velocity: wp.array2d(dtype=vec3),
        grad_affine: wp.array2d(dtype=mat33),
        grad_strain: wp.array2d(dtype=vec6),
    ):
        """Turns gradients after the substep (in place) into those before it; strain gradients as entries of a symmetric matrix."""
        world, index = wp.tid()
        p = first + index
        c = affine[world, p]
        e = strain[world, p]
        k = constants[p]
        trial = trial_strain(e, c, parameters.time_step)
        values = vec3()
        u0, u1, u2 = vec3(), vec3(), vec3()
        inside, stress = elastic_stress(trial, k[0], k[1], k[2])
        if not inside:
            values, u0, u1, u2 = eigen(trial)
            stress = stress_of(values, u0, u1, u2, k[0], k[1], k[2])
        x = position[world, p]
        base = base_node(x, parameters)
        f = fraction(x, base, parameters.inverse_distance)
        wx, wy, wz = weights(f[0]), weights(f[1]), weights(f[2])
        dx, dy, dz = weight_slopes(f[0]), weight_slopes(f[1]), weight_slopes(f[2])
        a = parameters.node_distance * (parameters.stress_scale * stress + parameters.particle_mass * c)
        start = extend(parameters.particle_mass * velocity[world, p] - a * f, parameters.particle_mass)
        ax, ay, az = extend(column(a, 0), zero), extend(column(a, 1), zero), extend(column(a, 2), zero)
        node = ((base[0] - origin[0]) * size[1] + base[1] - origin[1]) * size[2] + base[2] - origin[2]
        total = vec4(zero, zero, zero, zero)
        bx, by, bz = total, total, total
        sx, sy, sz = zero, zero, zero
        steps = vec3(zero, one, two)
        for i in range(3):
            for j in range(3):
                n = node + (i * size[1] + j) * size[2]
                value = start + steps[i] * ax + steps[j] * ay
                n0 = grad_grid[world, n]
                n1 = grad_grid[world, n + 1]
                n2 = grad_grid[world, n + 2]
                g0 = wp.dot(n0, value)
                g1 = wp.dot(n1, value + az)
                g2 = wp.dot(n2, value + two * az)
                w = wx[i] * wy[j]
                middle = wz[1] * n1
                last = wz[2] * n2
                row = w * (wz[0] * n0 + middle + last)
                total += row
                bx += steps[i] * row
                by += steps[j] * row
                bz += w * (middle + two * last)
                line = wz[0] * g0 + wz[1] * g1 + wz[2] * g2
                sx += dx[i] * wy[j] * line
                sy += wx[i] * dy[j] * line
                sz += w * (dz[0] * g0 + dz[1] * g1 + dz[2] * g2)
        gp = first_three(total)
        a0 = first_three(bx) - f[0] * gp
        a1 = first_three(by) - f[1] * gp
        a2 = first_three(bz) - f[2] * gp
        ga = parameters.node_distance * mat33(a0[0], a1[0], a2[0], a0[1], a1[1], a2[1], a0[2], a1[2], a2[2])
        slope = vec3(sx, sy, sz) - wp.transpose(a) * gp
        grad_position[world, p] = grad_position[world, p] + parameters.inverse_distance * slope
        grad_velocity[world, p] = parameters.particle_mass * gp
        gs = (half * parameters.stress_scale) * (ga + wp.transpose(ga))
        gn = symmetric(grad_strain[world, p])
        gt = mat33()
        if inside:
            gt = elastic_adjoint(trial, k[0], k[1], gn, gs)
        else:
            gt = material_adjoint(values, u0, u1, u2, k[0], k[1], k[2], gn, gs)
        ge, gd = trial_adjoint(e, c, parameters.time_step, gt)
        grad_strain[world, p] = entries(ge)
        grad_affine[world, p] = parameters.particle_mass * ga + gd

    return SimpleNamespace(
        bounds=bounds,
        particles_to_grid=particles_to_grid,
        grid_to_particles=grid_to_particles,
        grid_to_particles_adjoint=grid_to_particles_adjoint,
        particles_to_grid_adjoint=particles_to_grid_adjoint,
    )
