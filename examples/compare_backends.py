"""The same motion in all installed simulators: where the clay ends, and what gradient they give, beside time.

A ball pushes a block of clay; the loss is the mean height of the clay at the end. Run it with
``python examples/compare_backends.py``.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Sequence

import torch
from torch import Tensor

from cpdeform import Scene, differentiable_rollout, load_registry

BLOCK = {"kind": "box", "position": (0.5, 0.08, 0.5), "widths": (0.16, 0.12, 0.16)}
BALL = {"kind": "Sphere", "radius": 0.05, "position": (0.38, 0.12, 0.5), "action_scale": (0.01, 0.01, 0.01)}


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a simulator makes of the motion.

    Attributes:
        position: Final positions (N, 3), length units.
        gradient: Gradient (T, 3) of the mean height by the actions, length units.
        seconds: Wall time of rollout and gradient, compiled kernels at hand.
    """

    position: Tensor
    gradient: Tensor
    seconds: float


def make_scene(particles: int) -> Scene:
    """A block and a ball that touches it."""
    return Scene.model_validate({"bodies": [{**BLOCK, "particle_count": particles}], "tools": [BALL], "grid_size": 32})


def simulate(backend: str, scene: Scene, actions: Tensor) -> Outcome:
    """Push, and differentiate; once to compile, once to measure."""
    simulator = load_registry().create("simulator", backend, scene=scene, dtype=torch.float64)
    for _ in range(2):
        moved = actions.clone().requires_grad_()
        begun = time.perf_counter()
        final = differentiable_rollout(simulator, simulator.initial_state(), moved).final_state
        final.position[0, :, 1].mean().backward()
        seconds = time.perf_counter() - begun
    assert moved.grad is not None
    return Outcome(final.position[0].detach(), moved.grad[0], seconds)


def compare(backends: Sequence[str], *, particles: int, steps: int) -> dict[str, Outcome]:
    """The outcome of each simulator."""
    scene = make_scene(particles)
    push = torch.tensor([1.0, -0.2, 0.0], dtype=torch.float64)
    actions = push.repeat(1, steps, 1)
    return {backend: simulate(backend, scene, actions) for backend in backends}


def main(arguments: Sequence[str] | None = None) -> None:
    """Compare, and print a line for each simulator."""
    known = ["native", "warp", "taichi"]
    parser = argparse.ArgumentParser(description="Compare simulators and their gradients.")
    parser.add_argument("--backends", default=None, help="names, separated by commas; defaults to all built-in ones installed")
    parser.add_argument("--particles", type=int, default=2000)
    parser.add_argument("--steps", type=int, default=6)
    options = parser.parse_args(arguments)
    installed = load_registry().installed("simulator")
    names = options.backends.split(",") if options.backends else [name for name in known if name in installed]
    outcomes = compare(names, particles=options.particles, steps=options.steps)
    first = outcomes[names[0]]
    for name, outcome in outcomes.items():
        apart = float((outcome.position - first.position).abs().max())
        cosine = float(torch.cosine_similarity(outcome.gradient.flatten(), first.gradient.flatten(), dim=0))
        print(f"{name:8} {outcome.seconds:7.3f} s; against {names[0]}: positions {apart:.1e} apart, gradients' cosine {cosine:.9f}")


if __name__ == "__main__":
    main()
