"""Types that all kernels share, made once per floating-point type.

The kernels are built by functions of the scalar type, so that the same lines run in float32 (the default) and in float64 (for
finite differences and for targets that are reproducible bit for bit). Warp reads annotations as objects, so the kernel modules
do without postponed annotations.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

KERNEL_OPTIONS: dict[str, Any] = {
    "enable_backward": False,
    "module": "unique",
    "module_options": {"enable_backward": False},
}
"""Options of every kernel: adjoints are written by hand, so Warp makes none."""


@functools.cache
def build_types(real: Any) -> SimpleNamespace:
    """Vector types and structs for one scalar type.

    Args:
        real: `wp.float32` or `wp.float64`.

    Returns:
        vec3, vec4, vec6, vec7, vec8, mat33, the struct `Parameters` (the scene's constants) and the struct `Tool` (a tool).
    """
    vec3 = wp.types.vector(3, real)
    vec4 = wp.types.vector(4, real)
    vec6 = wp.types.vector(6, real)
    vec7 = wp.types.vector(7, real)
    vec8 = wp.types.vector(8, real)
    mat33 = wp.types.matrix((3, 3), real)

    @wp.struct
    class Parameters:
        time_step: real  # seconds
        node_distance: real  # dx, length
        inverse_distance: real  # 1 / dx
        particle_mass: real  # also the particle volume, density is 1
        stress_scale: real  # -dt volume 4 / dx^2
        gravity: vec3  # length / second^2
        softness: real  # 1 / length
        ground_friction: real
        ground_nodes: int  # nodes below this number are the floor's boundary layer
        lower: vec3  # positions are clipped to these corners
        upper: vec3
        grid_size: int
        tool_count: int
        grids: wp.array(dtype=real)  # numbers of all tools made from meshes

    @wp.struct
    class Tool:
        kind: int
        size: vec4  # see kernels_distance
        friction: real
        action_offset: int
        action_size: int
        scale: vec7  # motion per substep at action 1: length, radians
        lower: vec3
        upper: vec3
        grid_first: int  # where its numbers begin in `grids`

    return SimpleNamespace(
        real=real, vec3=vec3, vec4=vec4, vec6=vec6, vec7=vec7, vec8=vec8, mat33=mat33, Parameters=Parameters, Tool=Tool
    )
