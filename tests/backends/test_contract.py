"""The backends keep the contract of a simulator."""

from __future__ import annotations

import pytest
from backend_cases import BACKENDS, backend_class

from cpdeform.testing import check_simulator


@pytest.mark.slow
@pytest.mark.parametrize("backend", BACKENDS)
def test_keeps_the_contract_of_a_simulator(backend: str) -> None:
    report = check_simulator(backend_class(backend))
    report.raise_if_failed()
    assert [check.name for check in report.checks if check.status == "skipped"] == ["gradient is refused where not declared"]
