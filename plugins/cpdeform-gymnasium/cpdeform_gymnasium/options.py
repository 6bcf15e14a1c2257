"""What single and vector environments share: spaces and checks."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from cpdeform.core.errors import InputError
from cpdeform_gymnasium.picture import RENDER_MODE


def observation_space(size: int) -> gymnasium.Space[NDArray[Any]]:
    """The space of observations of `size` values."""
    return gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)


def action_space(size: int) -> gymnasium.Space[NDArray[Any]]:
    """The space of actions of `size` numbers."""
    return gymnasium.spaces.Box(-1.0, 1.0, (size,), np.float32)


def check_render_mode(render_mode: str | None) -> None:
    """Raise `InputError` unless a render mode is known."""
    if render_mode not in (None, RENDER_MODE):
        raise InputError("render_mode", came=f'"{render_mode}"', expected=f'None or "{RENDER_MODE}"')
