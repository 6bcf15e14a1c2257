"""Long work of the extension, case after case, each to be ended by a signal; see test_interrupt.py.

Prints a line before each case, and one with the time of the clock `time.monotonic` when its KeyboardInterrupt was caught.
"""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable

import torch

from cpdeform.core.scene import Scene
from cpdeform_native.ot import OTSolverNative
from cpdeform_native.simulator import SimulatorNative

STEPS = 1000


def simulator(particles: int, *, worlds: int = 1, threads: int = 2, memory_budget: int = 0) -> SimulatorNative:
    body = {"kind": "box", "position": (0.5, 0.2, 0.5), "widths": (0.3, 0.3, 0.3), "particle_count": particles}
    scene = Scene.model_validate({"bodies": [body], "substeps": 200})
    return SimulatorNative(scene, batch_size=worlds, threads=threads, memory_budget=memory_budget)


def rollout(particles: int, *, worlds: int = 1, threads: int = 2) -> Callable[[], object]:
    made = simulator(particles, worlds=worlds, threads=threads)
    state = made.initial_state(batch_size=worlds)
    return lambda: made.rollout(state, torch.zeros(worlds, STEPS, 0))


def gradient() -> Callable[[], object]:
    made = simulator(20000)
    trajectory = made.rollout(made.initial_state(), torch.zeros(1, 1, 0))
    weights = torch.ones_like(trajectory.positions)

    def work() -> None:
        while True:
            made.vjp(trajectory, weights)

    return work


def transport(count: int, *, blur: float, threads: int) -> Callable[[], object]:
    generator = torch.Generator().manual_seed(0)
    source, target = (torch.rand(count, 3, generator=generator) for _ in range(2))
    solver = OTSolverNative(blur=blur, tolerance=1e-12, iterations=10**6, threads=threads)
    return lambda: solver.solve(source, target)


CASES: dict[str, Callable[[], Callable[[], object]]] = {
    "rollout of one world on two threads": lambda: rollout(10000),
    "rollout of worlds side by side and one left over": lambda: rollout(3000, worlds=3),
    "rollout on one thread": lambda: rollout(3000, threads=1),
    "gradient whose substeps are computed again": gradient,
    "transport with too many iterations": lambda: transport(3000, blur=1e-5, threads=2),
    "transport of many pairs on one thread": lambda: transport(20000, blur=0.5, threads=1),
}


def say(line: object) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def main() -> None:
    # the parent may ignore the signal, as what a script starts in the background does
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for name, make in CASES.items():
        work = make()
        try:
            say(f"busy: {name}")
            work()
            say(f"ended by itself: {name}")
        except KeyboardInterrupt:
            say(time.monotonic())
    made = simulator(500, worlds=3)
    state, actions = made.initial_state(batch_size=3), torch.zeros(3, 1, 0)
    first, again = (made.rollout(state, actions).positions for _ in range(2))
    say("equal" if torch.equal(first, again) else "different")


if __name__ == "__main__":
    main()
