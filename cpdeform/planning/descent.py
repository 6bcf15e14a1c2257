"""Adam's steps on the actions of several worlds, each world for itself."""

from __future__ import annotations

import math

import torch
from torch import Tensor

BACKTRACK = 0.5
"""Factor of a world's step size each time that it goes back."""


class Descent:
    """Adam [1]_ on actions clipped to [-1, 1]; a world that gains nothing for a while goes back to its best plan.

    A step too large presses the tools too deep, the next ones lift them off the clay. There the gradient is small or zero, and
    Adam's momentum carries the tools farther away. A world whose loss was not the lowest so far for `backtrack` steps in a row is
    put back to its best plan, forgets its momentum and goes on from there with half the step size. So is, at once, one whose loss
    or gradient is not finite, or whose loss is more than `leap` above its best: who knocked the clay over does not find back.

    Args:
        actions: First actions (B, T, A).
        backtrack: Steps without a gain after which a world goes back; None for never, not even of a world that broke.
        leap: Rise of the loss above the best one, as a share of it, after which a world goes back at once; None for none, as where
            `backtrack` is.

    References:
        .. [1] Kingma, Ba, "Adam: A Method for Stochastic Optimization", ICLR 2015.
    """

    def __init__(self, actions: Tensor, *, backtrack: int | None, leap: float | None = None) -> None:
        # A parameter and a group for each world, since each has its own momentum and step size.
        self._worlds = [torch.nn.Parameter(world.detach().clone()) for world in actions]
        self._adam = torch.optim.Adam([{"params": [world]} for world in self._worlds])
        self._backtrack, self._leap = backtrack, leap
        self._scales = [1.0] * len(self._worlds)
        self._idle = [0] * len(self._worlds)
        self._bounds = [torch.ones_like(world) for world in actions]
        self._best: dict[int, tuple[float, Tensor, Tensor]] = {}

    def actions(self, worlds: Tensor) -> Tensor:
        """Actions (b, T, A) of the worlds with the given indices (b,)."""
        return torch.stack([self._worlds[world].detach() for world in worlds.tolist()])

    def put(self, worlds: Tensor, actions: Tensor) -> None:
        """Go on from the actions (b, T, A) that were executed, where the simulator tells others than those asked for.

        Where these are beyond [-1, 1], the next ones may be as far beyond.
        """
        with torch.no_grad():
            for world, executed in zip(worlds.tolist(), actions, strict=True):
                self._worlds[world].copy_(executed)
                self._bounds[world] = executed.detach().abs().clamp_min(1.0)

    def can_return(self, worlds: Tensor) -> Tensor:
        """Whether each of the worlds with the given indices (b,) has a plan to go back to, (b,)."""
        return torch.tensor([world in self._best for world in worlds.tolist()], dtype=torch.bool)

    def step(self, worlds: Tensor, loss: Tensor, gradient: Tensor, *, learning_rate: float) -> None:
        """Take a step in each of the given worlds.

        Args:
            worlds: Indices (b,).
            loss: Loss (b,) of their present actions, objective units. It may be other than finite, as may the gradient, where a
                world `can_return`.
            gradient: Its gradient (b, T, A).
            learning_rate: Adam's step size, in units of action.
        """
        self._adam.zero_grad()
        for world, value, slope in zip(worlds.tolist(), loss.tolist(), gradient, strict=True):
            self._worlds[world].grad = slope.to(self._worlds[world])
            if not (math.isfinite(value) and bool(slope.isfinite().all())):
                self._return(world)
            elif self._backtrack is not None:
                self._note(world, value, slope)
                if self._idle[world] >= self._backtrack or self._leapt(world, value):
                    self._return(world)
            self._adam.param_groups[world]["lr"] = learning_rate * self._scales[world]
        self._adam.step()
        with torch.no_grad():
            for world in worlds.tolist():
                self._worlds[world].clamp_(-self._bounds[world], self._bounds[world])

    def _note(self, world: int, loss: float, gradient: Tensor) -> None:
        """Keep the plan if it is the world's best."""
        if world not in self._best or loss < self._best[world][0]:
            self._best[world] = (loss, self._worlds[world].detach().clone(), gradient.clone())
            self._idle[world] = 0
        else:
            self._idle[world] += 1

    def _leapt(self, world: int, loss: float) -> bool:
        """Whether the loss is too far above the world's best."""
        best = self._best[world][0]
        return self._leap is not None and loss - best > self._leap * abs(best)

    def _return(self, world: int) -> None:
        """Put the world back to its best plan, with that plan's gradient."""
        parameter = self._worlds[world]
        _, actions, gradient = self._best[world]
        with torch.no_grad():
            parameter.copy_(actions)
        parameter.grad = gradient.to(parameter)
        self._adam.state.pop(parameter, None)
        self._scales[world] *= BACKTRACK
        self._idle[world] = 0
