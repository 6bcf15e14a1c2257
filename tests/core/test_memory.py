from __future__ import annotations

import mmap

from cpdeform.core import memory
from cpdeform.core.memory import MemoryGauge

MEBIBYTE = 1 << 20


def hold(count: int) -> mmap.mmap:
    """Memory that goes back to the system as soon as it is dropped; what `malloc` gave out may stay resident."""
    block = mmap.mmap(-1, count * MEBIBYTE)
    for page in range(0, len(block), mmap.PAGESIZE):
        block[page] = 1
    return block


def test_the_peak_is_above_the_start():
    before = hold(30)
    gauge = MemoryGauge()
    assert gauge.exact
    hold(40)
    kept = hold(10)
    assert abs(gauge.peak() - 40 * MEBIBYTE) < 4 * MEBIBYTE
    gauge.restart()
    assert gauge.peak() < 4 * MEBIBYTE
    del before, kept


def test_what_is_left_out_does_not_count():
    gauge = MemoryGauge()
    hold(20)
    with gauge.leave_out():
        hold(80)
        kept = hold(10)
    hold(20)
    assert abs(gauge.peak() - 30 * MEBIBYTE) < 4 * MEBIBYTE
    del kept


def test_without_a_peak_that_can_be_reset(monkeypatch, tmp_path):
    monkeypatch.setattr(memory, "CLEAR_REFERENCES", tmp_path / "absent" / "clear_refs")
    gauge = MemoryGauge()
    assert not gauge.exact
    earlier = hold(100)
    del earlier
    gauge.restart()
    held = hold(20)
    # Below the earlier peak it is missed, as the gauge says.
    assert gauge.peak() < 4 * MEBIBYTE
    del held
    below = (memory._highest_resident() - memory._resident("VmRSS")) // MEBIBYTE
    held = hold(below + 60)
    assert abs(gauge.peak() - 60 * MEBIBYTE) < 8 * MEBIBYTE
    del held
