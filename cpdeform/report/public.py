"""`cpdeform.render`: a picture of a state, in one call."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.scene import Scene
from cpdeform.core.state import State
from cpdeform.report.pictures import CLAY, PANEL_ASPECT, direction_of
from cpdeform.report.render import Camera, fit_camera
from cpdeform.report.render import render as render_points
from cpdeform.report.shapes import tool_surface

Array = NDArray[np.float64]
WIDEST = 8192


def render(
    state: State | Tensor | Array,
    *,
    scene: Scene | None = None,
    camera: Camera | str | tuple[float, float] = "default",
    width: int = 640,
    values: Tensor | Array | None = None,
) -> NDArray[np.uint8]:
    """Draw clay, and the tools if there is a scene that says what they are.

    Args:
        state: A state of a single world, or particle positions (N, 3), length units.
        scene: Its scene; None for no tools.
        camera: ``"default"``, ``"front"``, ``"side"``, ``"top"``, ``"back"``, or azimuth and elevation in degrees, which see
            everything; or a camera, so that several pictures are seen alike.
        width: Width of the picture, pixels.
        values: A number for each particle (N,) to colour by, from dark to bright; defaults to its height.

    Returns:
        Picture (H, width, 3) on white.

    Raises:
        InputError: There is more than one world, nothing to draw, or an argument that does not fit.
    """
    from matplotlib import colormaps
    from matplotlib.colors import LinearSegmentedColormap

    if not (isinstance(width, int) and 1 <= width <= WIDEST):
        raise InputError("width", came=repr(width), expected=f"1 to {WIDEST} pixels")
    particles, poses = _parts(state)
    numbers = particles[:, 1] if values is None else _array(values).reshape(-1)
    if len(numbers) != len(particles):
        raise InputError("values", came=f"{len(numbers)} numbers", expected=f"one for each of {len(particles)} particles")
    tools = []
    if scene is not None and poses is not None:
        tools = [tool_surface(tool, pose) for tool, pose in zip(scene.tools, poses, strict=True)]
    if not isinstance(camera, Camera):
        azimuth, elevation = direction_of(camera)
        everything = np.concatenate([particles, *(surface.reshape(-1, 3) for surface in tools)])
        camera = fit_camera(everything, azimuth=azimuth, elevation=elevation, aspect=PANEL_ASPECT)
    low, high = float(np.nanmin(numbers)), float(np.nanmax(numbers))
    palette = LinearSegmentedColormap.from_list("clay", CLAY) if values is None else colormaps["viridis"]
    colours = np.asarray(palette((numbers - low) / max(high - low, 1e-12))[:, :3])
    picture = render_points(camera, width=width, particles=particles, colours=colours, tools=tools)
    opacity = picture[..., 3:]
    return np.asarray(np.round(255.0 * (picture[..., :3] * opacity + 1.0 - opacity)), dtype=np.uint8)


def _parts(state: State | Tensor | Array) -> tuple[Array, Array | None]:
    """Particles (N, 3) and tool poses (M, 8) of a state; positions alone have no tools."""
    if isinstance(state, State):
        if state.batch_size != 1:
            remedy = "Use state.select(world)."
            raise InputError("state", came=f"{state.batch_size} worlds", expected="a single world", remedy=remedy)
        return _finite(_array(state.position[0])), _array(state.tool_pose[0])
    return _finite(_array(state)), None


def _finite(positions: Array) -> Array:
    if positions.ndim != 2 or positions.shape[1] != 3 or not len(positions) or not np.isfinite(positions).all():
        raise InputError("state", came=f"positions of shape {positions.shape}", expected="a state, or finite positions (N, 3)")
    return positions


def _array(values: Any) -> Array:
    plain = values.detach().cpu().numpy() if isinstance(values, Tensor) else values
    return np.asarray(plain, dtype=np.float64)
