"""Bayesian optimisation of contact plans: a Gaussian process over what gradient descent makes of them."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import torch

from cpdeform.core.placer import Candidate, Placer, PlacerCapabilities, Proposal, Stage
from cpdeform.core.task import Task, merge
from cpdeform.planning.strategies.budget import search_settings
from cpdeform.planning.strategy import Strategy
from cpdeform_baselines.searches.common import EVALUATIONS, count, stage_seed
from cpdeform_baselines.searches.contacts import ContactSpace

STARTUP_SHARE = 3
"""One in so many evaluations is drawn at random, before there is anything to fit a process to."""

TRIES = 20
"""Plans without room for the tools that are passed over, for each one proposed."""


@dataclasses.dataclass
class _Search:
    """The state of a stage's search.

    Attributes:
        stage: The stage.
        space: Its contact plans.
        study: Optuna's study.
        trials: Its trials of the last round.
        evaluations: Plans proposed so far.
        worst: The highest loss known, that of doing nothing among them; -inf for none.
    """

    stage: Stage
    space: ContactSpace
    study: Any
    trials: list[Any] = dataclasses.field(default_factory=list)
    evaluations: int = 0
    worst: float = -math.inf

    def __post_init__(self) -> None:
        if math.isfinite(self.stage.loss):
            self.worst = self.stage.loss


class PlacerBayesian(Placer):
    """Proposes contact plans by Bayesian optimisation [1]_, by Optuna's Gaussian process through ask and tell.

    The first third of a stage's evaluations is random and shares one round, the others come one by one. The value of a plan is the
    loss that the phases of the stage bring it to; that of a plan without room is the worst one known.

    Args:
        evaluations: Contact plans of a stage.

    Raises:
        InputError: `evaluations` is out of range.

    References:
        .. [1] Snoek, Larochelle, Adams, "Practical Bayesian Optimization of Machine Learning Algorithms", NeurIPS 2012.
    """

    capabilities = PlacerCapabilities(needs_priorities=False, max_tools=None)

    def __init__(self, *, evaluations: int = EVALUATIONS) -> None:
        self.evaluations = count("evaluations", evaluations)
        self._search: _Search | None = None

    def ask(self, stage: Stage) -> list[Proposal]:
        """Propose a third of the evaluations at first, then one at a time.

        Raises:
            CapabilityError: The scene has no movable tool.
        """
        startup = max(1, self.evaluations // STARTUP_SHARE)
        if self._search is None or self._search.stage is not stage:
            self._search = _Search(stage, ContactSpace(stage), _study(stage_seed(stage), startup))
        search, wanted = self._search, startup if self._search.evaluations == 0 else 1
        proposals: list[Proposal] = []
        search.trials = []
        with _quiet():
            for _ in range(TRIES * wanted):
                if len(proposals) == wanted:
                    break
                trial = search.study.ask()
                numbers = [trial.suggest_float(f"contact_{number}", 0.0, 1.0) for number in range(search.space.size)]
                found = search.space.place(torch.tensor(numbers, dtype=torch.float64))
                if found is None:
                    # A failed trial teaches the process nothing, and it would propose the same place again and again.
                    _tell(search.study, trial, search.worst)
                    continue
                search.trials.append(trial)
                label = f"bayesopt-{search.evaluations + len(proposals) + 1}"
                proposals.append(Proposal(found[0], float("nan"), label, found[1]))
        search.evaluations += len(proposals)
        return proposals

    def tell(self, results: list[Candidate]) -> bool:
        """Tell the process what became of the plans; ask again as long as evaluations are left."""
        search = self._search
        if search is None:
            return False
        with _quiet():
            for trial, result in zip(search.trials, results, strict=True):
                _tell(search.study, trial, result.loss)
        search.worst = max([search.worst, *(result.loss for result in results if math.isfinite(result.loss))])
        search.trials = []
        return bool(results) and search.evaluations < self.evaluations


class StrategyBayesian(Strategy):
    """Plain Adam from contact plans that a Gaussian process proposes; the best of them is executed.

    Args:
        evaluations: Contact plans of a stage.

    Raises:
        InputError: `evaluations` is out of range.

    References:
        Li et al., "Contact Points Discovery for Soft-Body Manipulations with Differentiable Physics", ICLR 2022.
    """

    def __init__(self, *, evaluations: int = EVALUATIONS) -> None:
        self.evaluations = count("evaluations", evaluations)

    def settings(self, task: Task, *, placer: str | None) -> Mapping[str, Any]:
        """All plans get all iterations of plain Adam."""
        settings = merge(search_settings(task), {"optimizer": {"pruner": "none", "backtrack": None}, "placer": "bayesopt"})
        if placer in (None, "bayesopt"):
            settings["placer_options"] = {"evaluations": self.evaluations}
        return settings


def _study(seed: int, startup: int) -> Any:
    import optuna

    with _quiet():
        sampler = optuna.samplers.GPSampler(seed=seed % 2**32, n_startup_trials=startup, deterministic_objective=True)
        return optuna.create_study(sampler=sampler)


def _tell(study: Any, trial: Any, loss: float) -> None:
    """Tell the loss of a plan; one that is not finite as a failure."""
    from optuna.trial import TrialState

    if math.isfinite(loss):
        study.tell(trial, loss)
    else:
        study.tell(trial, state=TrialState.FAIL)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without Optuna's messages, and its warning that the process is experimental."""
    import optuna

    level = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            yield
    finally:
        optuna.logging.set_verbosity(level)
