"""Engines: the same records whatever the workers are, and whatever becomes of them."""

from __future__ import annotations

import os
import signal
from typing import Any

import psutil
import pytest
from campaign import Campaign, digests
from clusters import ray_cluster

from cpdeform.core.errors import EngineError
from cpdeform.sweep.engines.local import EngineLocal
from cpdeform.sweep.queue import Queue
from cpdeform.sweep.status import sweep_status
from cpdeform.sweep.worker import WorkSettings

SETTINGS = WorkSettings(stale_after=10.0, attempts=50)


def check_all_done(queue: Queue, campaign: Campaign) -> None:
    status = sweep_status(queue)
    assert (status.done, status.failed, status.running, status.waiting) == (campaign.jobs, 0, 0, 0)


def test_local_workers(tmp_path, monkeypatch):
    """One of them is killed; its watcher gives the job back at once, and starts another."""
    campaign = Campaign(tmp_path, monkeypatch, jobs=3, delay=0.02)
    expected, queue, killed = campaign.undisturbed(), campaign.new("local"), []
    for outcome in EngineLocal(workers=1).work(queue, WorkSettings(stale_after=3600.0)):
        assert outcome.outcome == "done"
        if not killed:
            killed = [child for child in psutil.Process().children() if "cpdeform.sweep.engines.local" in child.cmdline()]
            killed[0].send_signal(signal.SIGKILL)
    check_all_done(queue, campaign)
    assert digests(queue) == expected


def test_workers_that_die_in_vain_are_an_error(tmp_path, monkeypatch):
    campaign = Campaign(tmp_path, monkeypatch, jobs=1, delay=0.0)
    queue = campaign.new("broken")
    (tmp_path / "broken" / "sweep.json").write_text("{}")
    with pytest.raises(EngineError, match="workers die with nothing done"):
        list(EngineLocal(workers=1).work(queue, WorkSettings()))
    assert sweep_status(queue).waiting == 1


def ray_with_a_killed_node(campaign: Campaign, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray", reason='NOT TESTED: the engine ray needs pip install "cpdeform[ray]"')
    from cpdeform.sweep.engines.ray import EngineRay

    monkeypatch.setenv("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    expected, queue = campaign.undisturbed(), campaign.new("ray")
    with ray_cluster() as (cluster, nodes):
        outcomes = EngineRay(address=cluster.address, memory_gb=0.1).work(queue, SETTINGS)
        for done, outcome in enumerate(outcomes, start=1):
            assert outcome.outcome == "done", outcome
            if done == campaign.jobs // 2:
                cluster.remove_node(nodes[0], allow_graceful=False)
    check_all_done(queue, campaign)
    assert digests(queue) == expected


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning", "ignore::FutureWarning")
def test_ray(tmp_path, monkeypatch):
    ray_with_a_killed_node(Campaign(tmp_path, monkeypatch, jobs=6, delay=0.02), monkeypatch)


@pytest.mark.sweeps
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning", "ignore::FutureWarning")
def test_ray_with_two_hundred_jobs(tmp_path, monkeypatch):
    ray_with_a_killed_node(Campaign(tmp_path, monkeypatch, jobs=200, delay=0.05), monkeypatch)


def slurm_with_a_preemption(campaign: Campaign, *, workers: int) -> None:
    """A worker of submitit's is told, in the midst of a job, that its time is over: it is queued again, and the job goes on."""
    from cpdeform.sweep.engines.slurm import EngineSlurm

    expected, queue = campaign.undisturbed(), campaign.new("slurm")
    engine, preempted = EngineSlurm(workers=workers, cluster="local", timeout_min=60), []
    for outcome in engine.work(queue, SETTINGS):
        assert outcome.outcome == "done", outcome
        for job in engine.jobs if not preempted else ():
            preempted += [child for child in children(job) if child.is_running()]
            for child in preempted:
                os.kill(child.pid, signal.SIGUSR2)
    check_all_done(queue, campaign)
    assert preempted
    assert digests(queue) == expected
    assert "Caught signal SIGUSR2" in "".join(path.read_text() for path in (queue.directory / "queue" / "slurm").glob("*_log.err"))


def children(job: Any) -> list[psutil.Process]:
    """The processes that do a submitit job's work, by its controller's number."""
    try:
        return psutil.Process(int(job.job_id)).children()
    except psutil.NoSuchProcess:
        return []


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_slurm(tmp_path, monkeypatch):
    pytest.importorskip("submitit", reason='NOT TESTED: the engine slurm needs pip install "cpdeform[slurm]"')
    slurm_with_a_preemption(Campaign(tmp_path, monkeypatch, jobs=4, delay=0.02), workers=1)


@pytest.mark.sweeps
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_slurm_with_two_hundred_jobs(tmp_path, monkeypatch):
    pytest.importorskip("submitit", reason='NOT TESTED: the engine slurm needs pip install "cpdeform[slurm]"')
    slurm_with_a_preemption(Campaign(tmp_path, monkeypatch, jobs=200, delay=0.05), workers=2)
