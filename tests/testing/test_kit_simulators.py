"""`check_simulator`: every registered simulator passes, and each check catches one that is broken in its way."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from kit import assert_caught, changed_final, changed_gradient, changed_rollout, changed_scene, scaled_gradient

from cpdeform.backends.warp.simulator import SimulatorWarp
from cpdeform.core.errors import InputError
from cpdeform.core.plugins import load_registry
from cpdeform.testing import check_simulator
from cpdeform.testing.simulator import SIMULATOR_CHECKS


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


class SimulatorTrusting(SimulatorWarp):
    """Looks at shapes only."""

    def check_inputs(self, state, actions):
        fine = self.initial_state(batch_size=state.batch_size)
        super().check_inputs(fine, torch.zeros_like(actions))


class SimulatorGhosts(SimulatorWarp):
    """Tools pass through the clay."""

    def rollout(self, state, actions):
        away = state.tool_pose.clone()
        away[..., 1] = 0.9
        there = super().rollout(state.with_tools(away), actions)
        poses = super().rollout(state, actions).tool_poses
        return dataclasses.replace(there, tool_poses=poses)


class SimulatorShy(SimulatorWarp):
    """Declares that it is not differentiable, but answers."""

    capabilities = dataclasses.replace(SimulatorWarp.capabilities, differentiable=False)


class SimulatorBorrowing(SimulatorWarp):
    """Rolls out anew on the way back, from tensors that the caller may have written to since."""

    def vjp(self, trajectory, grad_positions, grad_tools=None, **options):
        again = self.rollout(trajectory.initial_state, trajectory.actions)
        return super().vjp(again, grad_positions, grad_tools, **options)


class SimulatorOneWay(SimulatorWarp):
    """Written before rollouts could be chained."""

    def vjp(self, trajectory, grad_positions, grad_tools=None):
        return super().vjp(trajectory, grad_positions, grad_tools)


class SimulatorMatrixStrain(SimulatorWarp):
    """Takes the gradient of the final strain as that of the matrix's entries, and gives that of the six numbers."""

    def vjp(self, trajectory, grad_positions, grad_tools=None, *, grad_final_state=None):
        if grad_final_state is not None:
            strain = grad_final_state.elastic_strain * torch.tensor([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])
            grad_final_state = dataclasses.replace(grad_final_state, elastic_strain=strain)
        return super().vjp(trajectory, grad_positions, grad_tools, grad_final_state=grad_final_state)


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
    "declared tool kinds run": SimulatorGhosts,
    "capabilities hold": SimulatorLooseDeclarations,
    "bad arguments are named": SimulatorTerse,
    "senseless numbers are refused": SimulatorTrusting,
    "a trajectory is a copy of what was given": changed_rollout(
        lambda trajectory, _, state: dataclasses.replace(trajectory, initial_state=state)
    ),
    "gradient is that of what was rolled out": SimulatorBorrowing,
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
        for name in ("actions", "position", "velocity", "affine", "elastic_strain", "tool_pose")
    },
    "gradient with each tool kind": scaled_gradient("actions"),
    "gradient of a batch is a loop over worlds": changed_gradient(mixed_gradients),
    "gradient is finite from rest": changed_gradient(infinite_without_actions),
    "gradient is refused where not declared": SimulatorShy,
    "gradient of the final state": SimulatorOneWay,
    "gradient of 2T steps is that of T steps twice": SimulatorMatrixStrain,
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
