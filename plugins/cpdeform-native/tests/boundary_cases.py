"""Arguments of the extension's entry points, right ones and all sorts of wrong ones, with a fixed seed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cpdeform_native import _simulator, _transport

Arguments = dict[str, Any]

PARTICLES = 37
WORLDS, STEPS = 2, 3


def scene_arguments(**changes: Any) -> Arguments:
    node_distance = 1.0 / 16
    arguments: Arguments = {
        "time_step": 1e-4,
        "node_distance": node_distance,
        "particle_mass": (0.5 * node_distance) ** 2,
        "gravity": (0.0, -30.0, 0.0),
        "softness": 666.0,
        "ground_friction": 1.5,
        "ground_nodes": 3,
        "wall_nodes": 3,
        "lower": (0.0, 0.0, 0.0),
        "upper": (0.8, 0.8, 0.8),
        "grid_size": 16,
        "substeps": 3,
        "particle_count": PARTICLES,
    }
    return arguments | changes


def tool_arguments(**changes: Any) -> Arguments:
    arguments: Arguments = {
        "kind": 0,
        "size": (0.05, 0.0, 0.0, 0.0),
        "friction": 0.9,
        "action_size": 6,
        "scale": (0.01,) * 6 + (0.0,),
        "lower": (0.0, 0.0, 0.0),
        "upper": (1.0, 1.0, 1.0),
    }
    return arguments | changes


def make_scene() -> Any:
    """One tool of each kind: 6 + 6 + 6 + 6 + 6 + 3 + 7 actions."""
    scene = _simulator.Scene(**scene_arguments())
    for kind, actions in enumerate((6, 6, 6, 6, 6, 3, 7)):
        scene.add_tool(**tool_arguments(kind=kind, size=(0.05, 0.04, 0.03, 0.01), action_size=actions, scale=(0.01,) * actions))
    return scene


def make_simulator(dtype: type[np.floating[Any]], threads: int = 2) -> Any:
    engine = _simulator.SimulatorFloat if dtype is np.float32 else _simulator.SimulatorDouble
    material = np.repeat([[200.0], [100.0], [5.0]], PARTICLES, axis=1)
    return engine(make_scene(), material, threads, "")


def rollout_arguments(dtype: type[np.floating[Any]]) -> Arguments:
    generator = np.random.default_rng(0)
    shape, tools, actions = (WORLDS, PARTICLES), 7, 40

    def empty(*extents: int) -> NDArray[Any]:
        return np.zeros(extents, dtype)

    pose = empty(WORLDS, tools, 8)
    pose[..., :3] = generator.uniform(0.3, 0.6, (WORLDS, tools, 3))
    pose[..., 3] = 1.0
    pose[..., 7] = 0.08
    return {
        "worlds": WORLDS,
        "steps": STEPS,
        "position": generator.uniform(0.2, 0.7, (*shape, 3)).astype(dtype),
        "velocity": empty(*shape, 3),
        "affine": empty(*shape, 3, 3),
        "strain": empty(*shape, 6),
        "pose": pose,
        "actions": generator.uniform(-1.0, 1.0, (WORLDS, STEPS, actions)).astype(dtype),
        "positions": empty(WORLDS, STEPS + 1, PARTICLES, 3),
        "poses": empty(WORLDS, STEPS + 1, tools, 8),
        "last_velocity": empty(*shape, 3),
        "last_affine": empty(*shape, 3, 3),
        "last_strain": empty(*shape, 6),
        "keep": True,
    }


OPTIONAL = ("grad_poses",)
"""Arrays that may be None by themselves."""


def vjp_arguments(dtype: type[np.floating[Any]], rollout: Arguments) -> Arguments:
    return {
        "actions": rollout["actions"],
        "grad_positions": np.ones_like(rollout["positions"]),
        "grad_poses": np.ones_like(rollout["poses"]),
        "grad_last_velocity": np.ones_like(rollout["velocity"]),
        "grad_last_affine": np.ones_like(rollout["affine"]),
        "grad_last_strain": np.ones_like(rollout["strain"]),
        "grad_actions": np.zeros(rollout["actions"].shape, np.float64),
        "grad_position": np.zeros_like(rollout["position"]),
        "grad_velocity": np.zeros_like(rollout["velocity"]),
        "grad_affine": np.zeros_like(rollout["affine"]),
        "grad_strain": np.zeros_like(rollout["strain"]),
        "grad_pose": np.zeros(rollout["pose"].shape, np.float64),
    }


def transport_arguments(dtype: type[np.floating[Any]]) -> Arguments:
    generator = np.random.default_rng(1)
    n, m = 70, 45
    return {
        "source": generator.random((n, 3)).astype(dtype),
        "target": generator.random((m, 3)).astype(dtype),
        "source_weights": np.full(n, 1.0 / n, dtype),
        "target_weights": np.full(m, 1.0 / m, dtype),
        "source_potential": np.zeros(n, dtype),
        "target_potential": np.zeros(m, dtype),
        "source_self": np.zeros(n, dtype),
        "target_self": np.zeros(m, dtype),
        "gradient": np.zeros((n, 3), dtype),
        "exponent": 1,
        "blur": 0.05,
        "debias": True,
        "scaling": 0.5,
        "tolerance": 1e-3,
        "iterations": 100,
        "warm": False,
        "warm_tolerance": 5e-3,
        "warm_iterations": 10,
        "same_target": False,
        "source_order": np.zeros(n, np.int32),
        "target_order": np.zeros(m, np.int32),
        "source_extent": 0.0,
        "target_extent": 0.0,
    }


def solve(arguments: Arguments, threads: int = 2) -> Any:
    arrays = ("source", "target", "source_weights", "target_weights", "source_potential", "target_potential")
    positional = [arguments[name] for name in (*arrays, "source_self", "target_self", "gradient")]
    named = {name: value for name, value in arguments.items() if name not in (*arrays, "source_self", "target_self", "gradient")}
    return _transport.Solver(threads).solve(*positional, **named)


def broken_array(array: NDArray[Any], generator: np.random.Generator) -> Any:
    """The array in another shape, type, layout or access, or no array at all."""
    match int(generator.integers(11)):
        case 0:
            return array[..., :-1].copy()
        case 1:
            return array[:-1].copy()
        case 2:
            return np.concatenate([array, array], axis=0)
        case 3:
            return array.reshape(-1)[1:].copy()
        case 4:
            return array[None].repeat(2, axis=0)
        case 5:
            with np.errstate(over="ignore"):
                return array.astype(np.float16 if array.dtype != np.int32 else np.int64)
        case 6:
            return np.repeat(array, 2, axis=0)[::2]
        case 7:
            return np.broadcast_to(array.reshape(-1)[:1], (1 << 40,))
        case 8:
            return np.zeros((0, *array.shape[1:]), array.dtype)
        case 9:
            raw = np.zeros(array.nbytes + 1, np.uint8)
            return np.ndarray(array.shape, array.dtype, raw.data, offset=1)  # not aligned
        case _:
            return [None, "array", 1.5, array.tolist()][int(generator.integers(4))]


def odd_number(generator: np.random.Generator) -> Any:
    """A number that a caller should not send, or may."""
    return [-1, 0, 1, 100, -(1 << 31), (1 << 31) - 1, 1 << 62, -(1 << 63), 1 << 70, 0.5, 1e-30, -1e300, np.nan, np.inf, None, "1"][
        int(generator.integers(16))
    ]


def odd_values(array: NDArray[Any], generator: np.random.Generator) -> NDArray[Any]:
    """A copy of the right shape with a few numbers that are huge, tiny or none."""
    changed = array.copy()
    if array.dtype == np.int32:
        values = np.array([-1, 1 << 30, 0])
    else:
        values = np.array([np.nan, np.inf, -np.inf, 1e30, -1e30, 1e-40, 0.0, -3.0])
    places = generator.integers(changed.size, size=3)
    changed.reshape(-1)[places] = generator.choice(values, 3)
    return changed
