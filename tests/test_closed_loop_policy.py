"""The example of a closed-loop policy runs, learns, and learns to look."""

from __future__ import annotations

import importlib.util
import statistics
from pathlib import Path
from types import ModuleType

import pytest

from cpdeform.core.plugins import load_registry

SCRIPT = Path(__file__).parent.parent / "examples" / "closed_loop_policy.py"


@pytest.fixture(scope="module")
def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("closed_loop_policy", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_policy_learns_what_no_plan_without_eyes_can_do(example: ModuleType) -> None:
    registry = load_registry()
    backend = registry.resolve("simulator", "auto", device="cpu")
    simulator = registry.create("simulator", backend, scene=example.SCENE, batch_size=len(example.SHIFTS))
    _, history = example.train(simulator, iterations=20)
    # a plan that is the same in every world brings the clay to one place, at best to the mean of the wanted ones
    best_blind = statistics.pstdev(example.SHIFTS)
    assert history[0] > best_blind
    assert history[-1] < 0.4 * best_blind


def test_the_script_says_what_it_learnt(example: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    example.main(["--iterations", "1"])
    assert "never seen in training: wanted 0.015" in capsys.readouterr().out
