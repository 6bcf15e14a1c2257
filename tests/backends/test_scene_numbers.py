"""The numbers that backends' kernels see."""

from __future__ import annotations

import pytest

from cpdeform.backends.scene_numbers import tool_size
from cpdeform.core.errors import InputError
from cpdeform.core.scene import ManipulatorBase, ManipulatorTorus


def test_an_unknown_tool_is_no_torus() -> None:
    assert tool_size(ManipulatorTorus(position=(0.5, 0.5, 0.5), major_radius=0.1, tube_radius=0.02)) == (0.1, 0.02, 0.0, 0.0)
    with pytest.raises(InputError, match=r"manipulator: got ManipulatorBase"):
        tool_size(ManipulatorBase(position=(0.5, 0.5, 0.5)))  # type: ignore[arg-type]
