"""Candidates spread over a Ray cluster: the same plans, bit for bit; processes that die are replaced."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import dying
import pytest
import torch
from clusters import ray_cluster
from dying import AlwaysDie, Die, Refuse
from test_executor_processes import STAR

from cpdeform.core.errors import EngineError, InputError
from cpdeform.core.plugins import load_registry
from cpdeform.run.resolve import resolve


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning", "ignore::FutureWarning")
def test_a_run_over_a_cluster_is_the_same_run(tmp_path, monkeypatch):
    pytest.importorskip("ray", reason='NOT TESTED: the executor ray needs pip install "cpdeform[ray]"')
    from cpdeform.planning.executor_ray import ExecutorRay

    registry = load_registry()
    if "native" not in registry.installed("simulator"):
        pytest.skip("NOT TESTED: the native simulator is not built; others take long to start in each process")
    monkeypatch.setenv("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    # The nodes' processes import the module that the dying functions are in.
    folders = [str(Path(dying.__file__).parent), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, folders)))
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        here = resolve({**STAR, "backend": "native"}, registry=registry).run()
        with ray_cluster(2) as (cluster, _):
            spread: dict[str, Any] = {"workers": 2, "executor": "ray", "executor_options": {"address": cluster.address}}
            there = resolve({**STAR, "backend": "native", **spread}, registry=registry).run()
            with ExecutorRay(2, address=cluster.address) as executor:
                assert executor.map(Die(tmp_path / "died"), range(5)) == [0, 1, 4, 9, 16]
                assert (tmp_path / "died").exists()
                with pytest.raises(EngineError, match="died 3 times"):
                    executor.map(AlwaysDie(), range(2))
                with pytest.raises(InputError, match="number: got "):
                    executor.map(Refuse(), range(2))
                with pytest.raises(InputError, match="workers: got a part that cannot be sent"):
                    executor.map(lambda number: number, range(2))
    finally:
        torch.set_num_threads(before)
    (first,), (second,) = (run.stages for run in (here, there))
    assert len(first.candidates) > 2
    assert [candidate.loss for candidate in first.candidates] == [candidate.loss for candidate in second.candidates]
    assert torch.equal(first.state.position, second.state.position)


def test_a_single_worker_needs_no_executor():
    """Whoever asks for a cluster and forgets the workers would wait for one core."""
    with pytest.raises(InputError, match="workers: got 1, expected at least 2 for the executor ray"):
        resolve({"task": "move", "executor": "ray"}, registry=load_registry())
    with pytest.raises(InputError, match='Did you mean "ray"'):
        resolve({"task": "move", "executor": "rays", "workers": 2}, registry=load_registry())
