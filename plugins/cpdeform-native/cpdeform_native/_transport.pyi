from typing import Any

import numpy as np
from numpy.typing import NDArray

def instruction_sets() -> list[str]: ...

class Solver:
    def __init__(self, threads: int, instruction_set: str = "") -> None: ...
    @property
    def threads(self) -> int: ...
    @property
    def instruction_set(self) -> str: ...
    def solve(
        self,
        source: NDArray[np.floating[Any]],
        target: NDArray[np.floating[Any]],
        source_weights: NDArray[np.floating[Any]],
        target_weights: NDArray[np.floating[Any]],
        source_potential: NDArray[np.floating[Any]],
        target_potential: NDArray[np.floating[Any]],
        source_self: NDArray[np.floating[Any]],
        target_self: NDArray[np.floating[Any]],
        gradient: NDArray[np.floating[Any]],
        *,
        exponent: int,
        blur: float,
        debias: bool,
        scaling: float,
        tolerance: float,
        iterations: int,
        warm: bool,
        warm_tolerance: float,
        warm_iterations: int,
        same_target: bool,
        source_order: NDArray[np.int32],
        target_order: NDArray[np.int32],
        source_extent: float,
        target_extent: float,
    ) -> tuple[int, float, float, float]: ...
