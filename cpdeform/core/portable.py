"""Objects that other processes can have, although what is in them belongs to this one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Self


class Portable:
    """Pickled as the call that made it: handles of compiled code, buffers and threads are made anew where it is unpickled.

    It fits parts whose arguments say all that there is to know about them, and that keep nothing from call to call which changes a
    result.
    """

    _made_with: tuple[tuple[Any, ...], dict[str, Any]]

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Make it, and remember how."""
        made = super().__new__(cls)
        object.__setattr__(made, "_made_with", (args, kwargs))
        return made

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        """How to make another one like it."""
        return _make, (type(self), *self._made_with)


def _make(kind: type[Portable], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Portable:
    return kind(*args, **kwargs)
