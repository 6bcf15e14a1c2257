"""Types that all kernels share, made once per floating-point type.

The kernels are built by functions of the scalar type, so that the same lines run in float32 (the default) and in float64, both in
one Taichi runtime. A literal has the runtime's default type, float32: those that float32 holds exactly are written as they are,
all others, and the first values of variables, through `real`. Taichi reads annotations as objects, so the kernel modules do
without postponed annotations.
"""

import functools
from types import SimpleNamespace
from typing import Any

from cpdeform.backends.taichi.runtime import ti

POSITION, VELOCITY, AFFINE, STRAIN, RECORD_SIZE = 0, 3, 6, 15, 21
"""Where a particle's record holds its position (3), velocity (3), affine field (9, by rows), elastic strain (6); its length."""

(
    TIME_STEP,
    NODE_DISTANCE,
    INVERSE_DISTANCE,
    PARTICLE_MASS,
    STRESS_SCALE,
    SOFTNESS,
    GROUND_FRICTION,
    GRAVITY,
) = range(8)
LOWER, UPPER, GRIDS = GRAVITY + 3, GRAVITY + 6, GRAVITY + 9
"""Where the array of the scene's constants holds them, see `load_parameters`, and after them the numbers of tools from meshes."""

GRID_SIZE, GROUND_NODES, TOOL_COUNT, WORLDS, PARTICLES, BLOCKS, LANES, ORIGIN = range(8)
BOX_SIZE = ORIGIN + 3
"""Where the array of whole numbers holds the scene's, those of the launch, and the box of nodes that the grid covers."""

TOOL_SIZE, TOOL_FRICTION, TOOL_SCALE, TOOL_LOWER, TOOL_UPPER = 0, 4, 5, 12, 15
TOOL_KIND, TOOL_ACTION_OFFSET, TOOL_ACTION_SIZE, TOOL_GRID_FIRST, TOOL_VALUES = 18, 19, 20, 21, 22
"""Where a tool's record holds its lengths (4), friction, motions per substep (7), bounds (3 each) and whole numbers."""


@functools.cache
def build_types(real: Any) -> SimpleNamespace:
    """Vector types and structs for one scalar type.

    Args:
        real: `ti.f32` or `ti.f64`.

    Returns:
        vec3, vec4, vec6, vec7, vec8, mat33, vec3i, the records `record` (a particle's) and `tool`, `array(element, axes)`, the
        annotation of a tensor, and functions: products of matrices, and loading the scene's constants, a grid's box, a tool.
    """
    vec3, vec4, vec7, vec3i = (
        ti.types.vector(3, real),
        ti.types.vector(4, real),
        ti.types.vector(7, real),
        ti.types.vector(3, ti.i32),
    )
    mat33 = ti.types.matrix(3, 3, real)
    parameters = ti.types.struct(
        time_step=real,  # seconds
        node_distance=real,  # dx, length
        inverse_distance=real,  # 1 / dx
        particle_mass=real,  # also the particle volume, density is 1
        stress_scale=real,  # -dt volume 4 / dx^2
        softness=real,  # 1 / length
        ground_friction=real,
        gravity=vec3,  # length / second^2
        lower=vec3,  # positions are clipped to these corners
        upper=vec3,
        grid_size=ti.i32,
        ground_nodes=ti.i32,  # nodes below this number are the floor's boundary layer
        tool_count=ti.i32,
    )
    box = ti.types.struct(origin=vec3i, size=vec3i, nodes=ti.i32)
    described = ti.types.struct(
        kind=ti.i32,
        size=vec4,  # see kernels_distance
        friction=real,
        action_offset=ti.i32,
        action_size=ti.i32,
        grid_first=ti.i32,  # where its numbers begin in `values`
        scale=vec7,  # motion per substep at action 1: length, radians
        lower=vec3,
        upper=vec3,
    )

    @ti.func
    def load_parameters(values: ti.template(), numbers: ti.template()):
        return parameters(
            time_step=values[TIME_STEP],
            node_distance=values[NODE_DISTANCE],
            inverse_distance=values[INVERSE_DISTANCE],
            particle_mass=values[PARTICLE_MASS],
            stress_scale=values[STRESS_SCALE],
            softness=values[SOFTNESS],
            ground_friction=values[GROUND_FRICTION],
            gravity=vec3(values[GRAVITY], values[GRAVITY + 1], values[GRAVITY + 2]),
            lower=vec3(values[LOWER], values[LOWER + 1], values[LOWER + 2]),
            upper=vec3(values[UPPER], values[UPPER + 1], values[UPPER + 2]),
            grid_size=numbers[GRID_SIZE],
            ground_nodes=numbers[GROUND_NODES],
            tool_count=numbers[TOOL_COUNT],
        )

    @ti.func
    def load_box(numbers: ti.template()):
        size = vec3i(numbers[BOX_SIZE], numbers[BOX_SIZE + 1], numbers[BOX_SIZE + 2])
        return box(
            origin=vec3i(numbers[ORIGIN], numbers[ORIGIN + 1], numbers[ORIGIN + 2]),
            size=size,
            nodes=size[0] * size[1] * size[2],
        )

    @ti.func
    def load_tool(tools: ti.template(), index):
        record = tools[index]
        return described(
            kind=ti.cast(record[TOOL_KIND], ti.i32),
            size=vec4(record[TOOL_SIZE], record[TOOL_SIZE + 1], record[TOOL_SIZE + 2], record[TOOL_SIZE + 3]),
            friction=record[TOOL_FRICTION],
            action_offset=ti.cast(record[TOOL_ACTION_OFFSET], ti.i32),
            action_size=ti.cast(record[TOOL_ACTION_SIZE], ti.i32),
            grid_first=ti.cast(record[TOOL_GRID_FIRST], ti.i32),
            scale=vec7([record[TOOL_SCALE + a] for a in range(7)]),
            lower=vec3(record[TOOL_LOWER], record[TOOL_LOWER + 1], record[TOOL_LOWER + 2]),
            upper=vec3(record[TOOL_UPPER], record[TOOL_UPPER + 1], record[TOOL_UPPER + 2]),
        )

    @ti.func
    def product(a, b):
        """Product of 3x3 matrices; Taichi's own takes four times as long to compile."""
        b0, b1, b2 = vec3(b[0, 0], b[0, 1], b[0, 2]), vec3(b[1, 0], b[1, 1], b[1, 2]), vec3(b[2, 0], b[2, 1], b[2, 2])
        r0 = a[0, 0] * b0 + a[0, 1] * b1 + a[0, 2] * b2
        r1 = a[1, 0] * b0 + a[1, 1] * b1 + a[1, 2] * b2
        r2 = a[2, 0] * b0 + a[2, 1] * b1 + a[2, 2] * b2
        return mat33(r0[0], r0[1], r0[2], r1[0], r1[1], r1[2], r2[0], r2[1], r2[2])

    @ti.func
    def apply(m, v):
        """Product of a 3x3 matrix and a vector."""
        c0, c1, c2 = vec3(m[0, 0], m[1, 0], m[2, 0]), vec3(m[0, 1], m[1, 1], m[2, 1]), vec3(m[0, 2], m[1, 2], m[2, 2])
        return v[0] * c0 + v[1] * c1 + v[2] * c2

    def array(element: Any, axes: int = 1) -> Any:
        return ti.types.ndarray(dtype=element, ndim=axes)

    return SimpleNamespace(
        vec3=vec3,
        vec4=vec4,
        vec6=ti.types.vector(6, real),
        vec8=ti.types.vector(8, real),
        mat33=mat33,
        record=ti.types.vector(RECORD_SIZE, real),
        tool=ti.types.vector(TOOL_VALUES, real),
        vec3i=vec3i,
        array=array,
        product=product,
        apply=apply,
        load_parameters=load_parameters,
        load_box=load_box,
        load_tool=load_tool,
    )
