"""Adam's steps on the actions of several worlds, each world for itself."""

from __future__ import annotations

import torch
from torch import Tensor

BACKTRACK = 0.5
"""Factor of a world's step size each time that it goes back."""


class Descent:
    """Adam [1]_ on actions clipped to [-1, 1]; a world whose tools lost the clay goes back.

    A step too large lifts the tools off. Then no action has an influence any more: the gradient is zero, and Adam's momentum
    carries the tools farther away. With `backtrack`, a world with a gradient of exactly zero is put back to its best plan that
    had one, forgets its momentum and goes on from there with half the step size.

    Args:
        actions: First actions (B, T, A).
        backtrack: Whether worlds go back.

    References:
        .. [1] Kingma, Ba, "Adam: A Method for Stochastic Optimization", ICLR 2015.
    """

    def __init__(self, actions: Tensor, *, backtrack: bool) -> None:
        # A parameter and a group for each world, since each has its own momentum and step size.
        self._worlds = [torch.nn.Parameter(world.detach().clone()) for world in actions]
        self._adam = torch.optim.Adam([{"params": [world]} for world in self._worlds])
        self._backtrack = backtrack
        self._scales = [1.0] * len(self._worlds)
        self._best: dict[int, tuple[float, Tensor, Tensor]] = {}

    def actions(self, worlds: Tensor) -> Tensor:
        """Actions (b, T, A) of the worlds with the given indices (b,)."""
        return torch.stack([self._worlds[world].detach() for world in worlds.tolist()])

    def step(self, worlds: Tensor, loss: Tensor, gradient: Tensor, *, learning_rate: float) -> None:
        """Take a step in each of the given worlds.

        Args:
            worlds: Indices (b,).
            loss: Loss (b,) of their present actions, objective units.
            gradient: Its gradient (b, T, A).
            learning_rate: Adam's step size, in units of action.
        """
        self._adam.zero_grad()
        for world, value, slope in zip(worlds.tolist(), loss.tolist(), gradient, strict=True):
            parameter = self._worlds[world]
            parameter.grad = slope.to(parameter)
            if self._backtrack:
                self._return_if_lost(world, value)
            self._adam.param_groups[world]["lr"] = learning_rate * self._scales[world]
        self._adam.step()
        with torch.no_grad():
            for world in worlds.tolist():
                self._worlds[world].clamp_(-1.0, 1.0)

    def _return_if_lost(self, world: int, loss: float) -> None:
        """Note a plan with a gradient if it is the best; take the one noted in the place of a plan without."""
        parameter = self._worlds[world]
        gradient = parameter.grad
        if gradient is not None and bool(gradient.any()):
            if world not in self._best or loss < self._best[world][0]:
                self._best[world] = (loss, parameter.detach().clone(), gradient.clone())
        elif world in self._best:
            _, actions, parameter.grad = self._best[world]
            with torch.no_grad():
                parameter.copy_(actions)
            self._adam.state.pop(parameter, None)
            self._scales[world] *= BACKTRACK
