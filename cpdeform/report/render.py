"""A small renderer in numpy: clay as the surface of its density, tools as solids, from one camera without perspective.

Points that cover the surfaces are drawn into a depth buffer. The clay's surface is that of `cpdeform.report.surface`, with its
normals, so that a groove a few particles deep is plain to see, where a scatter plot shows a cloud of dots. Crumbs are balls.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cpdeform.report.clay import ClayPoints, clay_points
from cpdeform.report.shapes import covering

Array = NDArray[np.float64]

LIGHT = np.array([-0.55, 0.75, 0.35])
"""Direction to the light in the world frame: low over one side, so that dents throw shade."""

TOOL_COLOUR = np.array([0.27, 0.42, 0.62])
TOOL_OPACITY = 0.72
HIDDEN_OPACITY = 0.2
"""How much of a tool is seen through the clay in front of it."""

INDEX_BITS = 24
SKY = 0.02
"""Width of the surroundings that a place may lie below, as a share of the picture's width."""


@dataclasses.dataclass(frozen=True)
class Camera:
    """An orthographic camera; y of the world is up.

    Attributes:
        azimuth: Direction it looks from, about the y axis, from z towards x, degrees.
        elevation: Direction it looks from, above the horizon, degrees.
        centre: Point in the middle of the picture (3,), length units.
        half_width: Half of the width that is seen, length units.
        half_height: Half of the height that is seen, length units.
    """

    azimuth: float
    elevation: float
    centre: Array
    half_width: float
    half_height: float

    @property
    def axes(self) -> Array:
        """Unit vectors (3, 3) to the right, up, and towards the camera, as rows."""
        azimuth, elevation = np.radians(self.azimuth), np.radians(self.elevation)
        right = np.array([np.cos(azimuth), 0.0, -np.sin(azimuth)])
        towards = np.array([np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)])
        return np.stack([right, np.cross(towards, right), towards])

    def project(self, points: Array) -> Array:
        """Coordinates (..., 3) of points (..., 3): right, up, towards the camera, from the picture's centre, length units."""
        return np.asarray((points - self.centre) @ self.axes.T)


def fit_camera(points: Array, *, azimuth: float, elevation: float, aspect: float, margin: float = 0.08) -> Camera:
    """A camera that sees all points (K, 3).

    Args:
        points: What has to be in the picture, length units.
        azimuth: See `Camera`, degrees.
        elevation: See `Camera`, degrees.
        aspect: Width of the picture divided by its height.
        margin: Free space on each side, as a fraction of the extent.
    """
    view = Camera(azimuth, elevation, np.zeros(3), 1.0, 1.0)
    seen = view.project(points)
    low, high = seen.min(axis=0), seen.max(axis=0)
    half = np.maximum(0.5 * (high - low)[:2], 1e-3) * (1.0 + 2.0 * margin)
    half_height = max(float(half[1]), float(half[0]) / aspect)
    return Camera(azimuth, elevation, (0.5 * (low + high)) @ view.axes, half_height * aspect, half_height)


@dataclasses.dataclass(frozen=True)
class _Layer:
    """Nearest surface at each pixel: depth (H, W) towards the camera (-inf: none) and index (H, W) of its point."""

    depth: Array
    index: NDArray[np.int64]
    mask: NDArray[np.bool_]


def render(
    camera: Camera,
    *,
    width: int,
    particles: Array,
    colours: Array,
    spacing: float | None = None,
    tools: Sequence[Array] = (),
    quality: int = 2,
) -> Array:
    """Draw clay and tools.

    Args:
        camera: From where.
        width: Width of the picture, pixels; its height follows from the camera.
        particles: Positions (N, 3), length units.
        colours: Colours (N, 3), in [0, 1].
        spacing: Edge of the cube that a particle has to itself, length units; defaults to `particle_spacing` of the particles.
        tools: Surfaces (R, C, 3) from `cpdeform.report.shapes.tool_surface`.
        quality: Pixels are averages of `quality` x `quality` samples.

    Returns:
        Picture (H, width, 4) with opacity, colours not premultiplied, in [0, 1].
    """
    shape = (max(round(width * camera.half_height / camera.half_width), 1) * quality, width * quality)
    scale = 0.5 * shape[1] / camera.half_width
    colour, depth = _draw_clay(camera, shape, clay_points(particles, colours, distance=1.0 / scale, spacing=spacing), scale)
    covered = np.isfinite(depth)
    opacity = covered.astype(np.float64)
    for tool in tools:
        layer = _draw_points(camera, shape, covering(tool, distance=1.0 / scale), 1.3 / scale)
        smooth = _fill(layer.depth, layer.mask, 1.0)
        shade = _lambert(camera, smooth, scale)[..., None]
        drawn = np.clip(TOOL_COLOUR * (0.45 + 0.7 * shade) + 0.25 * np.clip(shade, 0.0, 1.0) ** 12, 0.0, 1.0)
        hidden = covered & (layer.depth <= depth)
        share = np.where(layer.mask, np.where(hidden, HIDDEN_OPACITY, TOOL_OPACITY), 0.0)
        total = share + opacity * (1.0 - share)
        weight = np.divide(share, total, out=np.zeros_like(total), where=total > 0.0)[..., None]
        colour = weight * drawn + (1.0 - weight) * colour
        opacity = total
    return _average(colour, opacity, quality)


def _draw_clay(camera: Camera, shape: tuple[int, int], clay: ClayPoints, scale: float) -> tuple[Array, Array]:
    """Colours (H, W, 3) of clay and its depth (H, W), -inf where there is none."""
    colour, depth = np.zeros((*shape, 3)), np.full(shape, -np.inf)
    if len(clay.positions):
        layer = _draw_points(camera, shape, clay.positions, 1.2 / scale)
        shade = np.clip(clay.normals[layer.index] @ _light(), 0.0, 1.0)
        # What lies deeper than its surroundings gets less of the sky's light.
        around = SKY * shape[1]
        sunken = np.clip((_fill(layer.depth, layer.mask, around) - layer.depth) * scale / (1.25 * around), 0.0, 1.0)
        light = (0.42 + 0.68 * shade) * (1.0 - 0.4 * np.where(layer.mask, sunken, 0.0))
        colour, depth = np.clip(clay.colours[layer.index] * light[..., None], 0.0, 1.0), layer.depth
    if len(clay.crumbs):
        layer = _draw_points(camera, shape, clay.crumbs, clay.crumb_radius)
        shade = _lambert(camera, _fill(layer.depth, layer.mask, 0.7), scale)
        front = layer.mask & (layer.depth > depth)
        balls = np.clip(clay.crumb_colours[layer.index] * (0.42 + 0.68 * shade)[..., None], 0.0, 1.0)
        colour, depth = np.where(front[..., None], balls, colour), np.where(front, layer.depth, depth)
    return colour, depth


def _draw_points(camera: Camera, shape: tuple[int, int], points: Array, radius: float) -> _Layer:
    """Draw points as balls into a depth buffer of (H, W) samples."""
    height, width = shape
    scale = 0.5 * width / camera.half_width
    seen = camera.project(points)
    column = np.floor((seen[:, 0] + camera.half_width) * scale).astype(np.int64)
    row = np.floor((camera.half_height - seen[:, 1]) * scale).astype(np.int64)
    low, span = float(seen[:, 2].min()) - radius, float(np.ptp(seen[:, 2])) + 3.0 * radius
    reach = int(np.ceil(radius * scale))
    # Depth and index share one integer, depth in front: the largest is the nearest ball and tells which one it is.
    unit = float(2**36) / span
    buffer = np.full((height + 2 * reach) * (width + 2 * reach), -1, dtype=np.int64)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    number = np.flatnonzero(inside)
    # A border as wide as a ball's radius saves a test at each pixel.
    place = ((row + reach) * (width + 2 * reach) + column + reach)[inside]
    near = seen[inside, 2] - low
    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            bulge = radius**2 - (down**2 + right**2) / scale**2
            if bulge < 0.0:
                continue
            key = (((near + np.sqrt(bulge)) * unit).astype(np.int64) << INDEX_BITS) | number
            np.maximum.at(buffer, place + down * (width + 2 * reach) + right, key)
    buffer = buffer.reshape(height + 2 * reach, width + 2 * reach)[reach : reach + height, reach : reach + width]
    mask = buffer >= 0
    depth = np.where(mask, (buffer >> INDEX_BITS) / unit + low, -np.inf)
    return _Layer(depth, np.where(mask, buffer & (2**INDEX_BITS - 1), 0), mask)


def _fill(values: Array, mask: NDArray[np.bool_], sigma: float) -> Array:
    """Smooth values (H, W) or (H, W, K) over the mask with a Gaussian of `sigma` samples; beyond it they are continued."""
    from scipy.ndimage import gaussian_filter

    channels = values[..., None] if values.ndim == 2 else values
    stack = np.concatenate([np.where(mask[..., None], channels, 0.0), mask[..., None]], axis=-1).astype(np.float32)
    # A wide Gaussian is as good on a coarser grid, and its cost grows with its width in samples.
    coarse = max(int(sigma / 3.0), 1)
    height, width = mask.shape
    if coarse > 1:
        padded = np.pad(stack, ((0, -height % coarse), (0, -width % coarse), (0, 0)))
        rows, columns = padded.shape[0] // coarse, padded.shape[1] // coarse
        stack = padded.reshape(rows, coarse, columns, coarse, -1).mean(axis=(1, 3))
    blurred = gaussian_filter(stack, (sigma / coarse, sigma / coarse, 0.0))
    filled = blurred[..., :-1] / np.maximum(blurred[..., -1:], 1e-6)
    if coarse > 1:
        filled = _enlarge(_enlarge(filled, coarse, height, axis=0), coarse, width, axis=1)
    return np.asarray(filled.reshape(values.shape), dtype=np.float64)


def _enlarge(values: NDArray[np.float32], factor: int, count: int, *, axis: int) -> NDArray[np.float32]:
    """Interpolate linearly along an axis, to the first `count` of the samples that each entry is `factor` of."""
    place = np.clip((np.arange(count, dtype=np.float32) + 0.5) / factor - 0.5, 0, values.shape[axis] - 1)
    lower = np.minimum(place.astype(int), max(values.shape[axis] - 2, 0))
    upper = np.minimum(lower + 1, values.shape[axis] - 1)
    weight = (place - lower).astype(np.float32)
    weight = weight[:, None, None] if axis == 0 else weight[None, :, None]
    return np.asarray(np.take(values, lower, axis=axis) * (1 - weight) + np.take(values, upper, axis=axis) * weight)


def _lambert(camera: Camera, depth: Array, scale: float) -> Array:
    """Cosine (H, W) between the surface's normal and the light, 0 where it is turned away."""
    down, right = np.gradient(depth * scale)
    normal = np.stack([-right, down, np.ones_like(depth)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.asarray(np.clip(normal @ (camera.axes @ _light()), 0.0, 1.0))


def _light() -> Array:
    """Unit vector (3,) to the light in the world frame."""
    return np.asarray(LIGHT / np.linalg.norm(LIGHT))


def _average(colour: Array, opacity: Array, quality: int) -> Array:
    """Average blocks of samples into pixels (H, W, 4)."""
    height, width = opacity.shape[0] // quality, opacity.shape[1] // quality
    premultiplied = np.concatenate([colour * opacity[..., None], opacity[..., None]], axis=-1)
    pixels = premultiplied.reshape(height, quality, width, quality, 4).mean(axis=(1, 3))
    alpha = pixels[..., 3:]
    plain = np.divide(pixels[..., :3], alpha, out=np.zeros_like(pixels[..., :3]), where=alpha > 0.0)
    return np.concatenate([np.clip(plain, 0.0, 1.0), alpha], axis=-1)
