"""The author's kit: checks that a simulator, transport solver or placer keeps the contract of its interface.

    from cpdeform.testing import check_simulator

    def test_my_backend():
        check_simulator(SimulatorMine).raise_if_failed()

On the command line: ``cpdeform check simulator NAME``.
"""

from __future__ import annotations

from cpdeform.testing.golden import GoldenErrors, check_golden_file, compare_golden
from cpdeform.testing.golden_file import Golden, golden_files, read_golden
from cpdeform.testing.ot import check_ot_solver
from cpdeform.testing.placer import check_placer
from cpdeform.testing.report import Check, CheckError, Report
from cpdeform.testing.simulator import check_simulator

__all__ = [
    "Check",
    "CheckError",
    "Golden",
    "GoldenErrors",
    "Report",
    "check_golden_file",
    "check_ot_solver",
    "check_placer",
    "check_simulator",
    "compare_golden",
    "golden_files",
    "read_golden",
]
