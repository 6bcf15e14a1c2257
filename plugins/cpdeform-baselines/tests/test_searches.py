"""The searches: where they place tools, what they learn from losses, and runs with each of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import cpdeform_baselines.searches
from cpdeform import Task, deform
from cpdeform.core.errors import InputError
from cpdeform.core.placer import Candidate, Placer, Stage
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.state import initial_state
from cpdeform.run.result import RunResult
from cpdeform.testing import check_placer
from cpdeform_baselines.searches.bayesopt import PlacerBayesian
from cpdeform_baselines.searches.cma import PlacerEvolution
from cpdeform_baselines.searches.contacts import ContactSpace
from cpdeform_baselines.searches.motions import interpolated
from cpdeform_baselines.searches.mppi import PlacerPathIntegral, path_integral_weights
from cpdeform_baselines.searches.sampled import PlacerSamples

LINES = 200


@pytest.fixture
def stage(task: Task) -> Stage:
    state = initial_state(task.scene, dtype=torch.float64)
    goal = torch.as_tensor(task.load_goal())
    return Stage(0, task.scene, state, goal, None, torch.Generator().manual_seed(0), loss=1.0, step_count=4)


@pytest.fixture
def two_tools(task: Task) -> Stage:
    ball = task.scene.tools[0]
    other = ball.model_copy(update={"position": (0.7, 0.3, 0.5)})
    scene = task.scene.model_copy(update={"tools": (ball, other)})
    state = initial_state(scene, dtype=torch.float64)
    return Stage(0, scene, state, state.position[0], None, torch.Generator().manual_seed(0), loss=1.0, step_count=4)


def search(placer: Placer, stage: Stage, loss) -> list[tuple[str, float]]:
    """Labels and losses of everything that a placer asks about in a stage."""
    found = []
    while True:
        proposals = placer.ask(stage)
        results = [Candidate(proposal, loss(proposal), torch.zeros(4, 3)) for proposal in proposals]
        found += [(result.proposal.label, result.loss) for result in results]
        if not placer.tell(results):
            return found


def test_files_are_small() -> None:
    for path in Path(cpdeform_baselines.searches.__file__).parent.glob("*.py"):
        assert len(path.read_text().splitlines()) < LINES, path.name


@pytest.mark.parametrize("name", ["stage", "two_tools"])
def test_contact_plans_touch_and_do_not_collide(name: str, request: pytest.FixtureRequest) -> None:
    stage: Stage = request.getfixturevalue(name)
    space, generator = ContactSpace(stage), np.random.default_rng(0)
    assert space.size == (3 if name == "stage" else 4)
    particles, placed = stage.state.position[0], 0
    for _ in range(12):
        found = space.place(torch.as_tensor(generator.random(space.size)))
        if found is None:
            continue
        poses, contact = found
        placed += 1
        assert 0 <= contact < len(particles)
        for tool, pose in zip(stage.scene.tools, poses, strict=True):
            gap = float(signed_distance(tool, pose, particles).min())
            assert -1e-6 < gap < 1e-3
    assert placed >= 6


def test_near_plans_have_near_contacts(stage: Stage) -> None:
    space = ContactSpace(stage)
    corner, opposite = torch.zeros(3), torch.ones(3)
    contacts = [space._contact(point) for point in (corner, corner + 0.01, opposite)]
    particles = stage.state.position[0]
    lower, upper = particles.amin(0), particles.amax(0)
    assert float((particles[contacts[0]] - particles[contacts[1]]).norm()) < 0.05
    assert float((particles[contacts[0]] - lower).norm()) < float((particles[contacts[0]] - upper).norm())
    assert float((particles[contacts[2]] - upper).norm()) < float((particles[contacts[2]] - lower).norm())


def test_motions_pass_through_their_knots() -> None:
    knots = torch.tensor([[0.0], [1.0], [-1.0]])
    assert interpolated(knots, 5).flatten().tolist() == pytest.approx([0.0, 0.5, 1.0, 0.0, -1.0])
    assert interpolated(knots[:1], 3).flatten().tolist() == [0.0, 0.0, 0.0]


def test_the_gaussian_process_goes_where_losses_are_low(stage: Stage) -> None:
    def loss(proposal):
        return float((proposal.pose[0, :3] - torch.tensor([0.55, 0.24, 0.55]).double()).square().sum())

    found = search(PlacerBayesian(evaluations=9), stage, loss)
    assert [label for label, _ in found] == [f"bayesopt-{number}" for number in range(1, 10)]
    random, guided = [value for _, value in found[:3]], [value for _, value in found[3:]]
    assert min(guided) < 0.5 * min(random)


def test_losses_that_are_not_finite_are_no_news_to_the_process(stage: Stage) -> None:
    assert len(search(PlacerBayesian(evaluations=4), stage, lambda proposal: float("nan"))) == 4


def test_the_process_looks_elsewhere_where_there_is_no_room(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing fits in three quarters of the plans; where nothing fits at all, the search ends."""
    place, tried = ContactSpace.place, list[float]()

    def partly(self, numbers):
        tried.append(float(numbers[0]))
        return place(self, numbers) if numbers[0] > 0.75 else None

    monkeypatch.setattr(ContactSpace, "place", partly)
    found = search(PlacerBayesian(evaluations=6), stage, lambda proposal: 0.5)
    assert len(found) == 6
    guided = tried[-4:]
    assert sum(number > 0.75 for number in guided) >= 3
    monkeypatch.setattr(ContactSpace, "place", lambda self, numbers: None)
    assert search(PlacerBayesian(evaluations=6), stage, lambda proposal: 0.5) == []


def test_evolution_lowers_the_loss_over_generations(stage: Stage) -> None:
    def loss(proposal):
        return float((proposal.actions - 0.5).square().sum() + (proposal.pose[0, 0] - 0.5) ** 2)

    found = search(PlacerEvolution(generations=12, population=12, knots=2), stage, loss)
    first = [value for label, value in found if label == "cma-1"]
    last = [value for label, value in found if label == "cma-12"]
    assert len(last) > 3
    assert np.mean(last) < 0.3 * np.mean(first)


def test_path_integral_weights() -> None:
    losses = torch.tensor([1.0, 2.0, 3.0, torch.nan], dtype=torch.float64)
    weights = path_integral_weights(losses, temperature=0.5)
    assert float(weights.sum()) == pytest.approx(1.0)
    assert float(weights[3]) == 0.0
    # The standard deviation of 1, 2, 3 is 1.
    assert float(weights[1] / weights[0]) == pytest.approx(np.exp(-1.0 / 0.5))
    assert path_integral_weights(torch.ones(4).double(), temperature=0.5).tolist() == [0.25] * 4


def test_path_integral_keeps_the_best_contact_and_lowers_the_mean_loss(stage: Stage) -> None:
    contacts = {}

    def loss(proposal):
        contacts.setdefault(proposal.label, set()).add(proposal.contact_particle)
        return float((proposal.actions - 0.4).square().sum())

    found = search(PlacerPathIntegral(samples=16, updates=5), stage, loss)
    assert len(contacts["mppi-0"]) > 4
    assert all(len(contacts[f"mppi-{number}"]) == 1 for number in range(1, 6))
    # The first sample of a round is the mean.
    means = [next(value for label, value in found if label == f"mppi-{number}") for number in range(1, 6)]
    assert means[-1] < 0.5 * means[0]


STRATEGIES = {
    "restarts": {"restarts": 2},
    "bayesopt": {"evaluations": 4},
    "cma": {"generations": 3, "population": 6},
    "mppi": {"samples": 6, "updates": 2},
    "sampled-gradients": {"samples": 8, "keep": 2},
}


def run(task: Task, name: str) -> RunResult:
    settings = {"optimizer": {"iterations": 3}, "strategy_options": STRATEGIES[name], "objective": {"points": 100}}
    return deform(task, simulator="example", strategy=name, settings=settings, seed=1)


@pytest.mark.parametrize("name", STRATEGIES)
def test_a_run_with_each_strategy(task: Task, name: str) -> None:
    result = run(task, name)
    (stage,) = result.stages
    labels = [candidate.proposal.label for candidate in stage.candidates]
    counts = {
        "restarts": (2, 6, 1),
        "bayesopt": (4, 12, 1),
        "cma": (None, 0, None),
        "mppi": (18, 0, 19),
        "sampled-gradients": (8, 6, 9),
    }
    candidates, gradients, rollouts = counts[name]
    assert candidates is None or len(labels) == candidates
    assert stage.gradient_evaluations == gradients
    assert stage.rollouts == (len(labels) + 1 if rollouts is None else rollouts)
    assert stage.loss < stage.loss_before


def test_a_seed_repeats(task: Task) -> None:
    first, again = run(task, "mppi"), run(task, "mppi")
    assert first.loss_final == again.loss_final


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("restarts", {"restarts": 0}, "restarts"),
        ("bayesopt", {"evaluations": 0}, "evaluations"),
        ("cma", {"population": 1}, "population"),
        ("mppi", {"samples": "many"}, "samples"),
        ("sampled-gradients", {"keep": 0}, "keep"),
    ],
)
def test_unusable_options(task: Task, name: str, options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        deform(task, strategy=name, settings={"strategy_options": options})


@pytest.mark.parametrize(
    "placer",
    [
        PlacerBayesian(evaluations=6),
        PlacerEvolution(generations=2, population=4),
        PlacerPathIntegral(samples=4, updates=2),
        PlacerSamples(samples=4),
    ],
    ids=lambda placer: type(placer).__name__,
)
def test_the_authors_kit_passes_the_placers(placer: Placer) -> None:
    check_placer(placer).raise_if_failed()
