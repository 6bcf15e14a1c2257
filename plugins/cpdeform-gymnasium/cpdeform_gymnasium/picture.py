"""Pictures of environments: clay shaded by its height, tools in front."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from cpdeform.core.scene import Scene
from cpdeform.core.state import State, tool_pose

RENDER_MODE = "rgb_array"
FRAMES_PER_SECOND = 6
WIDTH = 480
"""Width of a picture, pixels."""

AZIMUTH, ELEVATION, ASPECT = 28.0, 42.0, 1.15
CLAY = np.array([[0.357, 0.173, 0.114], [0.659, 0.376, 0.235], [0.863, 0.647, 0.467], [0.973, 0.902, 0.800]])
"""Colours of the clay from low to high."""


class Painter:
    """Draws states of one scene, all from the same place.

    Args:
        scene: Its tools.
        goal: Goal particles (M, 3), length units: the picture has room for them.
    """

    def __init__(self, scene: Scene, goal: Tensor) -> None:
        from cpdeform.core.sampling import sample_particles
        from cpdeform.report.render import fit_camera
        from cpdeform.report.surface import particle_spacing

        self._scene = scene
        clay = np.concatenate([sample_particles(scene), goal.detach().double().cpu().numpy()])
        tools = self._surfaces(tool_pose(scene).numpy(), rows=16, columns=32)
        seen = np.concatenate([clay, *(surface.reshape(-1, 3) for surface in tools)])
        # Room for tools and clay to move.
        centre, half = 0.5 * (seen.min(axis=0) + seen.max(axis=0)), 0.6 * (seen.max(axis=0) - seen.min(axis=0))
        corners = centre + half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        self._camera = fit_camera(corners, azimuth=AZIMUTH, elevation=ELEVATION, aspect=ASPECT)
        self._low, self._high = float(clay[:, 1].min()), float(clay[:, 1].max())
        self._spacing = particle_spacing(sample_particles(scene))

    def paint(self, state: State) -> NDArray[np.uint8]:
        """A picture (H, W, 3) of a single world."""
        from cpdeform.report.render import render

        particles = state.position[0].detach().double().cpu().numpy()
        tools = self._surfaces(state.tool_pose[0].detach().double().cpu().numpy(), rows=160, columns=240)
        height = (particles[:, 1] - self._low) / max(self._high - self._low, 1e-9)
        stops = np.linspace(0.0, 1.0, len(CLAY))
        colours = np.stack([np.interp(height, stops, CLAY[:, channel]) for channel in range(3)], axis=-1)
        picture = render(
            self._camera, width=WIDTH, particles=particles, colours=colours, spacing=self._spacing, tools=tools, quality=1
        )
        alpha = picture[..., 3:]
        return np.asarray(np.rint(255.0 * (alpha * picture[..., :3] + 1.0 - alpha)), dtype=np.uint8)

    def _surfaces(self, poses: NDArray[Any], *, rows: int, columns: int) -> list[NDArray[np.float64]]:
        from cpdeform.report.shapes import tool_surface

        tools = zip(self._scene.tools, poses, strict=True)
        return [tool_surface(tool, pose, rows=rows, columns=columns) for tool, pose in tools]
