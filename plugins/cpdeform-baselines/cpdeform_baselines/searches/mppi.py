"""Model predictive path integral control of a stage's plan: sampling only."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cpdeform.core.options import real_number
from cpdeform.core.placer import Candidate, Placer, PlacerCapabilities, Proposal, Stage
from cpdeform.core.task import Task, merge
from cpdeform.planning.phases.phase import Phase
from cpdeform.planning.strategies.budget import search_settings
from cpdeform.planning.strategy import Parts, Strategy
from cpdeform_baselines.searches.common import count, rollouts_only, spread, stage_numbers
from cpdeform_baselines.searches.contacts import ContactSpace
from cpdeform_baselines.searches.motions import interpolated

KNOTS = 5
"""Moments whose noise is drawn; it is interpolated in between, so that a sample is a motion and no trembling."""

TRIES = 8
"""Contact plans drawn for each that is proposed, at most: there is not always room."""


@dataclasses.dataclass
class _Search:
    """The state of a stage's search."""

    stage: Stage
    space: ContactSpace
    generator: np.random.Generator
    asked: list[Proposal] = dataclasses.field(default_factory=list)
    contact: Proposal | None = None
    mean: Tensor | None = None
    updates: int = 0


class PlacerPathIntegral(Placer):
    """Samples contacts and motions, then motions from the best contact, whose mean follows the path integral update [1]_.

    In the first round each sample has a contact of its own. The best one's is kept; in the following rounds actions are drawn
    around the mean, and the mean becomes the average of the samples, weighted by exp(-(loss - lowest loss) / temperature). The mean
    itself is one of the samples of the next round.

    Args:
        samples: Samples of a round.
        updates: Updates of the mean, one a round, after the first one.
        noise: Standard deviation of the actions, in units of action.
        temperature: In standard deviations of the round's losses.

    Raises:
        InputError: An option is out of range.

    References:
        .. [1] Williams, Aldrich, Theodorou, "Model Predictive Path Integral Control: From Theory to Parallel Computation",
           Journal of Guidance, Control, and Dynamics, 2017.
    """

    capabilities = PlacerCapabilities(needs_priorities=False, max_tools=None)

    def __init__(self, *, samples: int = 32, updates: int = 8, noise: float = 0.5, temperature: float = 0.3) -> None:
        self.samples, self.updates, self.noise = count("samples", samples), count("updates", updates), spread("noise", noise)
        self.temperature = real_number("temperature", temperature, least=1e-6, most=1e6)
        self._search: _Search | None = None

    def ask(self, stage: Stage) -> list[Proposal]:
        """Propose the samples of a round.

        Raises:
            CapabilityError: The scene has no movable tool.
        """
        if self._search is None or self._search.stage is not stage:
            self._search = _Search(stage, ContactSpace(stage), stage_numbers(stage))
        search = self._search
        if search.contact is None or search.mean is None:
            search.asked = self._first(search)
        else:
            mean, contact = search.mean, search.contact
            drawn = [mean] + [(mean + self._noise(search)).clamp(-1.0, 1.0) for _ in range(self.samples - 1)]
            label = f"mppi-{search.updates}"
            search.asked = [dataclasses.replace(contact, actions=actions, label=label) for actions in drawn]
        return search.asked

    def tell(self, results: list[Candidate]) -> bool:
        """Keep the best contact or update the mean; ask again as long as updates are left."""
        search = self._search
        if search is None:
            return False
        losses = torch.tensor([result.loss for result in results], dtype=torch.float64)
        finite = torch.isfinite(losses)
        actions = [proposal.actions for proposal in search.asked]
        if not bool(finite.any()):
            return False
        if search.contact is None:
            best = int(torch.where(finite, losses, torch.inf).argmin())
            search.contact, search.mean = search.asked[best], actions[best]
        else:
            weights = path_integral_weights(losses, temperature=self.temperature)
            stacked = torch.stack([action for action in actions if action is not None]).double()
            search.mean = torch.einsum("k,kta->ta", weights, stacked).float()
        search.updates += 1
        return search.updates <= self.updates

    def _first(self, search: _Search) -> list[Proposal]:
        proposals: list[Proposal] = []
        for _ in range(TRIES * self.samples):
            if len(proposals) == self.samples:
                break
            found = search.space.place(torch.as_tensor(search.generator.random(search.space.size)))
            if found is not None:
                actions = self._noise(search).clamp(-1.0, 1.0)
                proposals.append(Proposal(found[0], float("nan"), "mppi-0", found[1], actions))
        return proposals

    def _noise(self, search: _Search) -> Tensor:
        """Smooth noise (T, A)."""
        steps = search.stage.step_count
        knots = search.generator.normal(size=(min(KNOTS, steps), search.stage.scene.action_size))
        return self.noise * interpolated(torch.as_tensor(knots), steps).float()


def path_integral_weights(losses: Tensor, *, temperature: float) -> Tensor:
    """Weights (K,) of samples that sum to 1, from their losses (K,); 0 where a loss is not finite.

    Args:
        losses: At least one of them finite.
        temperature: In standard deviations of the finite losses.
    """
    finite = torch.isfinite(losses)
    known = losses[finite]
    scale = float(known.std()) if len(known) > 1 else 0.0
    excess = torch.where(finite, losses - known.min(), torch.inf)
    if scale == 0.0:
        return finite.to(losses) / finite.sum()
    return torch.softmax(-excess / (temperature * scale), dim=0)


class StrategyPathIntegral(Strategy):
    """Sampling only: a contact out of many, then path integral updates of its actions.

    Args:
        samples: Samples of a round.
        updates: Updates of the mean.

    Raises:
        InputError: An option is out of range.
    """

    def __init__(self, *, samples: int = 32, updates: int = 8) -> None:
        self.samples, self.updates = count("samples", samples), count("updates", updates)

    def settings(self, task: Task, *, placer: str | None) -> Mapping[str, Any]:
        """The placer, and the loss of the default strategy."""
        settings = merge(search_settings(task), {"placer": "mppi"})
        if placer in (None, "mppi"):
            settings["placer_options"] = {"samples": self.samples, "updates": self.updates}
        return settings

    def phases(self, parts: Parts) -> tuple[Phase, ...]:
        """Rollouts."""
        return rollouts_only()
