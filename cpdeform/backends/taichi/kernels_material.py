"""The material: trial strain, return mapping, stress, and the adjoint of all three.

State is the elastic strain e = b - I with b = F F^T. For a trial e* = U diag(l) U^T, both the new strain and the stress share the
eigenvectors U (the model is isotropic), so a symmetric 3x3 eigendecomposition replaces the SVD of F. The adjoint is the
Daleckii-Krein formula; its divided differences are written in closed forms that do not cancel where eigenvalues meet. In
float32, small strains inside the yield surface take power series instead.

References:
    de Souza Neto, Peric, Owen, "Computational Methods for Plasticity", 2008, chapter 14 and appendix A (isotropic functions).
"""

import functools
from types import SimpleNamespace
from typing import Any

from cpdeform.backends.taichi.kernels_types import build_types
from cpdeform.backends.taichi.runtime import ti


@functools.cache
def build_material(real: Any) -> SimpleNamespace:
    """Taichi functions of the material model for one scalar type."""
    types = build_types(real)
    vec3, vec6, mat33, product, apply = types.vec3, types.vec6, types.mat33, types.product, types.apply
    zero, half, one, two = 0.0, 0.5, 1.0, 2.0
    third, sixth = 1.0 / 3.0, 1.0 / 6.0
    smallest_stretch_squared = 0.05 * 0.05 - 1.0
    jacobi_tolerance = 1e-12 if real is ti.f32 else 1e-30
    norm_regularization = 1e-8
    # of the series below a quarter, to double precision, the last term first
    log_terms = tuple(1.0 / (2 * k + 1) for k in reversed(range(10)))
    exponential_terms = tuple(1.0 / k for k in reversed(range(2, 12)))
    # squared strain up to which power series are exact to float32; float64 always takes the eigendecomposition
    series_limit = 9e-4 if real is ti.f32 else -1.0

    @ti.func
    def log1p(x):
        # a series, not log(1 + x) x / ((1 + x) - 1): a runtime with fast math, which a user may have started, would shorten that
        result = ti.log(one + x)
        if ti.abs(x) < 0.25:
            z = x / (two + x)
            total = real(zero)
            for term in ti.static(log_terms):
                total = total * (z * z) + real(term)
            result = two * z * total
        return result

    @ti.func
    def expm1(x):
        result = ti.exp(x) - one
        if ti.abs(x) < 0.25:
            total = real(one)
            for term in ti.static(exponential_terms):
                total = one + x * real(term) * total
            result = x * total
        return result

    @ti.func
    def sinhc(x):
        x2 = x * x
        result = one + x2 * real(sixth) * (one + x2 * real(1.0 / 20.0) * (one + x2 * real(1.0 / 42.0)))
        if x2 > 0.25:
            result = half * (ti.exp(x) - ti.exp(-x)) / x
        return result

    @ti.func
    def symmetric(e):
        return mat33(e[0], e[3], e[4], e[3], e[1], e[5], e[4], e[5], e[2])

    @ti.func
    def entries(m):
        return vec6(m[0, 0], m[1, 1], m[2, 2], m[0, 1], m[0, 2], m[1, 2])

    @ti.func
    def rotation_tangent(app, aqq, apq):
        t = real(zero)
        if apq != zero:
            theta = (aqq - app) / (two * apq)
            t = one / (ti.abs(theta) + ti.sqrt(theta * theta + one))
            if theta < zero:
                t = -t
        return t

    @ti.func
    def eigen(e):
        """Cyclic Jacobi: eigenvalues and eigenvectors (as three vectors) of a symmetric matrix."""
        a00, a11, a22 = e[0], e[1], e[2]
        a01, a02, a12 = e[3], e[4], e[5]
        u0 = vec3(one, zero, zero)
        u1 = vec3(zero, one, zero)
        u2 = vec3(zero, zero, one)
        sweep = 0
        off = a01 * a01 + a02 * a02 + a12 * a12
        while sweep < 8 and off > real(jacobi_tolerance) * (a00 * a00 + a11 * a11 + a22 * a22 + off):
            t = rotation_tangent(a00, a11, a01)
            c = one / ti.sqrt(one + t * t)
            s = t * c
            a00 = a00 - t * a01
            a11 = a11 + t * a01
            a01 = real(zero)
            p = c * a02 - s * a12
            a12 = s * a02 + c * a12
            a02 = p
            w = c * u0 - s * u1
            u1 = s * u0 + c * u1
            u0 = w

            t = rotation_tangent(a00, a22, a02)
            c = one / ti.sqrt(one + t * t)
            s = t * c
            a00 = a00 - t * a02
            a22 = a22 + t * a02
            a02 = real(zero)
            p = c * a01 - s * a12
            a12 = s * a01 + c * a12
            a01 = p
            w = c * u0 - s * u2
            u2 = s * u0 + c * u2
            u0 = w

            t = rotation_tangent(a11, a22, a12)
            c = one / ti.sqrt(one + t * t)
            s = t * c
            a11 = a11 - t * a12
            a22 = a22 + t * a12
            a12 = real(zero)
            p = c * a01 - s * a02
            a02 = s * a01 + c * a02
            a01 = p
            w = c * u1 - s * u2
            u2 = s * u1 + c * u2
            u1 = w

            off = a01 * a01 + a02 * a02 + a12 * a12
            sweep += 1
        return vec3(a00, a11, a22), u0, u1, u2

    @ti.func
    def trial_strain(e, affine, time_step):
        """e* = (I + D)(I + e)(I + D)^T - I with D = dt C, without the cancellation."""
        d = time_step * affine
        m = symmetric(e)
        de = product(d, m)
        return entries(m + d + d.transpose() + de + de.transpose() + product(d + de, d.transpose()))

    @ti.func
    def return_map(trial, mu, yield_stress):
        """Return mapping on the trial eigenvalues.

        Returns the stretches minus one, the Hencky strains after it, the trial's deviator, its norm, and the factor k that the
        deviator was scaled by (0 marks the elastic branch, in which nothing was changed).
        """
        h = vec3(
            half * log1p(ti.max(trial[0], real(smallest_stretch_squared))),
            half * log1p(ti.max(trial[1], real(smallest_stretch_squared))),
            half * log1p(ti.max(trial[2], real(smallest_stretch_squared))),
        )
        mean = real(third) * (h[0] + h[1] + h[2])
        deviator = h - vec3(mean, mean, mean)
        norm = ti.sqrt(deviator.dot(deviator) + real(norm_regularization))
        limit = yield_stress / (two * mu)
        factor = real(zero)
        stretch = vec3(zero, zero, zero)
        if norm > limit:
            factor = limit / norm
            h = vec3(mean, mean, mean) + factor * deviator
            stretch = vec3(expm1(h[0]), expm1(h[1]), expm1(h[2]))
        else:
            floor = real(-one)
            stretch = vec3(
                trial[0] / (one + ti.sqrt(ti.max(one + trial[0], zero))),
                trial[1] / (one + ti.sqrt(ti.max(one + trial[1], zero))),
                trial[2] / (one + ti.sqrt(ti.max(one + trial[2], zero))),
            )
            stretch = vec3(ti.max(stretch[0], floor), ti.max(stretch[1], floor), ti.max(stretch[2], floor))
        return stretch, h, deviator, norm, factor

    @ti.func
    def principal_stress(a, mu, lam):
        """Principal Kirchhoff stresses 2 mu (s-1) s + lambda J (J-1) of stretches s = 1 + a."""
        j1 = a[0] + a[1] + a[2] + a[0] * a[1] + a[0] * a[2] + a[1] * a[2] + a[0] * a[1] * a[2]
        pressure = lam * (one + j1) * j1
        return vec3(
            two * mu * a[0] * (one + a[0]) + pressure,
            two * mu * a[1] * (one + a[1]) + pressure,
            two * mu * a[2] * (one + a[2]) + pressure,
        )

    @ti.func
    def compose(d, u0, u1, u2):
        return d[0] * u0.outer_product(u0) + d[1] * u1.outer_product(u1) + d[2] * u2.outer_product(u2)

    @ti.func
    def elastic_stress(trial, mu, lam, yield_stress):
        """Kirchhoff stress of a small strain inside the yield surface, and whether the trial strain is one.

        2 mu (b - sqrt(b)) + lambda J (J - 1) by power series in e = b - I: most particles, most of the time, and no eigenvectors.
        """
        stress = ti.Matrix.zero(real, 3, 3)
        inside = False
        shear = trial[3] * trial[3] + trial[4] * trial[4] + trial[5] * trial[5]
        if trial[0] * trial[0] + trial[1] * trial[1] + trial[2] * trial[2] + two * shear < real(series_limit):
            e = symmetric(trial)
            e2 = product(e, e)
            e3 = product(e2, e)
            e4 = product(e2, e2)
            hencky = half * e - 0.25 * e2 + real(sixth) * e3 - 0.125 * e4
            mean = real(third) * (hencky[0, 0] + hencky[1, 1] + hencky[2, 2])
            norm = (hencky * hencky).sum() - 3.0 * mean * mean + real(norm_regularization)
            limit = yield_stress / (two * mu)
            if norm <= limit * limit:
                inside = True
                j1 = volume_change(trial)
                pressure = lam * (one + j1) * j1
                stress = (two * mu) * (half * e + 0.125 * e2 - 0.0625 * e3 + 0.0390625 * e4)
                stress = stress + mat33(pressure, zero, zero, zero, pressure, zero, zero, zero, pressure)
        return inside, stress

    @ti.func
    def volume_change(e):
        """J - 1 with J^2 = det(I + e)."""
        minors = e[0] * e[1] + e[0] * e[2] + e[1] * e[2] - e[3] * e[3] - e[4] * e[4] - e[5] * e[5]
        product = e[0] * e[1] * e[2] + two * e[3] * e[4] * e[5] - e[0] * e[5] * e[5] - e[1] * e[4] * e[4] - e[2] * e[3] * e[3]
        d = e[0] + e[1] + e[2] + minors + product
        return d / (one + ti.sqrt(one + d))

    @ti.func
    def elastic_adjoint(trial, mu, lam, grad_new, grad_stress):
        """Gradient (symmetric matrix) with respect to a trial strain that `elastic_stress` accepted."""
        e = symmetric(trial)
        g1 = product(e, grad_stress)
        g2 = product(e, g1)
        g3 = product(e, g2)
        sides = 0.125 * g1 - 0.0625 * g2 + 0.0390625 * (g3 + product(g2, e))
        series = half * grad_stress + sides + sides.transpose() - 0.0625 * product(g1, e)
        j = one + volume_change(trial)
        # d J / d e = cofactor(I + e) / (2 J)
        b0, b1, b2 = one + trial[0], one + trial[1], one + trial[2]
        c01 = trial[4] * trial[5] - trial[3] * b2
        c02 = trial[3] * trial[5] - trial[4] * b1
        c12 = trial[3] * trial[4] - trial[5] * b0
        c00 = b1 * b2 - trial[5] * trial[5]
        c11 = b0 * b2 - trial[4] * trial[4]
        c22 = b0 * b1 - trial[3] * trial[3]
        pull = half / j * lam * (two * j - one) * grad_stress.trace()
        return grad_new + (two * mu) * series + pull * mat33(c00, c01, c02, c01, c11, c12, c02, c12, c22)

    @ti.func
    def material(trial, mu, lam, yield_stress):
        """New elastic strain (six entries) and Kirchhoff stress (matrix) of a trial strain."""
        new = trial
        inside, stress = elastic_stress(trial, mu, lam, yield_stress)
        if not inside:
            values, u0, u1, u2 = eigen(trial)
            a, h, deviator, norm, factor = return_map(values, mu, yield_stress)
            if factor > zero:
                squared = vec3(a[0] * (two + a[0]), a[1] * (two + a[1]), a[2] * (two + a[2]))
                new = entries(compose(squared, u0, u1, u2))
            stress = compose(principal_stress(a, mu, lam), u0, u1, u2)
        return new, stress

    @ti.func
    def stress_of(values, u0, u1, u2, mu, lam, yield_stress):
        """Kirchhoff stress (matrix) after the return mapping of a trial strain, whose eigensystem is given."""
        a, h, deviator, norm, factor = return_map(values, mu, yield_stress)
        return compose(principal_stress(a, mu, lam), u0, u1, u2)

    @ti.func
    def stretch_slope(si, sj, hi, hj, yi, yj, xi, xj, factor):
        """Divided difference (s_i - s_j) / (l_i - l_j) of new stretches over trial eigenvalues, exact where they meet."""
        slope = one / ti.max(si + sj, real(1e-6))
        if factor > zero:
            if xi > real(smallest_stretch_squared) and xj > real(smallest_stretch_squared):
                gap = yi - yj
                slope = half * factor * ti.exp(half * (hi + hj) - (yi + yj)) * sinhc(half * factor * gap) / sinhc(gap)
            else:
                slope = real(zero)
                if ti.abs(xi - xj) > real(1e-6):
                    slope = (si - sj) / (xi - xj)
        return slope

    @ti.func
    def material_adjoint(values, u0, u1, u2, mu, lam, yield_stress, grad_new, grad_stress):
        """Gradient (symmetric matrix) with respect to the trial strain, whose eigensystem is given."""
        a, h, deviator, norm, factor = return_map(values, mu, yield_stress)
        s = vec3(one + a[0], one + a[1], one + a[2])
        j = s[0] * s[1] * s[2]
        gt0, gt1, gt2 = apply(grad_stress, u0), apply(grad_stress, u1), apply(grad_stress, u2)
        ge0, ge1, ge2 = apply(grad_new, u0), apply(grad_new, u1), apply(grad_new, u2)
        t00, t11, t22 = u0.dot(gt0), u1.dot(gt1), u2.dot(gt2)
        e00, e11, e22 = u0.dot(ge0), u1.dot(ge1), u2.dot(ge2)
        # d tau / d s: the pressure lambda J (J-1) depends on every stretch
        pressure = (t00 + t11 + t22) * lam * (two * j - one)
        gs = vec3(
            two * mu * (two * s[0] - one) * t00 + pressure * s[1] * s[2],
            two * mu * (two * s[1] - one) * t11 + pressure * s[0] * s[2],
            two * mu * (two * s[2] - one) * t22 + pressure * s[0] * s[1],
        )
        gl = vec3(zero, zero, zero)
        trial_h = h
        if factor > zero:
            mean = real(third) * (h[0] + h[1] + h[2])
            trial_h = deviator + vec3(mean, mean, mean)
            gh = vec3((gs[0] + two * s[0] * e00) * s[0], (gs[1] + two * s[1] * e11) * s[1], (gs[2] + two * s[2] * e22) * s[2])
            average = real(third) * (gh[0] + gh[1] + gh[2])
            bend = factor / (norm * norm) * gh.dot(deviator)
            for i in ti.static(range(3)):
                if values[i] > real(smallest_stretch_squared):
                    slope = average + factor * (gh[i] - average) - bend * deviator[i]
                    gl[i] = slope * half / (one + values[i])
        else:
            gl = vec3(
                gs[0] * half / ti.max(s[0], real(1e-6)) + e00,
                gs[1] * half / ti.max(s[1], real(1e-6)) + e11,
                gs[2] * half / ti.max(s[2], real(1e-6)) + e22,
            )
        r01 = stretch_slope(s[0], s[1], h[0], h[1], trial_h[0], trial_h[1], values[0], values[1], factor)
        r02 = stretch_slope(s[0], s[2], h[0], h[2], trial_h[0], trial_h[2], values[0], values[2], factor)
        r12 = stretch_slope(s[1], s[2], h[1], h[2], trial_h[1], trial_h[2], values[1], values[2], factor)
        t01, t02, t12 = u0.dot(gt1), u0.dot(gt2), u1.dot(gt2)
        e01, e02, e12 = u0.dot(ge1), u0.dot(ge2), u1.dot(ge2)
        h01 = r01 * (two * mu * (s[0] + s[1] - one) * t01 + (s[0] + s[1]) * e01)
        h02 = r02 * (two * mu * (s[0] + s[2] - one) * t02 + (s[0] + s[2]) * e02)
        h12 = r12 * (two * mu * (s[1] + s[2] - one) * t12 + (s[1] + s[2]) * e12)
        m01 = u0.outer_product(u1)
        m02 = u0.outer_product(u2)
        m12 = u1.outer_product(u2)
        mixed = h01 * m01 + h02 * m02 + h12 * m12
        return compose(gl, u0, u1, u2) + mixed + mixed.transpose()

    @ti.func
    def trial_adjoint(e, affine, time_step, grad_trial):
        """Gradients with respect to the old strain (symmetric matrix) and the affine field, from that of the trial strain."""
        identity = mat33(one, zero, zero, zero, one, zero, zero, zero, one)
        f = identity + time_step * affine
        gf = product(grad_trial, f)
        return product(f.transpose(), gf), (two * time_step) * (gf + product(gf, symmetric(e)))

    return SimpleNamespace(
        symmetric=symmetric,
        entries=entries,
        trial_strain=trial_strain,
        material=material,
        elastic_stress=elastic_stress,
        elastic_adjoint=elastic_adjoint,
        stress_of=stress_of,
        material_adjoint=material_adjoint,
        trial_adjoint=trial_adjoint,
        eigen=eigen,
    )
