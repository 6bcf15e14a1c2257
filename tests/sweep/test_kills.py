"""Workers that are killed: every job is done once, bit for bit as if nothing had happened."""

from __future__ import annotations

import pytest
from campaign import Campaign, digests

from cpdeform.sweep.queue import DONE
from cpdeform.sweep.status import sweep_status


def check(campaign: Campaign, *, workers: int, every: float, most: int = 10**6) -> None:
    expected = campaign.undisturbed()
    queue, killed = campaign.with_kills("killed", workers=workers, every=every, most=most)
    status = sweep_status(queue)
    assert (status.done, status.failed, status.running, status.waiting) == (campaign.jobs, 0, 0, 0)
    assert killed >= 2
    assert status.lost >= 1
    assert queue.listed(DONE) == set(queue.names())
    assert {path.name for path in (queue.directory / "records").iterdir()} == set(queue.names())
    assert digests(queue) == expected


def test_a_few_jobs(tmp_path, monkeypatch):
    check(Campaign(tmp_path, monkeypatch, jobs=6, delay=0.02), workers=2, every=0.5, most=2)


@pytest.mark.sweeps
def test_two_hundred_jobs(tmp_path, monkeypatch):
    check(Campaign(tmp_path, monkeypatch, jobs=200, delay=0.05), workers=4, every=5.0)
