"""The extension's own entry points: what does not fit raises, whatever it is, and nothing is read or written beyond an array.

That nothing is, AddressSanitizer tells: `make sanitize` runs these tests on a build that has it.
"""

from __future__ import annotations

from typing import Any

import boundary_cases as cases
import numpy as np
import pytest

from cpdeform_native import _simulator, _transport

REFUSALS = (TypeError, ValueError, RuntimeError, MemoryError)
FLOATS = (np.float32, np.float64)
ROUNDS = 400


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("substeps", -1),
        ("substeps", 0),
        ("particle_count", 0),
        ("particle_count", -5),
        ("particle_count", 1 << 40),
        ("grid_size", 2),
        ("grid_size", 1 << 20),
        ("wall_nodes", -1),
        ("ground_nodes", -1),
        ("time_step", 0.0),
        ("node_distance", float("nan")),
        ("softness", -1.0),
        ("gravity", (0.0, 0.0)),
        ("upper", (1.0, 1.0, float("inf"))),
    ],
)
def test_a_scene_that_kernels_cannot_take_is_refused(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=name):
        _simulator.Scene(**cases.scene_arguments(**{name: value}))


@pytest.mark.parametrize(
    ("name", "value", "named"),
    [
        ("action_size", 100, "action_size"),
        ("action_size", -1, "action_size"),
        ("action_size", 7, "action_size"),
        ("kind", 8, "kind"),
        ("kind", -1, "kind"),
        ("size", (), "size"),
        ("size", (-0.1, 0.0, 0.0, 0.0), "size"),
        ("size", (0.1,) * 5, "size"),
        ("scale", (0.1,) * 8, "scale"),
        ("scale", (0.1,) * 3, "scale"),
        ("lower", (0.0,), "lower"),
        ("friction", float("nan"), "friction"),
    ],
)
def test_a_tool_that_kernels_cannot_take_is_refused(name: str, value: Any, named: str) -> None:
    scene = _simulator.Scene(**cases.scene_arguments())
    with pytest.raises(ValueError, match=named):
        scene.add_tool(**cases.tool_arguments(**{name: value}))


@pytest.mark.parametrize(
    ("place", "value"),
    [(27, 0.5), (30, 1e9), (53, -3.0), (54, float("nan")), (55, 0.0), (55, 40.0), (56, 7.0), (56, -1.0), (56, 1e300)],
)
def test_a_mesh_whose_lists_lead_elsewhere_is_refused(place: int, value: float) -> None:
    # 27 coefficients, 27 places of lists, a 0, a list of one triangle, the triangle
    numbers = np.zeros(27 + 27 + 3 + 30)
    numbers[[27 + 13, 55, 56]] = 1.0, 1.0, 3.0
    mesh = {"kind": 7, "size": (0.01, 3.0, 3.0, 3.0)}
    _simulator.Scene(**cases.scene_arguments()).add_tool(**cases.tool_arguments(**mesh, grid=numbers))
    numbers[place] = value
    with pytest.raises(ValueError, match="grid"):
        _simulator.Scene(**cases.scene_arguments()).add_tool(**cases.tool_arguments(**mesh, grid=numbers))
    with pytest.raises(ValueError, match="grid"):
        _simulator.Scene(**cases.scene_arguments()).add_tool(**cases.tool_arguments(**mesh, grid=numbers[:54]))


@pytest.mark.parametrize("threads", [0, -5, 1 << 30])
def test_threads_are_counted(threads: int) -> None:
    with pytest.raises(ValueError, match="threads"):
        cases.make_simulator(np.float32, threads)
    with pytest.raises(ValueError, match="threads"):
        _transport.Solver(threads)


@pytest.mark.parametrize("dtype", FLOATS)
def test_an_array_of_another_type_is_refused_instead_of_copied(dtype: type[np.floating[Any]]) -> None:
    # of a converted copy, the results would be lost
    other = np.float64 if dtype is np.float32 else np.float32
    arguments = cases.rollout_arguments(dtype)
    for name in ("position", "positions", "last_strain"):
        with pytest.raises(TypeError):
            cases.make_simulator(dtype).rollout(**arguments | {name: arguments[name].astype(other)})


@pytest.mark.parametrize("dtype", FLOATS)
def test_right_arguments_are_taken(dtype: type[np.floating[Any]]) -> None:
    simulator, arguments = cases.make_simulator(dtype), cases.rollout_arguments(dtype)
    checkpoints = simulator.rollout(**arguments)
    assert np.abs(arguments["positions"][:, -1] - arguments["positions"][:, 0]).max() > 1e-5
    gradient = cases.vjp_arguments(dtype, arguments)
    simulator.vjp(checkpoints, **gradient)
    assert np.abs(gradient["grad_position"]).max() > 0.5
    problem = cases.transport_arguments(dtype)
    assert cases.solve(problem)[1] < 1e-3


def _changed(arguments: dict[str, Any], generator: np.random.Generator) -> tuple[dict[str, Any], bool]:
    """Arguments of which one or two are odd, and whether an array is of another shape, type or layout."""
    changed, broken = dict(arguments), False
    for name in generator.choice(list(arguments), size=int(generator.integers(1, 3)), replace=False):
        value = changed[name]
        if name.endswith("iterations"):
            changed[name] = int(generator.integers(-2, 50))  # more would be right, and take for ever
        elif not isinstance(value, np.ndarray):
            changed[name] = cases.odd_number(generator)
        elif generator.random() < 0.5:
            changed[name] = cases.broken_array(value, generator)
            broken |= changed[name] is not None or name not in cases.OPTIONAL
        else:
            changed[name] = cases.odd_values(value, generator)
    return changed, broken


@pytest.mark.parametrize("dtype", FLOATS)
def test_fuzzed_rollouts_compute_or_raise(dtype: type[np.floating[Any]]) -> None:
    generator = np.random.default_rng(2)
    simulator, arguments = cases.make_simulator(dtype), cases.rollout_arguments(dtype)
    refused = 0
    for _ in range(ROUNDS):
        changed, broken = _changed(arguments, generator)
        try:
            simulator.rollout(**changed)
        except REFUSALS:
            refused += 1
        else:
            assert not broken
    assert ROUNDS / 4 < refused < ROUNDS


@pytest.mark.parametrize("dtype", FLOATS)
def test_fuzzed_gradients_compute_or_raise(dtype: type[np.floating[Any]]) -> None:
    generator = np.random.default_rng(3)
    simulator, rollout = cases.make_simulator(dtype), cases.rollout_arguments(dtype)
    rollouts = [rollout | {"keep": keep} for keep in (True, False)]
    rollouts.append(rollout | {"position": cases.odd_values(rollout["position"], generator)})
    checkpoints = [simulator.rollout(**item) for item in rollouts]
    arguments = cases.vjp_arguments(dtype, rollout)
    refused = 0
    for n in range(ROUNDS):
        changed, broken = _changed(arguments, generator)
        try:
            simulator.vjp(checkpoints[n % len(checkpoints)], **changed)
        except REFUSALS:
            refused += 1
        else:
            assert not broken
    assert ROUNDS / 4 < refused < ROUNDS


@pytest.mark.parametrize("dtype", FLOATS)
def test_fuzzed_transport_computes_or_raises(dtype: type[np.floating[Any]]) -> None:
    generator = np.random.default_rng(4)
    arguments = cases.transport_arguments(dtype)
    refused = 0
    for n in range(ROUNDS):
        changed, broken = _changed(arguments | {"warm": n % 2 == 1, "source_extent": float(n % 3 == 0)}, generator)
        try:
            cases.solve(changed)
        except REFUSALS:
            refused += 1
        else:
            assert not broken
    assert ROUNDS / 4 < refused < ROUNDS


def test_fuzzed_scenes_compute_or_raise() -> None:
    generator = np.random.default_rng(5)
    rollout = cases.rollout_arguments(np.float32)
    rollout |= {"pose": rollout["pose"][:, :1].copy(), "poses": rollout["poses"][:, :, :1].copy()}
    made = 0
    for n in range(ROUNDS):
        scene_changes = {str(generator.choice(list(cases.scene_arguments()))): cases.odd_number(generator)}
        tool_changes = {str(generator.choice(list(cases.tool_arguments()))): cases.odd_number(generator)}
        tool = cases.tool_arguments(**(tool_changes if n % 2 else {}))
        try:
            scene = _simulator.Scene(**cases.scene_arguments(**({} if n % 2 else scene_changes)))
            scene.add_tool(**tool)
            simulator = _simulator.SimulatorFloat(scene, np.ones((3, cases.PARTICLES)), 2, "")
            simulator.rollout(**rollout | {"actions": rollout["actions"][..., : tool["action_size"]].copy()})
        except REFUSALS:
            continue
        made += 1
    assert 50 < made < ROUNDS - 50
