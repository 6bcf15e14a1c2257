"""Damaged inputs of every kind end in one error for the user: no traceback, no hang, no gigabytes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

KINDS = ("goal", "grid", "record", "golden", "task", "setting")
CAMPAIGN = Path(__file__).parent / "campaign.py"
MEGABYTES = 500


def try_damaged(kinds: tuple[str, ...], count: int, directory: Path, *, limit: float) -> None:
    command = [sys.executable, str(CAMPAIGN), ",".join(kinds), str(count), "0", str(directory)]
    path = os.pathsep.join([str(CAMPAIGN.parents[1]), *os.environ.get("PYTHONPATH", "").split(os.pathsep)])
    try:
        finished = subprocess.run(
            command, capture_output=True, text=True, timeout=limit, env={**os.environ, "PYTHONPATH": path.strip(os.pathsep)}
        )
    except subprocess.TimeoutExpired as error:
        pytest.fail(f"not done after {limit:g} seconds; the last case was {(error.stderr or b'').decode().splitlines()[-1:]}")
    assert finished.returncode == 0, finished.stderr[-2000:]
    results = json.loads(finished.stdout.splitlines()[-1])
    assert [result["kind"] for result in results] == list(kinds)
    for result in results:
        assert not result["faults"], f"{result['kind']}: {len(result['faults'])} of {count}, the first: {result['faults'][0]}"
        assert result["megabytes"] < MEGABYTES
        # Some damage is harmless, most is not: else the damage or the reading would be none.
        assert result["accepted"] > 0
        assert result["refused"] > 0.3 * count


def test_damaged_inputs(tmp_path):
    try_damaged(KINDS, 150, tmp_path, limit=300)


@pytest.mark.faults
@pytest.mark.parametrize("kind", KINDS)
def test_thousands_of_damaged_inputs(tmp_path, kind):
    try_damaged((kind,), 2000, tmp_path, limit=1200)
