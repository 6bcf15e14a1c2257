"""A closed-loop policy that learns to push clay where it is told, with gradients through every step of the simulator.

A linear policy sees where the tool, the clay and the wanted place are, and chooses the next motion of the tool. The simulator goes
one step, and the policy sees what became of it. Four worlds want the clay at four places, so that no single plan serves them all.
The loss is the mean squared distance of the clay's centre from the wanted one at the end; its gradient goes back through all steps.

Run it with ``python examples/closed_loop_policy.py``; it takes a few seconds.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import torch
from torch import Tensor

from cpdeform import Scene, Simulator, State, differentiable_rollout
from cpdeform.core.plugins import load_registry

BODY = {"kind": "box", "position": (0.5, 0.06, 0.5), "widths": (0.12, 0.1, 0.12), "particle_count": 500}
TOOL = {"kind": "Box", "half_extents": (0.02, 0.05, 0.08), "position": (0.40, 0.08, 0.5), "action_scale": (0.02, 0.0, 0.0)}
SCENE = Scene.model_validate({"bodies": [BODY], "tools": [TOOL], "grid_size": 32, "substeps": 10, "ground_friction": 0.5})
SHIFTS = (0.01, 0.02, 0.03, 0.04)
"""How far the clay is to go along x, one number a world, length units."""

STEPS = 8
LENGTH = 0.05
"""What the policy sees are distances in this unit, length units."""


class Policy(torch.nn.Module):
    """Chooses the tool's motion along x from what it sees: tanh of a linear function."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = torch.nn.Linear(2, 1)
        torch.nn.init.zeros_(self.linear.weight)
        torch.nn.init.constant_(self.linear.bias, 0.3)

    def forward(self, state: State, wanted: Tensor) -> Tensor:
        """Actions (B, 3), in [-1, 1], from a state and the wanted place (B,) of the clay's centre along x."""
        centre, tool = state.position[..., 0].mean(dim=1), state.tool_pose[:, 0, 0]
        seen = torch.stack([wanted - centre, centre - tool], dim=-1) / LENGTH
        push = torch.tanh(self.linear(seen))
        return torch.cat([push, torch.zeros_like(push), torch.zeros_like(push)], dim=-1)


def miss(simulator: Simulator, policy: Policy, shifts: Sequence[float]) -> Tensor:
    """How far (B,) the clay's centre is from the wanted place along x at the end of a closed loop, length units."""
    state = simulator.initial_state(batch_size=len(shifts))
    wanted = state.position[..., 0].mean(dim=1) + torch.tensor(shifts).to(state.position)
    for _ in range(STEPS):
        actions = policy(state, wanted).unsqueeze(1)
        state = differentiable_rollout(simulator, state, actions).final_state
    return state.position[..., 0].mean(dim=1) - wanted


def train(simulator: Simulator, *, iterations: int, seed: int = 0) -> tuple[Policy, list[float]]:
    """Learn a policy; returns it and the root mean square of the miss in each iteration, length units."""
    torch.manual_seed(seed)
    policy = Policy().to(simulator.dtype)
    optimizer = torch.optim.Adam(policy.parameters(), lr=0.1)
    history = []
    for _ in range(iterations):
        optimizer.zero_grad()
        loss = miss(simulator, policy, SHIFTS).square().mean()
        (loss / LENGTH**2).backward()
        optimizer.step()
        history.append(float(loss.detach()) ** 0.5)
    return policy, history


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, and show what was learnt."""
    parser = argparse.ArgumentParser(description="Learn a closed-loop policy that pushes clay where it is told.")
    parser.add_argument("--backend", default="auto", help="simulator; see `cpdeform plugins`")
    parser.add_argument("--iterations", type=int, default=40)
    options = parser.parse_args(arguments)
    registry = load_registry()
    backend = registry.resolve("simulator", options.backend, device="cpu")
    simulator = registry.create("simulator", backend, scene=SCENE, batch_size=len(SHIFTS))
    policy, history = train(simulator, iterations=options.iterations)
    for iteration in range(0, len(history), 5):
        print(f"iteration {iteration:3d}: the clay misses its place by {history[iteration]:.5f} of the domain's edge")
    with torch.no_grad():
        others = (0.015, 0.035)
        for shift, found in zip(others, miss(simulator, policy, others).tolist(), strict=True):
            print(f"never seen in training: wanted {shift:.3f}, came to {shift + found:.4f}")


if __name__ == "__main__":
    main()
