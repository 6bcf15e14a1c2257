"""The backends against recorded trajectories and gradients of PlasticineLab (float64)."""

from __future__ import annotations

import pytest
from backend_cases import BACKENDS, backend_class
from golden import NAMES, golden_path

from cpdeform.testing import check_golden_file

FORWARD_ONLY = {"chopsticks-v2", "multistage_airplane-v1", "multistage_star-v1"}


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("backend", BACKENDS)
def test_positions_velocities_and_gradient_are_plasticinelabs(backend: str, name: str) -> None:
    errors = check_golden_file(golden_path(name), backend_class(backend))
    assert errors.status == "passed", str(errors)
    assert (errors.gradient_cosine is None) == (name in FORWARD_ONLY)
    if errors.loss_error is not None:
        assert errors.loss_error < 1e-4
