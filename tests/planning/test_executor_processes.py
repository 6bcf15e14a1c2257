"""Candidates spread over processes: the same plans, bit for bit; processes that die are replaced."""

from __future__ import annotations

import psutil
import pytest
import torch
from dying import AlwaysDie, Die, Refuse, Square

from cpdeform.core.errors import EngineError, InputError
from cpdeform.core.plugins import load_registry
from cpdeform.planning.executor_processes import ExecutorProcesses
from cpdeform.run.resolve import resolve

STAR = {
    "task": "star",
    "stages": 1,
    "optimizer": {"iterations": 2},
    "steps": 4,
    "rest_steps": 2,
    "scene": {"bodies": {"0": {"particle_count": 300}}},
    "simulator_options": {"threads": 1, "batch_size": 2},
    "objective": {"points": 200},
}


def test_a_run_over_processes_is_the_same_run():
    registry, before = load_registry(), torch.get_num_threads()
    earlier = psutil.Process().children()
    if "native" not in registry.installed("simulator"):
        pytest.skip("NOT TESTED: the native simulator is not built; others take long to start in each process")
    torch.set_num_threads(1)
    try:
        runs = [resolve({**STAR, "backend": "native", "workers": workers}, registry=registry).run() for workers in (1, 2)]
    finally:
        torch.set_num_threads(before)
    (first,), (second,) = (run.stages for run in runs)
    assert len(first.candidates) > 2
    assert [candidate.loss for candidate in first.candidates] == [candidate.loss for candidate in second.candidates]
    assert torch.equal(first.state.position, second.state.position)
    # What the standard library starts to look after shared memory stays.
    left = [child for child in psutil.Process().children() if child not in earlier]
    assert not [child for child in left if "resource_tracker" not in " ".join(child.cmdline())]


def test_processes_that_die_are_replaced(tmp_path):
    with ExecutorProcesses(2) as executor:
        assert executor.map(Die(tmp_path / "died"), range(5)) == [0, 1, 4, 9, 16]
        assert (tmp_path / "died").exists()


def test_processes_that_die_again_and_again_are_an_error():
    with ExecutorProcesses(2) as executor, pytest.raises(EngineError, match="died 3 times"):
        executor.map(AlwaysDie(), range(2))


def test_what_cannot_be_sent_is_refused():
    with ExecutorProcesses(2) as executor:
        with pytest.raises(InputError, match="workers: got a part that cannot be sent"):
            executor.map(lambda number: number, range(2))
        assert executor.map(lambda number: number, [7]) == [7]
        # An error comes back as it was raised, and the processes go on.
        with pytest.raises(InputError, match="number: got 0, expected none"):
            executor.map(Refuse(), range(2))
        assert executor.map(Square(), range(3)) == [0, 1, 4]
    for arguments in ({"workers": 0}, {"workers": 1, "threads": 0}):
        with pytest.raises(InputError, match=r"(workers|threads): got 0"):
            ExecutorProcesses(**arguments)
