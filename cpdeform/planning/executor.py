"""The executor seam: where the independent pieces of a search are computed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

Item = TypeVar("Item")
Answer = TypeVar("Answer")


class Executor(Protocol):
    """Computes a function of independent items, in this process or elsewhere.

    Attributes:
        width: How many items it computes at the same time; work is cut into at least as many, where there is that much.
    """

    @property
    def width(self) -> int:
        """How many items it computes at the same time."""
        ...

    def map(self, function: Callable[[Item], Answer], items: Sequence[Item]) -> list[Answer]:
        """Answers in the order of the items.

        Args:
            function: Computes one item; the result may depend on nothing but the item. It is an object of a module-level class,
                so that a process elsewhere can take it over.
            items: What to compute.
        """
        ...


class ExecutorSerial:
    """One item after the other in this process: a simulator uses every core already."""

    width = 1

    def map(self, function: Callable[[Item], Answer], items: Sequence[Item]) -> list[Answer]:
        """Answers in the order of the items."""
        return [function(item) for item in items]
