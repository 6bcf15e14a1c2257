"""A placer and a strategy of your own, tried without packaging anything: `deform` takes objects where it takes names.

The placer presses on the clay where it is highest above the goal. The strategy gives it a budget and varies the best plan at random
before it is executed. Run it with ``python examples/own_parts.py``.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch

from cpdeform import Candidate, Phase, Placer, PlacerCapabilities, Proposal, RunResult, Stage, Strategy, Task, deform
from cpdeform.core.clearance import tool_half_extents
from cpdeform.planning.phases.phase import Scope
from cpdeform.planning.strategy import Parts
from cpdeform.planning.workbench import Workbench

GAP = 0.002
"""Between the tool and the highest particle below it, length units."""


class PlacerExcess(Placer):
    """Puts a single tool above the columns of clay that stand highest over the goal, one proposal each.

    Args:
        count: Number of proposals.
        columns: Columns along each edge of the domain that heights are compared in.
    """

    capabilities = PlacerCapabilities(needs_priorities=False, max_tools=1)

    def __init__(self, *, count: int = 3, columns: int = 25) -> None:
        self.count, self.columns = count, columns

    def ask(self, stage: Stage) -> list[Proposal]:
        """The columns of the largest excess."""
        clay = stage.state.position[0]
        excess = self._heights(clay) - self._heights(stage.goal)
        excess[~torch.isfinite(excess)] = -torch.inf
        best = excess.flatten().topk(self.count)
        columns = [divmod(int(number), self.columns) for number in best.indices[best.values > 0.0]]
        return [self._above(stage, row, column) for row, column in columns]

    def _heights(self, points: torch.Tensor) -> torch.Tensor:
        """Height (columns, columns) of the highest point in each column; nan where there is none."""
        cells = (points[:, [0, 2]] * self.columns).long()
        numbers = cells[:, 0] * self.columns + cells[:, 1]
        heights = torch.full((self.columns**2,), torch.nan).to(points)
        heights = heights.scatter_reduce(0, numbers, points[:, 1], "amax", include_self=False)
        return heights.reshape(self.columns, self.columns)

    def _above(self, stage: Stage, row: int, column: int) -> Proposal:
        """The tool over the middle of a column, just free of all clay below it."""
        poses, clay = stage.state.tool_pose[0].clone(), stage.state.position[0]
        index = next(index for index, tool in enumerate(stage.scene.tools) if tool.movable)
        half = tool_half_extents(stage.scene.tools[index], poses[index, 3:7])
        middle = (torch.tensor([row, column]) + 0.5).to(clay) / self.columns
        below = ((clay[:, [0, 2]] - middle).abs() <= half[[0, 2]]).all(dim=1)
        poses[index, [0, 2]] = middle
        poses[index, 1] = clay[below, 1].max() + half[1] + GAP
        return Proposal(poses, score=float("nan"), label=f"column {row},{column}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhaseShake(Phase):
    """Tries random changes of the chosen plan; the best of them is executed where it is better.

    Attributes:
        count: Number of changed plans.
        spread: Standard deviation of the changes, in units of action.
        name: The phase's name.
    """

    scope: ClassVar[Scope] = "plan"
    count: int = 4
    spread: float = 0.05
    name: str = "shake"

    def run(self, bench: Workbench, candidates: list[Candidate]) -> list[Candidate]:
        """The best change, judged by rollouts without gradients."""
        plan, acting, changed = candidates[0], bench.task.step_count, []
        for _ in range(self.count):
            actions = plan.actions.clone()
            noise = self.spread * torch.randn(actions[:acting].shape, generator=bench.stage.generator)
            actions[:acting] = (actions[:acting] + noise.to(actions)).clamp(-1.0, 1.0)
            changed.append(dataclasses.replace(plan, actions=actions))
        losses = bench.rollout_losses(changed, None, phase=self.name).nan_to_num(nan=torch.inf)
        return [changed[int(losses.argmin())]]

    def accepts(self, loss: float, *, loss_before: float, loss_now: float) -> bool:
        """Only what is better than the plan."""
        return loss < loss_now


class StrategyShaken(Strategy):
    """The default descent with a budget of its own, then the shaking.

    Args:
        iterations: The most gradient steps of a stage.
    """

    def __init__(self, *, iterations: int) -> None:
        self.iterations = iterations

    def settings(self, task: Task, *, placer: str | None) -> Mapping[str, Any]:
        """The budget."""
        return {"optimizer": {"iterations": self.iterations}}

    def phases(self, parts: Parts) -> tuple[Phase, ...]:
        """One phase more than usual."""
        return (*super().phases(parts), PhaseShake())


def plan(*, iterations: int, stages: int, particles: int) -> RunResult:
    """Plan for `writer-v2` with the two."""
    few = {"scene": {"bodies": {"0": {"particle_count": particles}}}}
    return deform(
        "writer-v2", placer=PlacerExcess(), strategy=StrategyShaken(iterations=iterations), stages=stages, settings=few, seed=0
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Plan, and print which proposals won."""
    parser = argparse.ArgumentParser(description="Plan with a placer and a strategy of your own.")
    parser.add_argument("--iterations", type=int, default=12)
    parser.add_argument("--stages", type=int, default=1)
    parser.add_argument("--particles", type=int, default=6000)
    options = parser.parse_args(arguments)
    result = plan(iterations=options.iterations, stages=options.stages, particles=options.particles)
    for stage in result.stages:
        losses = ", ".join(f"{item.proposal.label}: {item.loss:.5f}" for item in stage.candidates)
        print(f"stage {stage.index} ({stage.status.value}): {stage.loss_before:.5f} -> {stage.loss:.5f}; {losses}")


if __name__ == "__main__":
    main()
