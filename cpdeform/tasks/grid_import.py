"""Particles from node masses: PlasticineLab's published goals are grids, ours are particles.

A grid of node masses is what particles leave after they were smoothed by the quadratic B-spline. Sampled as if it were a density,
it would be smoothed twice. So the density that explains the masses is estimated first (Richardson-Lucy), particles are spread
over it evenly, and then moved until their own node masses are the published ones (least squares, with a weak repulsion that
chooses the evenest of the many clouds that fit).
"""

from __future__ import annotations

import dataclasses
import re
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from cpdeform.core.bounded import MOST_PARTICLES
from cpdeform.core.errors import InputError, UnknownNameError
from cpdeform.core.goal import POSITION_SCALE, dense_grid, write_goal
from cpdeform.core.plugins import Registry, load_registry
from cpdeform.core.reading.arrays import MOST_NUMBER, NUMBERS, ArrayFile, open_arrays
from cpdeform.core.reading.limits import ReadingLimits
from cpdeform.core.scene import Scene
from cpdeform.core.task import Task, load_task
from cpdeform.planning.objectives.mass import mass_grid

PLASTICINELAB_NAMES = {
    "Move3D": "move",
    "TripleMove3D": "triple-move",
    "Torus3D": "torus",
    "Rope3D": "rope",
    "Rollingpin3D": "rolling-pin",
    "Chopsticks3D": "chopsticks",
    "Assembly3D": "assembly",
    "Table3D": "table",
    "Writer3D": "writer",
    "Pinch3D": "pinch",
    "multistage_move": "move++",
    "multistage_rope": "rope++",
    "multistage_writer": "writer++",
}
"""PlasticineLab's names of scenes, and the tasks made after them; ``Move3D-v2`` is ``move-v2``."""

_DECONVOLUTIONS = 50
_ROUNDS = 3
_ITERATIONS = 60  # of L-BFGS a round; neighbours are looked up anew between rounds
_REPULSION = 0.02  # in squared particles per node; smaller from round to round
_LEAST_NEGATIVE, _NEGATIVE_SHARE = 0.05, 0.01  # negative masses up to these shares of the largest and of the sum are rounding
_REACH = 0.9  # of the mean distance of neighbours: how far repulsion reaches


@dataclasses.dataclass(frozen=True)
class ImportedGrid:
    """A goal made from node masses.

    Attributes:
        name: Name in the archive; of the file, where it holds a single grid.
        task: Name of the task that it is a goal of.
        path: The goal file; None where none was written.
        position: Particles (N, 3), length units, as the file holds them (rounded to 2^-16).
        grid: Node masses (G, G, G), mass units, scaled to the mass of N particles.
        error: Relative error sum |m - m*| / sum m* of the particles' own node masses m.
        seconds: Wall time.
        scene: Scene that it is for.
    """

    name: str
    task: str
    path: Path | None
    position: NDArray[np.float64]
    grid: NDArray[np.float64]
    error: float
    seconds: float
    scene: Scene


def read_grids(path: Path, *, limits: ReadingLimits | None = None) -> dict[str, NDArray[np.float64]]:
    """Read all node masses of a file.

    Args:
        path: A dense ``.npy`` (G, G, G); or an ``.npz`` of dense arrays, or of pairs ``<name>/cells`` (K, 3), node indices, and
            ``<name>/count`` (K,), node masses, on a grid of 64 nodes an axis.
        limits: How large it may be; defaults to `cpdeform.core.reading.limits.default_limits`.

    Returns:
        Node masses (G, G, G) by name, in the file's own mass unit; of a ``.npy``, the file's name without its ending.

    Raises:
        InputError: The file is missing or unreadable, or holds no node masses.
    """
    argument = f"grid file {path}"
    expected = "an .npy or .npz file of node masses"
    with open_arrays(path, argument=argument, expected=expected, limits=limits) as file:
        grids, headers = {}, {key: file.header(key) for key in file.names or (path.stem,)}
        for key, header in headers.items():
            name, _, kind = key.rpartition("/")
            if kind == "cells" and f"{name}/count" in headers:
                grids[name] = _dense(file, name, f"{argument}: {name}")
            elif len(header.shape) == 3 and header.dtype.kind in NUMBERS:
                grids[key] = file.read(key, shape=None, finite=False).astype(np.float64)
    if not grids:
        raise InputError(
            argument,
            came=", ".join(f"{key} {header.shape}" for key, header in list(headers.items())[:5]) or "no array",
            expected="node masses: a dense array (64, 64, 64), or <name>/cells (K, 3) and <name>/count (K,)",
        )
    return grids


def _dense(file: ArrayFile, name: str, argument: str, size: int = 64) -> NDArray[np.float64]:
    count = file.header(f"{name}/count").shape
    cells = file.read(f"{name}/cells", shape=(*count, 3), kinds="ui", meaning="node indices")
    return dense_grid(cells, file.read(f"{name}/count", shape=count[:1], finite=False), size, argument=argument)


def choose_grid(grids: dict[str, NDArray[np.float64]], name: str | None, *, path: Path) -> str:
    """Name of the grid that was asked for, or of the only one.

    Raises:
        UnknownNameError: There is none of that name.
        InputError: No name was given, and there are several.
    """
    if name is None and len(grids) == 1:
        return next(iter(grids))
    if name is None:
        known = ", ".join(sorted(grids))
        raise InputError("--name", came="none", expected=f"one of the {len(grids)} grids in {path}: {known}")
    if name not in grids:
        raise UnknownNameError(f"grid in {path}", name, grids)
    return name


def task_name(name: str) -> str | None:
    """Name of the task whose goal a grid of PlasticineLab is, e.g. ``"move-v2"`` for ``"Move3D-v2"``; None where there is none.

    The three grids of ``Pinch3D`` are goals of ``"pinch"``, a task without variants.
    """
    goal = goal_name(name)
    return "pinch" if goal is not None and goal.startswith("pinch-") else goal


def goal_name(name: str) -> str | None:
    """What `import_grids` calls the goal of a grid: the task's name, with the variant of PlasticineLab's that it is of."""
    match = re.fullmatch(r"(.+?)(-v\d+)?", name)
    if match is None or match[1] not in PLASTICINELAB_NAMES:
        return None
    task, variant = PLASTICINELAB_NAMES[match[1]], match[2] or ""
    return task if task.endswith("++") else f"{task}{variant}"


def import_grid(
    grid: NDArray[np.floating[Any]],
    task: Task,
    *,
    name: str = "grid",
    path: Path | None = None,
    particles: int | None = None,
    seed: int = 0,
) -> ImportedGrid:
    """Make a goal of node masses, some ten seconds of one core for 10,000 particles.

    Args:
        grid: Node masses (G, G, G) in any mass unit.
        task: Its scene gives grid, domain, and the number of particles.
        name: For messages and the result.
        path: Goal file to write, if any; its directory is made if missing.
        particles: Number of particles; defaults to the task's body's.
        seed: Seed of the sample.

    Raises:
        InputError: The masses do not fit the scene, or `particles` is not positive, or the file cannot be written.
    """
    began = time.perf_counter()
    scene = task.scene
    count = scene.particle_count if particles is None else particles
    if not 1 <= count <= MOST_PARTICLES:
        raise InputError("--particles", came=str(count), expected=f"at least 1, at most {MOST_PARTICLES}")
    counts = _check_grid(grid, scene, name=name)
    counts *= count / counts.sum()
    positions = fit_particles(counts, scene, count=count, seed=seed)
    stored = np.clip(np.rint(positions * POSITION_SCALE), 0, POSITION_SCALE - 1) / POSITION_SCALE
    masses = mass_grid(torch.as_tensor(stored), scene).numpy() / scene.particle_volume
    error = float(np.abs(masses - counts).sum() / counts.sum())
    scaled = counts * scene.particle_volume
    if path is not None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_goal(path, stored, grid=scaled)
        except OSError as problem:
            came = f"a path that cannot be written ({problem.strerror or problem})"
            raise InputError(f"goal file {path}", came=came, expected="a writable path") from problem
    return ImportedGrid(name, task.name, path, stored, scaled, error, time.perf_counter() - began, task.scene)


def import_grids(
    file: Path,
    directory: Path,
    names: Sequence[str] | None = None,
    *,
    seed: int = 0,
    overwrite: bool = False,
    registry: Registry | None = None,
    on_imported: Callable[[ImportedGrid], None] | None = None,
) -> list[ImportedGrid]:
    """Make the goals of all grids of an archive: ``directory/<goal name>.npz``, see `goal_name`.

    Args:
        file: As for `read_grids`; its names are PlasticineLab's, see `PLASTICINELAB_NAMES`.
        directory: Where to write; made if missing.
        names: Grids to import; defaults to all that have a task.
        seed: Seed of the samples.
        overwrite: Replace files that are there.
        registry: Where tasks are looked up; defaults to the installed plugins.
        on_imported: Called after each, for progress.

    Raises:
        InputError: The file or a grid cannot be used, a name has no task, or a file is there already.
    """
    registry = registry or load_registry()
    grids = read_grids(file)
    chosen = [choose_grid(grids, name, path=file) for name in names] if names is not None else list(grids)
    jobs = []
    for name in chosen:
        task = task_name(name)
        if task is None and names is not None:
            raise UnknownNameError("scene of PlasticineLab", name, PLASTICINELAB_NAMES)
        if task is not None:
            jobs.append((name, load_task(task, registry=registry), directory / f"{goal_name(name)}.npz"))
    if not jobs:
        expected = "names of PlasticineLab's scenes, such as Move3D-v1"
        raise InputError(f"grid file {file}", came=f"grids named {', '.join(chosen[:5])}", expected=expected)
    for _, _, path in jobs:
        check_output(path, overwrite=overwrite)
    results = []
    for name, found, path in jobs:
        results.append(import_grid(grids[name], found, name=name, path=path, seed=seed))
        if on_imported is not None:
            on_imported(results[-1])
    return results


def check_output(path: Path, *, overwrite: bool) -> None:
    """Raise `InputError` where a goal file is there already, unless it may be replaced."""
    if path.is_dir() or (path.exists() and not overwrite):
        remedy = "" if path.is_dir() else "Replace it with --overwrite."
        raise InputError("--out", came=f"{path}, which exists", expected="a path of a new file", remedy=remedy)


def _check_grid(grid: NDArray[Any], scene: Scene, *, name: str) -> NDArray[np.float64]:
    argument, shape = f"grid {name}", (scene.grid_size,) * 3
    if grid.shape != shape:
        raise InputError(argument, came=f"shape {grid.shape}", expected=f"{shape}, the grid of the task's scene")
    values = grid.astype(np.float64)
    if not (np.abs(values) <= MOST_NUMBER).all() or not values.max() > 0.0:
        raise InputError(
            argument, came="negative, non-finite, huge or no masses", expected="finite masses of at least 0, not all 0"
        )
    lowest, highest = float(values.min()), float(values.max())
    negative, total = -float(values[values < 0.0].sum()), float(values[values > 0.0].sum())
    if -lowest >= _LEAST_NEGATIVE * highest or negative >= _NEGATIVE_SHARE * total:
        came = f"negative masses (down to {lowest:.3g} beside {highest:.3g}, {negative / total:.2g} of the total)"
        expected = (
            f"masses of at least 0, but for rounding (below {_LEAST_NEGATIVE:.0%} of the largest, {_NEGATIVE_SHARE:.0%} of all)"
        )
        raise InputError(argument, came=came, expected=expected)
    if lowest < 0.0:
        count = int((values < 0.0).sum())
        warnings.warn(
            f"{argument}: {count} negative masses, {negative / total:.2g} of the total, are taken for rounding and count as 0.",
            stacklevel=3,
        )
    return np.maximum(values, 0.0)


def fit_particles(counts: NDArray[np.float64], scene: Scene, *, count: int, seed: int) -> NDArray[np.float64]:
    """Positions (N, 3), length units, in the scene's domain, whose node masses are given.

    Args:
        counts: Node masses (G, G, G) in particle masses; they sum to `count`.
        scene: Grid and domain.
        count: Number of particles N.
        seed: Seed of the sample.
    """
    from scipy.optimize import minimize
    from scipy.spatial import cKDTree

    size = scene.grid_size
    lower, upper = (np.asarray(corner) * size for corner in scene.domain)
    upper = np.minimum(upper, size * (1.0 - 1.0 / POSITION_SCALE))
    points = np.clip(_spread(_deconvolve(counts), count=count, seed=seed), lower, upper)
    wanted = torch.as_tensor(counts)
    bounds = np.stack([np.tile(lower, count), np.tile(upper, count)], axis=1)
    for index in range(_ROUNDS):
        weight = _REPULSION * 0.1**index
        neighbours = cKDTree(points)
        spacing = float(np.median(neighbours.query(points, k=min(2, count))[0][:, -1])) if count > 1 else 0.0
        reach = max(_REACH * (count / max((counts > 0.5 * counts.max()).sum(), 1)) ** (-1.0 / 3.0), spacing)
        pairs = torch.as_tensor(neighbours.query_pairs(1.5 * reach, output_type="ndarray").astype(np.int64))
        result = minimize(
            _misfit,
            points.reshape(-1),
            args=(wanted, scene, pairs, reach, weight),
            jac=True,
            method="L-BFGS-B",
            bounds=bounds,
            options={"maxiter": _ITERATIONS, "maxcor": 20, "ftol": 1e-12, "gtol": 1e-9},
        )
        points = np.clip(result.x.reshape(-1, 3), lower, upper)
    return points / size


def _misfit(
    flat: NDArray[np.float64], wanted: torch.Tensor, scene: Scene, pairs: torch.Tensor, reach: float, weight: float
) -> tuple[float, NDArray[np.float64]]:
    """Squared error of the node masses plus repulsion of near pairs, and the gradient; positions (3 N,) in node distances."""
    points = torch.tensor(flat).reshape(-1, 3).requires_grad_(True)
    counts = mass_grid(points / scene.grid_size, scene) / scene.particle_volume
    loss = ((counts - wanted) ** 2).sum()
    distance = (points[pairs[:, 0]] - points[pairs[:, 1]]).square().sum(dim=1).add(1e-12).sqrt()
    loss = loss + weight * (1.0 - distance / reach).clamp_min(0.0).square().sum()
    loss.backward()  # type: ignore[no-untyped-call]
    assert points.grad is not None
    return float(loss.detach()), points.grad.reshape(-1).numpy()


def _deconvolve(counts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Particles per node's cube (G, G, G) that, uniform within a cube and smoothed by the B-spline, leave these node masses."""
    from scipy.ndimage import convolve1d

    def smoothed(values: NDArray[np.float64]) -> NDArray[np.float64]:
        # The cubic B-spline at the nodes: the box of a cube, smoothed by the quadratic one.
        for axis in range(3):
            values = convolve1d(values, [1 / 6, 2 / 3, 1 / 6], axis=axis, mode="constant")
        return values

    density = counts.copy()
    for _ in range(_DECONVOLUTIONS):
        density *= smoothed(counts / np.maximum(smoothed(density), 1e-12))
    return density


def _spread(density: NDArray[np.float64], *, count: int, seed: int) -> NDArray[np.float64]:
    """An even sample (N, 3), in node distances, of a density (G, G, G) that is constant within the cube around each node."""
    from scipy.stats import qmc

    nodes = np.argwhere(density > 1e-9 * density.max())
    nodes = nodes[np.argsort(_morton(nodes), kind="stable")]
    cumulative = np.cumsum(density[tuple(nodes.T)])
    quantiles = (np.arange(count) + 0.5) / count * cumulative[-1]
    chosen = np.searchsorted(cumulative, quantiles).clip(max=len(nodes) - 1)
    offsets = qmc.Halton(3, seed=np.random.default_rng(seed)).random(count)
    return np.asarray(nodes[chosen] + offsets - 0.5)


def _morton(nodes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Place of each node (K, 3) on a curve through neighbouring nodes, so that equal steps of mass are spread evenly in space."""
    code = np.zeros(len(nodes), dtype=np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((nodes[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code
