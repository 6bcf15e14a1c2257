"""The learners: trainings that are saved, interrupted and gone on with, and the mathematics of the first-order one."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from cpdeform import Task
from cpdeform.cli.main import app
from cpdeform_baselines.learners.configuration import PRESETS, LearnerConfiguration
from cpdeform_baselines.learners.environments import WorldsVecEnv, make_vector
from cpdeform_baselines.learners.networks import Normalisation
from cpdeform_baselines.learners.shac import LearnerShortHorizon, lambda_returns
from cpdeform_baselines.learners.training import list_checkpoints

SMALL = ["--backend", "example", "--worlds", "2", "--episode-steps", "4"]
OPTIONS = {
    "sac": ["--set", "batch_size=8", "--set", "policy_kwargs.net_arch=[8]"],
    "td3": ["--set", "batch_size=8", "--set", "policy_kwargs.net_arch=[8]"],
    "ppo": ["--set", "n_steps=4", "--set", "batch_size=8", "--set", "policy_kwargs.net_arch=[8]"],
    "shac": ["--set", "horizon=4", "--set", "critic_passes=2"],
}


def rl(*arguments: object) -> dict:
    result = CliRunner().invoke(app, ["rl", *map(str, arguments), "--json"])
    assert result.exit_code == 0, result.output
    found: dict = json.loads(result.stdout)
    return found


def refuse(*arguments: object) -> str:
    result = CliRunner().invoke(app, ["rl", *map(str, arguments)])
    assert result.exit_code == 2, result.output
    return result.stderr


@pytest.mark.parametrize("algorithm", OPTIONS)
@pytest.mark.filterwarnings("ignore::DeprecationWarning:tensorboard")
def test_a_training_and_its_resumption(algorithm: str, task_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    first = rl(task_file, "--algorithm", algorithm, "--steps", 16, *SMALL, "--out", out, *OPTIONS[algorithm])
    assert first["steps"] == 16
    assert [path.name for path in list_checkpoints(out)] == ["step-000000016"]
    assert json.loads((out / "result.json").read_text())["after"]["steps"] == 4
    with (out / "episodes.csv").open() as file:
        episodes = list(csv.DictReader(file))
    # Two worlds, eight steps each, episodes of four steps.
    assert len(episodes) == 4
    assert all(-1.0 < float(episode["return"]) < 0.0 and 0.0 < float(episode["w1"]) < 0.1 for episode in episodes)
    assert list((out / "tensorboard").glob("events*"))
    further = rl("--resume", out, "--steps", 24)
    assert further["steps"] == 24
    # It goes on with the policy that it was.
    assert further["before"] == pytest.approx(first["after"])
    assert [path.name for path in list_checkpoints(out)] == ["step-000000024"]


def test_an_interrupted_training_keeps_a_checkpoint(task_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, fit = tmp_path / "out", LearnerShortHorizon._fit_critic
    made: list[int] = []

    def interrupt(self, horizon):
        made.append(1)
        if len(made) == 2:
            raise KeyboardInterrupt
        return fit(self, horizon)

    with monkeypatch.context() as patch:
        patch.setattr(LearnerShortHorizon, "_fit_critic", interrupt)
        arguments = [task_file, "--algorithm", "shac", "--steps", 32, *SMALL, "--out", out, *OPTIONS["shac"]]
        assert CliRunner().invoke(app, ["rl", *map(str, arguments)]).exit_code == 130
    assert [path.name for path in list_checkpoints(out)] == ["step-000000016"]
    assert rl("--resume", out)["steps"] == 32


def test_unusable_requests(task_file: Path, tmp_path: Path) -> None:
    assert "TASK" in refuse()
    assert 'Did you mean "sac"' in refuse(task_file, "--algorithm", "sacc")
    assert "--preset" in refuse(task_file, "--preset", "huge")
    assert "a directory with a learner.json" in refuse("--resume", tmp_path)
    assert "--seed beside it" in refuse("--resume", tmp_path, "--seed", 1)
    (tmp_path / "file").touch()
    assert "not empty" in refuse(task_file, *SMALL, "--out", tmp_path)
    assert "options of sac" in refuse(task_file, *SMALL, "--out", tmp_path / "new", "--set", "speed=3")
    assert "some of horizon" in refuse(task_file, *SMALL, "--algorithm", "shac", "--out", tmp_path / "other", "--set", "speed=3")


def test_the_papers_budget() -> None:
    paper = PRESETS["paper"]
    assert paper["steps"] == 1_000 * paper["episode_steps"]


def test_episodes_end_as_stable_baselines_expects(task_file: Path) -> None:
    configuration = LearnerConfiguration(task=str(task_file), worlds=2, episode_steps=2, backend="example")
    environment = WorldsVecEnv(make_vector(configuration))
    environment.seed(3)
    start = environment.reset()
    actions = np.zeros((2, 3), dtype=np.float32)
    following, _, done, infos = environment.step(actions)
    assert not done.any()
    again, rewards, done, infos = environment.step(actions)
    assert done.all()
    assert rewards.shape == (2,)
    for world, info in enumerate(infos):
        assert info["TimeLimit.truncated"]
        # The clay that was there in the last step is not that of the new start.
        assert not np.array_equal(info["terminal_observation"], again[world])
        assert not np.array_equal(again[world], following[world])
    environment.seed(3)
    assert np.array_equal(environment.reset(), start)


def test_lambda_returns() -> None:
    rewards, following = torch.tensor([[1.0], [2.0], [4.0]]), torch.tensor([[10.0], [20.0], [30.0]])
    none = torch.zeros(3, 1, dtype=torch.bool)
    one_step = lambda_returns(rewards, following, none, none, discount=0.5, trace=0.0)
    assert one_step.flatten().tolist() == [6.0, 12.0, 19.0]
    whole = lambda_returns(rewards, following, none, none, discount=0.5, trace=1.0)
    assert whole.flatten().tolist() == [1.0 + 0.5 * (2.0 + 0.5 * 19.0), 2.0 + 0.5 * 19.0, 19.0]
    over = torch.tensor([[False], [True], [False]])
    truncated = lambda_returns(rewards, following, over, none, discount=0.5, trace=1.0)
    assert truncated.flatten().tolist() == [1.0 + 0.5 * 12.0, 12.0, 19.0]
    terminated = lambda_returns(rewards, following, over, over, discount=0.5, trace=1.0)
    assert terminated.flatten().tolist() == [2.0, 2.0, 19.0]


def test_normalisation_is_mean_and_deviation_of_all_that_was_seen() -> None:
    values = torch.randn(60, 4, generator=torch.Generator().manual_seed(0)) * 3.0 + 2.0
    normalisation = Normalisation(4)
    for part in values.split(20):
        normalisation.update(part)
    normal = normalisation(values)
    assert normal.mean(dim=0).abs().max() < 1e-3
    assert normal.std(dim=0, unbiased=False).numpy() == pytest.approx(np.ones(4), abs=1e-3)


def test_the_actors_gradient_goes_through_the_simulator(task_file: Path, task: Task, tmp_path: Path) -> None:
    configuration = LearnerConfiguration(
        task=str(task_file), algorithm="shac", worlds=2, episode_steps=3, backend="example",
        options={"horizon": 4, "reward_scale": 100.0},
    )  # fmt: skip
    learner = LearnerShortHorizon(configuration, tmp_path)
    # Statistics of what was seen count as constants.
    learner._normalisation.update = lambda observations: None
    generator, bias = learner._generator.get_state(), learner._actor.mean[-1].bias

    def loss() -> torch.Tensor:
        learner._generator.set_state(generator)
        learner._environment.reset(seed=0)
        found = learner._roll(lambda *_: None).loss
        assert found is not None
        return found

    loss().backward()
    slope = bias.grad.clone()
    assert float(slope.abs().max()) > 1e-3
    with torch.no_grad():
        for component in range(3):
            values = []
            for shift in (1e-2, -1e-2):
                bias[component] += shift
                values.append(float(loss()))
                bias[component] -= shift
            assert float(slope[component]) == pytest.approx((values[0] - values[1]) / 2e-2, abs=0.03 * float(slope.abs().max()))
