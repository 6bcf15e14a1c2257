"""A signal ends a call in the middle, wherever the extension is busy, and the extension works on afterwards."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from interrupted_child import CASES

PATIENCE = 1.0
"""Seconds from the signal to KeyboardInterrupt. The extension asks fifty times a second."""


@pytest.mark.skipif(os.name != "posix", reason="signals are sent the POSIX way")
def test_ctrl_c_ends_every_long_loop() -> None:
    child = subprocess.Popen(
        [sys.executable, str(Path(__file__).parent / "interrupted_child.py")], stdout=subprocess.PIPE, text=True
    )
    killer = threading.Timer(120.0, child.kill)
    killer.start()
    try:
        assert child.stdout is not None
        for name in CASES:
            assert child.stdout.readline() == f"busy: {name}\n"
            time.sleep(0.3)
            sent = time.monotonic()
            child.send_signal(signal.SIGINT)
            seconds = float(child.stdout.readline()) - sent
            assert seconds < PATIENCE, name
        assert child.stdout.readline() == "equal\n"
        assert child.wait() == 0
    finally:
        killer.cancel()
        child.kill()
        child.wait()
        child.stdout.close()
