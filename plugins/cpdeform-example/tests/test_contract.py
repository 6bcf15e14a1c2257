"""cpdeform's own checks of a simulator."""

from __future__ import annotations

import pytest

from cpdeform.testing import check_simulator
from cpdeform_example.simulator import SimulatorExample


@pytest.mark.slow
def test_keeps_the_contract_of_a_simulator() -> None:
    check_simulator(SimulatorExample).raise_if_failed()
