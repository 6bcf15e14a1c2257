"""The author's kit: every registered part passes, and each check catches a part that is broken in its way."""

from __future__ import annotations

import copy
import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from cpdeform.backends.warp.simulator import SimulatorWarp
from cpdeform.cli.main import app
from cpdeform.core.errors import InputError
from cpdeform.core.ot import OTSolver, fix_gauge
from cpdeform.core.placer import Placement, Placer, PlacerCapabilities
from cpdeform.core.plugins import load_registry
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.simulator import Simulator
from cpdeform.core.state import initial_state
from cpdeform.core.testing import CheckError, Report, check_golden_file, check_ot_solver, check_placer, check_simulator
from cpdeform.core.testing.ot import OT_CHECKS
from cpdeform.core.testing.placer import PEAK, PLACER_CHECKS
from cpdeform.core.testing.simulator import SIMULATOR_CHECKS
from cpdeform.ot.geomloss import OTSolverGeomLoss
from cpdeform.ot.pot import OTSolverPOT

ot = pytest.importorskip("ot")


def assert_caught(report: Report, name: str) -> None:
    """The named check failed, with a figure or a reason and advice."""
    (check,) = report.checks
    assert check.name == name
    assert check.status == "failed", str(report)
    assert check.advice
    assert not report.passed
    with pytest.raises(CheckError, match="1 of 1 checks failed"):
        report.raise_if_failed()


# Registered parts ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", load_registry().names("simulator"))
def test_registered_simulators_pass(name):
    report = check_simulator(load_registry().load("simulator", name))
    report.raise_if_failed()
    assert len(report.checks) == len(SIMULATOR_CHECKS)


@pytest.mark.slow
def test_a_simulator_in_single_precision_passes():
    class SimulatorSingle(SimulatorWarp):
        capabilities = dataclasses.replace(SimulatorWarp.capabilities, dtypes=(torch.float32,))

    check_simulator(SimulatorSingle).raise_if_failed()


@pytest.mark.parametrize("name", load_registry().names("ot_solver"))
def test_registered_solvers_pass(name):
    report = check_ot_solver(load_registry().load("ot_solver", name))
    report.raise_if_failed()
    assert len(report.checks) == len(OT_CHECKS)
    assert not report.select("skipped")


@pytest.mark.slow
@pytest.mark.parametrize("name", load_registry().names("placer"))
def test_registered_placers_pass(name):
    report = check_placer(load_registry().load("placer", name))
    report.raise_if_failed()
    assert len(report.checks) == len(PLACER_CHECKS)


# Broken simulators --------------------------------------------------------------------------------------------------------


def changed_rollout(change, **members):
    """A Warp simulator whose trajectories go through ``change(trajectory, simulator, state)``."""

    def rollout(self, state, actions):
        return change(SimulatorWarp.rollout(self, state, actions), self, state)

    return type("SimulatorBroken", (SimulatorWarp,), {"rollout": rollout, **members})


def changed_final(change):
    """A Warp simulator whose final state goes through `change`."""
    return changed_rollout(lambda trajectory, *_: dataclasses.replace(trajectory, final_state=change(trajectory.final_state)))


def changed_gradient(change):
    """A Warp simulator whose gradients go through ``change(gradient, trajectory)``."""

    def vjp(self, trajectory, grad_positions, grad_manipulators=None):
        return change(SimulatorWarp.vjp(self, trajectory, grad_positions, grad_manipulators), trajectory)

    return type("SimulatorBroken", (SimulatorWarp,), {"vjp": vjp})


def scaled_gradient(name, factor=1.01):
    def change(gradient, _):
        if name == "actions":
            return dataclasses.replace(gradient, actions=factor * gradient.actions)
        start = gradient.initial_state
        return dataclasses.replace(gradient, initial_state=dataclasses.replace(start, **{name: factor * getattr(start, name)}))

    return changed_gradient(change)


def changed_scene(**changes):
    """A Warp simulator that computes with other constants than the scene's."""

    def initialize(self, scene, **options):
        SimulatorWarp.__init__(self, scene.model_copy(update=changes), **options)
        self.scene = scene

    return type("SimulatorBroken", (SimulatorWarp,), {"__init__": initialize})


def mixed_worlds(trajectory, *_):
    return dataclasses.replace(trajectory, positions=trajectory.positions + 1e-6 * trajectory.positions.mean(dim=0))


def mixed_gradients(gradient, _):
    return dataclasses.replace(gradient, actions=gradient.actions + 1e-3 * gradient.actions.flip(0))


def written_inputs(trajectory, simulator, state):
    state.velocity.mul_(0.5)
    return trajectory


class SimulatorWithMemory(SimulatorWarp):
    """Knows more of its own final states than they hold: they lose it when they are copied or stored."""

    def rollout(self, state, actions):
        known = getattr(self, "known", None)
        affine = known[1] if known is not None and known[0] is state else state.affine
        trajectory = super().rollout(dataclasses.replace(state, affine=affine), actions)
        final = dataclasses.replace(trajectory.final_state, affine=torch.zeros_like(trajectory.final_state.affine))
        self.known = (final, trajectory.final_state.affine)
        return dataclasses.replace(trajectory, initial_state=state, final_state=final)


class SimulatorLooseDeclarations(SimulatorWarp):
    """Refuses no type, since it does not compare with what it declares."""

    capabilities = dataclasses.replace(SimulatorWarp.capabilities, dtypes=(torch.float64,))

    def _check_capabilities(self):
        pass


class SimulatorTerse(SimulatorWarp):
    """Refuses what does not fit without saying what."""

    def check_inputs(self, state, actions):
        try:
            super().check_inputs(state, actions)
        except InputError as error:
            raise RuntimeError("bad shape") from error


class SimulatorGhosts(SimulatorWarp):
    """Tools pass through the clay."""

    def rollout(self, state, actions):
        away = state.manipulator_pose.clone()
        away[..., 1] = 0.9
        there = super().rollout(state.with_manipulators(away), actions)
        poses = super().rollout(state, actions).manipulator_poses
        return dataclasses.replace(there, manipulator_poses=poses)


class SimulatorShy(SimulatorWarp):
    """Declares that it is not differentiable, but answers."""

    capabilities = dataclasses.replace(SimulatorWarp.capabilities, differentiable=False)


def jitter(trajectory, simulator, _):
    simulator.calls = getattr(simulator, "calls", 0) + 1
    return dataclasses.replace(trajectory, positions=trajectory.positions + 1e-12 * simulator.calls)


def infinite_without_actions(gradient, trajectory):
    return dataclasses.replace(gradient, actions=gradient.actions / trajectory.actions.abs().amax())


def exchanged_axes(trajectory, simulator, state):
    return dataclasses.replace(
        trajectory,
        final_state=dataclasses.replace(
            trajectory.final_state, position=trajectory.final_state.position + 1e-6 * state.velocity[..., [0, 0, 0]]
        ),
    )


def final_with(**changes):
    return changed_final(
        lambda final: dataclasses.replace(final, **{name: change(getattr(final, name)) for name, change in changes.items()})
    )


BROKEN_SIMULATORS = {
    "shapes and types of the trajectory": changed_rollout(
        lambda trajectory, *_: dataclasses.replace(trajectory, positions=trajectory.positions[:, 1:])
    ),
    "state and actions are not modified": changed_rollout(written_inputs),
    "state can be cloned, mapped and forked": SimulatorWithMemory,
    "state survives the run record": SimulatorWithMemory,
    "2T steps are T steps twice": final_with(affine=lambda affine: 0.9 * affine),
    "a batch is a loop over worlds": changed_rollout(mixed_worlds),
    "deterministic where declared": changed_rollout(jitter),
    "declared manipulator kinds run": SimulatorGhosts,
    "capabilities hold": SimulatorLooseDeclarations,
    "bad arguments are named": SimulatorTerse,
    "mass and uniform motion are kept": final_with(velocity=lambda velocity: 0.999 * velocity),
    "momentum is kept without forces": final_with(velocity=lambda velocity: 0.999 * velocity),
    "angular momentum is kept without forces": final_with(affine=lambda affine: 0.9 * affine),
    "free fall has the closed form": changed_scene(gravity_scale=9.81),
    "physics does not depend on axis and place": changed_rollout(exchanged_axes),
    "no stress beyond the yield surface": final_with(elastic_strain=lambda strain: 1.1 * strain),
    "strain follows the motion below yield": final_with(elastic_strain=lambda strain: 1.001 * strain),
    "plastic flow keeps the volume": final_with(elastic_strain=lambda strain: 1.001 * strain),
    "volume is nearly kept under a squeeze": SimulatorGhosts,
    **{
        f"gradient of {name}": scaled_gradient(name)
        for name in ("actions", "position", "velocity", "affine", "elastic_strain", "manipulator_pose")
    },
    "gradient with each manipulator kind": scaled_gradient("actions"),
    "gradient of a batch is a loop over worlds": changed_gradient(mixed_gradients),
    "gradient is finite from rest": changed_gradient(infinite_without_actions),
    "gradient is refused where not declared": SimulatorShy,
}


def test_every_check_of_simulators_has_a_broken_one():
    assert set(BROKEN_SIMULATORS) == {item.name for item in SIMULATOR_CHECKS}


@pytest.mark.parametrize("name", BROKEN_SIMULATORS)
def test_broken_simulators_are_caught(name):
    assert_caught(check_simulator(BROKEN_SIMULATORS[name], only=[name]), name)


def test_a_simulator_that_cannot_be_built_is_a_failed_check():
    assert_caught(check_simulator(lambda scene: None), "it can be built")


def test_checks_that_do_not_apply_are_skipped():
    report = check_simulator(SimulatorShy, only=["gradient of actions"])
    assert [check.status for check in report.checks] == ["skipped"]
    assert "not differentiable" in str(report)
    report.raise_if_failed()


def test_bad_arguments_of_the_kit_are_named():
    with pytest.raises(InputError, match="nonsense"):
        check_simulator(SimulatorWarp, only=["nonsense"])
    with pytest.raises(InputError, match="scene"):
        check_simulator(SimulatorWarp, scene={"bodies": []})


# Broken solvers -----------------------------------------------------------------------------------------------------------


def changed_result(change, *, solver=OTSolverGeomLoss, **options):
    """A solver whose results go through `change`."""

    class OTSolverBroken(solver):
        def __init__(self):
            super().__init__(**options)

        def solve(self, source, target, **arguments):
            return change(super().solve(source, target, **arguments))

    return OTSolverBroken


class OTSolverIgnoringWeights(OTSolverGeomLoss):
    def solve(self, source, target, *, source_weights=None, target_weights=None, previous=None):
        return super().solve(source, target, previous=previous)


class OTSolverExactDual(OTSolverGeomLoss):
    """Returns a vertex of the exact dual and calls it entropic."""

    def solve(self, source, target, *, source_weights=None, target_weights=None, previous=None):
        result = super().solve(source, target, source_weights=source_weights, target_weights=target_weights, previous=previous)
        counts = (len(source), len(target))
        a, b = (torch.full((count,), 1 / count, dtype=torch.float64) for count in counts)
        cost = torch.cdist(source.double(), target.double())
        _, log = ot.emd(a.numpy(), b.numpy(), cost.numpy(), log=True)
        f, g = fix_gauge(torch.as_tensor(log["u"]), torch.as_tensor(log["v"]), a)
        return dataclasses.replace(result, source_potential=f.to(source), target_potential=g.to(source))


class OTSolverStale(OTSolverGeomLoss):
    def solve(self, source, target, *, source_weights=None, target_weights=None, previous=None):
        moved = source if previous is None else source + 0.01
        return super().solve(moved, target, source_weights=source_weights, target_weights=target_weights)


class OTSolverForgiving(OTSolverGeomLoss):
    def solve(self, source, target, **arguments):
        return super().solve(source.nan_to_num(), target, **arguments)


class OTSolverBiased(OTSolverPOT):
    """Debiased by declaration only."""

    def __init__(self):
        super().__init__(blur=2e-2, debias=False)
        self.capabilities = OTSolverPOT.capabilities


BROKEN_SOLVERS = {
    "shapes and types of the result": changed_result(lambda result: dataclasses.replace(result, value=result.value.reshape(1))),
    "closed form of a translation": changed_result(lambda result: dataclasses.replace(result, value=1.1 * result.value)),
    "gauge: zero weighted median": changed_result(
        lambda result: dataclasses.replace(
            result, source_potential=result.source_potential + 0.01, target_potential=result.target_potential - 0.01
        )
    ),
    "potentials sum to the value": changed_result(
        lambda result: dataclasses.replace(result, target_potential=result.target_potential + 1e-4)
    ),
    "gradient equals central differences": changed_result(
        lambda result: dataclasses.replace(result, source_gradient=1.02 * result.source_gradient)
    ),
    "potentials are slopes by the weights": changed_result(
        lambda result: dataclasses.replace(result, source_potential=-result.source_potential)
    ),
    "weights and order of the points": OTSolverIgnoringWeights,
    "identical clouds": OTSolverBiased,
    "priorities point at a pen's stroke": OTSolverExactDual,
    "warm start": OTSolverStale,
    "bad arguments are named": OTSolverForgiving,
}


def test_every_check_of_solvers_has_a_broken_one():
    assert set(BROKEN_SOLVERS) == {item.name for item in OT_CHECKS}


@pytest.mark.parametrize("name", BROKEN_SOLVERS)
def test_broken_solvers_are_caught(name):
    assert_caught(check_ot_solver(BROKEN_SOLVERS[name], only=[name]), name)


def test_honest_declarations_skip_what_they_rule_out():
    class OTSolverHonest(OTSolverExactDual):
        capabilities = dataclasses.replace(OTSolverGeomLoss.capabilities, potentials="exact")

        def __init__(self):
            super().__init__()
            self.capabilities = type(self).capabilities

    (check,) = check_ot_solver(OTSolverHonest(), only=["stroke"]).checks
    assert check.status == "skipped"
    assert "no transport priorities" in check.advice


def test_a_solver_that_raises_is_a_failed_check():
    class OTSolverAbsent(OTSolver):
        def solve(self, source, target, *, source_weights=None, target_weights=None, previous=None):
            raise RuntimeError("no licence")

    report = check_ot_solver(OTSolverAbsent)
    assert_caught(report, "it solves")
    assert "no licence" in str(report)


# Broken placers -----------------------------------------------------------------------------------------------------------


class PlacerHover(Placer):
    """A correct placer, to be broken: the movable tools go as high as they may, where nothing else is."""

    capabilities = PlacerCapabilities(needs_priorities=False, max_manipulators=None)
    height = 0.2

    def pose(self, stage):
        pose = stage.state.manipulator_pose[0].clone()
        for index, tool in enumerate(stage.scene.manipulators):
            if tool.movable:
                pose[index, :3] = torch.tensor([PEAK[0] - 0.02, self.height, PEAK[2]])
                lower, upper = (torch.tensor(bound).to(pose) for bound in (tool.lower_bound, tool.upper_bound))
                pose[index, :3] = torch.minimum(torch.maximum(pose[index, :3], lower), upper)
        return pose

    def ask(self, stage):
        pose = self.pose(stage)
        collides = any(
            bool((signed_distance(tool, pose[index], stage.state.position[0]) < 0).any())
            for index, tool in enumerate(stage.scene.manipulators)
        )
        return [] if collides else [Placement(pose, float("nan"), "hover")]


class PlacerNothing(PlacerHover):
    def ask(self, stage):
        return []


class PlacerOneTool(PlacerHover):
    def pose(self, stage):
        return super().pose(stage)[0]

    def ask(self, stage):
        return [Placement(self.pose(stage), float("nan"), "flat")]


class PlacerColliding(PlacerHover):
    height = 0.1

    def ask(self, stage):
        return [Placement(self.pose(stage), float("nan"), "inside")]


class PlacerOutside(PlacerHover):
    def pose(self, stage):
        pose = super().pose(stage)
        pose[:, 0] = 0.95
        return pose


class PlacerMovingAll(PlacerHover):
    def pose(self, stage):
        pose = super().pose(stage)
        pose[:, 1] += 0.01
        return pose


class PlacerOwnRandomness(PlacerHover):
    def pose(self, stage):
        pose = super().pose(stage)
        pose[:, 0] -= 0.1 * torch.rand(()).item()
        return pose


class PlacerWriting(PlacerHover):
    def pose(self, stage):
        stage.state.manipulator_pose[0] = super().pose(stage)
        return stage.state.manipulator_pose[0]


class PlacerSecretPriorities(PlacerHover):
    def pose(self, stage):
        pose = super().pose(stage)
        pose[:, 0] -= stage.priorities.abs().max()
        return pose


class PlacerEndless(PlacerHover):
    def tell(self, results):
        return True


BROKEN_PLACERS = {
    "finds a placement where there is room": PlacerNothing,
    "shapes and types of placements": PlacerOneTool,
    "no collision with the body": PlacerColliding,
    "tools within their bounds": PlacerOutside,
    "fixed tools stay": PlacerMovingAll,
    "reproducible by the generator": PlacerOwnRandomness,
    "stage is not modified": PlacerWriting,
    "proposes nothing where nothing is possible": PlacerColliding,
    "needs_priorities is honoured": PlacerSecretPriorities,
    "rounds end": PlacerEndless,
}


def test_every_check_of_placers_has_a_broken_one():
    assert set(BROKEN_PLACERS) == {item.name for item in PLACER_CHECKS}


def test_the_placer_that_is_broken_below_passes():
    check_placer(PlacerHover()).raise_if_failed()


@pytest.mark.parametrize("name", BROKEN_PLACERS)
def test_broken_placers_are_caught(name):
    assert_caught(check_placer(BROKEN_PLACERS[name], only=[name]), name)


# Golden files -------------------------------------------------------------------------------------------------------------

SCENE = {
    "bodies": [{"kind": "box", "position": [0.5, 0.06, 0.5], "widths": [0.1, 0.1, 0.1], "particle_count": 200}],
    "manipulators": [{"kind": "Sphere", "radius": 0.03, "position": [0.5, 0.14, 0.5], "action_scale": [0.01, 0.01, 0.01]}],
}


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    """A folder of golden files that hold what the Warp backend does: a torus, and a pinch with an unknown tool."""
    from cpdeform.core.objectives.plasticinelab import ObjectivePlasticineLab, mass_grid
    from cpdeform.core.scene import Scene

    scene = Scene.model_validate({**SCENE, "grid_size": 32, "substeps": 4})
    simulator = SimulatorWarp(scene, dtype=torch.float64)
    state = initial_state(scene, dtype=torch.float64)
    actions = -torch.ones(1, 3, 3, dtype=torch.float64)
    trajectory = simulator.rollout(state, actions)
    grid = mass_grid(state.position[0] + torch.tensor([0.05, 0.0, 0.0]), scene)
    result = ObjectivePlasticineLab(scene, grid).evaluate(trajectory)
    gradient = simulator.vjp(trajectory, result.grad_positions, result.grad_manipulators).actions[0].numpy().copy()
    gradient[:, 0] = 1e299
    zeros, identity = np.zeros((200, 3, 3)), np.tile(np.eye(3), (200, 1, 1))
    (tmp_path / "golden").mkdir()
    (tmp_path / "plasticinelab").mkdir()
    for name in ("torus-v2-seed0", "pinch-v1"):
        np.savez(
            tmp_path / "golden" / f"{name}.npz",
            x0=state.position[0], v0=state.velocity[0], C0=zeros, F0=identity, prim=trajectory.manipulator_poses[0, :, 0, :7],
            actions=actions[0], x=trajectory.positions[0, -1], v=trajectory.final_state.velocity[0], grad=gradient,
            total_loss=float(result.loss[0]), softness=666.0, n_grid=32, substeps=4, dt=1e-4,
        )  # fmt: skip
    unknown = copy.deepcopy(SCENE)
    unknown["manipulators"][0]["kind"] = "Spoon"
    content = {"torus": {**SCENE, "variants": []}, "pinch": unknown}
    (tmp_path / "plasticinelab" / "scenes.json").write_text(json.dumps(content))
    cells = torch.nonzero(grid)
    counts = grid[tuple(cells.T)] / scene.particle_volume
    np.savez(tmp_path / "plasticinelab" / "target_grids.npz", **{"Torus3D-v2/cells": cells, "Torus3D-v2/count": counts})
    return tmp_path / "golden"


def test_golden_files_of_the_same_backend_agree(recorded):
    errors = check_golden_file(recorded / "torus-v2-seed0.npz", SimulatorWarp)
    assert errors.status == "passed", str(errors)
    assert errors.position_error < 1e-6
    assert errors.pose_error < 1e-6
    assert errors.gradient_cosine > 0.99999
    assert errors.gradient_norm_error < 1e-3
    assert errors.loss_error < 1e-4


@pytest.mark.parametrize(
    ("simulator", "words"),
    [
        (changed_scene(gravity_scale=3000.0), "velocity error"),
        (scaled_gradient("actions", 1.05), "gradient norm"),
        (changed_gradient(lambda gradient, _: dataclasses.replace(gradient, actions=gradient.actions.flip(2))), "gradient"),
        (changed_gradient(lambda gradient, _: dataclasses.replace(gradient, actions=gradient.actions * torch.nan)), "cosine"),
        (changed_final(lambda final: 1 / 0), "ZeroDivisionError"),
    ],
)
def test_golden_files_catch_broken_simulators(recorded, simulator, words):
    errors = check_golden_file(recorded / "torus-v2-seed0.npz", simulator)
    assert errors.status == "failed"
    assert words in errors.reason


def test_golden_on_the_command_line(recorded):
    arguments = ["check", "golden", str(recorded), "--backend", "warp"]
    finished = CliRunner().invoke(app, [*arguments, "--json"])
    assert finished.exit_code == 1
    lines = [json.loads(line) for line in finished.stdout.splitlines()]
    assert [(line["name"], line["status"]) for line in lines[:-1]] == [("pinch-v1", "unsupported"), ("torus-v2-seed0", "passed")]
    assert "Spoon" in lines[0]["reason"]
    assert lines[-1] == {"backend": "warp", "passed": False, "files": lines[:-1]}
    finished = CliRunner().invoke(app, [*arguments, "--allow-unsupported"])
    assert finished.exit_code == 0
    assert "torus-v2-seed0" in finished.stdout


def test_golden_needs_files(tmp_path):
    finished = CliRunner().invoke(app, ["check", "golden", str(tmp_path)])
    assert finished.exit_code == 2
    assert "golden files" in finished.stderr
    np.savez(tmp_path / "teapot-v1.npz", x=np.zeros(3))
    finished = CliRunner().invoke(app, ["check", "golden", str(tmp_path)])
    assert finished.exit_code == 1
    assert "teapot-v1" in finished.stdout


# Command line -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "subject"),
    [
        (["simulator", "warp", "--only", "bad arguments"], "SimulatorWarp"),
        (["ot_solver", "geomloss", "--only", "gauge"], "OTSolverGeomLoss"),
        (["placer", "fixed"], "PlacerFixed"),
    ],
)
def test_parts_on_the_command_line(arguments, subject):
    finished = CliRunner().invoke(app, ["check", *arguments])
    assert finished.exit_code == 0
    assert finished.stdout.startswith(subject)
    finished = CliRunner().invoke(app, ["check", *arguments, "--json"])
    content = json.loads(finished.stdout)
    assert content["passed"]
    assert content["subject"] == subject


def test_a_failed_check_is_exit_code_1():
    arguments = ["check", "ot_solver", "geomloss", "--set", "settings=paper", "--only", "gradient"]
    finished = CliRunner().invoke(app, arguments)
    assert finished.exit_code == 1
    assert "failed" in finished.stdout


def test_unknown_names_are_exit_code_2():
    finished = CliRunner().invoke(app, ["check", "simulator", "wrap"])
    assert finished.exit_code == 2
    assert 'Did you mean "warp"?' in finished.stderr


def test_help_imports_nothing_heavy():
    script = (
        "import sys\nfrom cpdeform.cli.main import app\n"
        "try:\n    app(['check', 'golden', '--help'])\nexcept SystemExit:\n    pass\n"
        "print('\\nHEAVY', sorted({'torch', 'warp', 'ot', 'h5py', 'scipy', 'numpy'} & set(sys.modules)))\n"
    )
    finished = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert finished.stdout.splitlines()[-1] == "HEAVY []"


def test_simulator_stays_an_interface():
    assert Simulator.__abstractmethods__ == {"rollout", "vjp", "memory_estimate"}
