"""Goals from meshes: of the clay's volume, on the floor, filled evenly."""

from __future__ import annotations

import numpy as np

from cpdeform.core.errors import InputError
from cpdeform.core.meshes.filling import fill_evenly
from cpdeform.core.meshes.mesh import Array, Mesh
from cpdeform.core.scene import Scene


def clay_volume(scene: Scene) -> float:
    """Volume of a scene's bodies, cubic length units."""
    return sum(body.volume for body in scene.bodies)


def clay_foot(scene: Scene) -> Array:
    """The point (3,) under the middle of a scene's bodies where clay comes to rest, length units."""
    lower = np.min([np.subtract(body.position, body.half_extents) for body in scene.bodies], axis=0)
    upper = np.max([np.add(body.position, body.half_extents) for body in scene.bodies], axis=0)
    foot = 0.5 * (lower + upper)
    foot[1] = scene.resting_height
    return np.asarray(foot)


def fitted_to_clay(mesh: Mesh, scene: Scene, *, argument: str = "goal") -> Mesh:
    """The mesh with the clay's volume, standing on the floor where the clay is.

    Args:
        mesh: The goal's shape, of any size.
        scene: Its bodies are the clay.
        argument: What the mesh is, for messages.

    Raises:
        InputError: It holds no volume, or is too large for the domain at that volume.
    """
    volume, wanted = mesh.volume(), clay_volume(scene)
    if not volume > 0.0:
        raise InputError(argument, came="a mesh without volume", expected="a solid")
    fitted = mesh.scaled((wanted / volume) ** (1.0 / 3.0)).standing_on(clay_foot(scene))
    (lower, upper), domain = fitted.corners, scene.domain
    if (lower < np.asarray(domain[0]) - 1e-9).any() or (upper > np.asarray(domain[1]) + 1e-9).any():
        size = " x ".join(f"{edge:.3g}" for edge in fitted.extents)
        raise InputError(
            argument,
            came=f"a shape that is {size} at the clay's volume of {wanted:.3g}, from {_text(lower)} to {_text(upper)}",
            expected=f"one within {_text(np.asarray(domain[0]))} and {_text(np.asarray(domain[1]))}",
            remedy="Take less clay or move it to the middle; or a goal that is less thin and long.",
        )
    return fitted


def mesh_goal(mesh: Mesh, scene: Scene, *, argument: str = "goal") -> Array:
    """Goal particles (N, 3) of a mesh, as many as the clay has, length units; see `fitted_to_clay`."""
    return fill_evenly(fitted_to_clay(mesh, scene, argument=argument), scene.particle_count)


def _text(point: Array) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in point) + ")"
