"""What the tests of the author's kit share."""

from __future__ import annotations

import dataclasses

import pytest

from cpdeform.backends.warp.simulator import SimulatorWarp
from cpdeform.testing import CheckError, Report


def assert_caught(report: Report, name: str) -> None:
    """The named check failed, with a figure or a reason and advice."""
    (check,) = report.checks
    assert check.name == name
    assert check.status == "failed", str(report)
    assert check.advice
    assert not report.passed
    with pytest.raises(CheckError, match="1 of 1 checks failed"):
        report.raise_if_failed()


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

    def vjp(self, trajectory, grad_positions, grad_tools=None, *, grad_final_state=None):
        gradient = SimulatorWarp.vjp(self, trajectory, grad_positions, grad_tools, grad_final_state=grad_final_state)
        return change(gradient, trajectory)

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
