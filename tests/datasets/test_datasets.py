"""Data sets: what is in the files is what the records hold, and can be simulated again."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import subprocess
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from cpdeform.cli.main import app
from cpdeform.core.errors import InputError
from cpdeform.core.plugins import load_registry
from cpdeform.datasets.build import BuiltDataset, build_dataset
from cpdeform.datasets.job_plan import new_dataset
from cpdeform.datasets.replay import replay
from cpdeform.datasets.settings import DatasetSettings
from cpdeform.run.record_reader import load_record
from cpdeform.sweep.queue import Queue
from cpdeform.sweep.worker import Worker

SETTINGS = DatasetSettings(
    scene="move",
    goals=(3, 4),
    settings={
        "stages": 2,
        "steps": 6,
        "rest_steps": 2,
        "optimizer": {"iterations": 2},
        "scene": {"bodies": {"0": {"particle_count": 200}}},
        "simulator_options": {"threads": 1},
    },
    particles=50,
    success_iou=0.01,
    shard_size=1,
)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[Queue, BuiltDataset]:
    """A data set of two plans of two stages, not to be changed; its directory is given relative to where the test runs."""
    queue = new_dataset(tmp_path_factory.mktemp("data") / "clay", SETTINGS, registry=load_registry())
    assert [outcome.outcome for outcome in Worker(queue).work()] == ["done", "done"]
    relative = Queue(Path(os.path.relpath(queue.directory)))
    return queue, dataclasses.replace(build_dataset(relative, SETTINGS, name="clay"), directory=queue.directory / "dataset")


def records(queue: Queue) -> list[Any]:
    return [load_record(queue.directory / queue.job(name).record) for name in queue.names()]


def test_trajectories_are_those_of_the_records(made):
    queue, built = made
    for number, record in enumerate(records(queue)):
        stages = [stage for stage in record.stages if stage.status.executed]
        content = json.loads((built.directory / f"trajectories-{number:05d}.json").read_text())
        assert content["env_info"]["env_id"] == "cpdeform/move-v1"
        (said,) = content["episodes"]
        assert (said["episode_id"], said["number"], said["episode_seed"]) == (0, number, SETTINGS.goals[number])
        with h5py.File(built.directory / f"trajectories-{number:05d}.h5") as file:
            group = file["traj_0"]
            steps = said["elapsed_steps"]
            assert steps == 8 * len(stages)
            lengths = {len(group[name]) for name in ("actions", "rewards", "success", "terminated", "truncated")}
            assert lengths == {steps}
            actions, observed = group["actions"][()], group["plan/observed"][()]
            assert np.array_equal(actions, np.concatenate([stage.actions.numpy() for stage in stages]))
            assert len(np.unique(observed)) == 50
            for stage, start in zip(stages, group["plan/stage_starts"][()], strict=True):
                times = slice(start, start + 8)
                assert np.array_equal(group["obs/particles"][times], stage.positions[:-1, observed].float().numpy())
                assert np.array_equal(group["env_states/tool_poses"][times], stage.tool_poses[:-1].numpy())
                assert group["plan/placed"][times].tolist() == [True] + [False] * 7
            assert np.array_equal(group["obs/particles"][-1], stages[-1].positions[-1, observed].float().numpy())
            assert np.array_equal(group["plan/final_positions"][()], stages[-1].state.position[0].numpy())
            # The rewards add up to what the record's own metric says.
            metric = record.run["metric_value"]
            assert np.clip(group["rewards"][()].sum(), 0.0, 1.0) == pytest.approx(metric, abs=1e-5)
            assert said["success"] == bool(group["success"][-1]) == (group["rewards"][()].sum() >= 0.01)
            assert (group["terminated"][-1], group["truncated"][-1]) == (said["success"], not said["success"])
            assert not group["terminated"][:-1].any()


def test_replay_on_the_same_simulator_is_equal(made):
    queue, built = made
    found = list(replay(queue.directory))
    assert [row.number for row in found] == [0, 1]
    assert all(row.equal for row in found)
    assert [row.loss for row in found] == pytest.approx([row.recorded_loss for row in found], rel=1e-6)
    (one,) = replay(built.directory, episodes=[1])
    assert one == found[1]
    with pytest.raises(InputError, match="--episodes: got 7"):
        list(replay(built.directory, episodes=[7]))
    shown = CliRunner().invoke(app, ["dataset", "replay", str(queue.directory), "--episodes", "0"])
    assert shown.exit_code == 0, shown.output
    assert "1 of 1 episodes end where the data set has them" in shown.stdout


def test_a_changed_action_shows(made, tmp_path):
    built = made[1]
    for path in built.directory.glob("trajectories-00000.*"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    with h5py.File(tmp_path / "trajectories-00000.h5", "a") as file:
        file["traj_0/actions"][2] = -file["traj_0/actions"][2] + 0.5
    (row,) = replay(tmp_path)
    assert not row.equal


def test_minari(made):
    minari = pytest.importorskip("minari", reason='NOT TESTED: Minari data sets need pip install "cpdeform[datasets]"')
    built = made[1]
    found = minari.MinariDataset(built.directory / "minari" / "data")
    assert found.total_episodes == 2
    for number, episode in enumerate(found.iterate_episodes()):
        with h5py.File(built.directory / f"trajectories-{number:05d}.h5") as file:
            group = file["traj_0"]
            assert np.array_equal(episode.observations["particles"], group["obs/particles"][()])
            assert np.array_equal(episode.observations["tool_poses"], group["obs/tool_poses"][()])
            assert np.array_equal(episode.actions, group["actions"][()].astype(np.float32))
            assert np.array_equal(episode.rewards, group["rewards"][()])
            assert np.array_equal(episode.infos["goal"], group["plan/goal"][()])
            assert episode.terminations[-1] or episode.truncations[-1]
            assert found.observation_space["particles"].contains(episode.observations["particles"][0])
            assert found.action_space.contains(episode.actions[0])


def test_card_and_checksums(made):
    built = made[1]
    card = (built.directory / "README.md").read_text()
    assert card.startswith("---\nlicense: cc-by-4.0\n")
    assert "| episodes | 2 |" in card
    assert str(built.directory.parent) not in card
    assert not re.search(r"\{\w*\}", card)
    checked = subprocess.run(["sha256sum", "--check", "SHA256SUMS"], cwd=built.directory, capture_output=True, text=True)
    assert checked.returncode == 0, checked.stderr
    files = {path.relative_to(built.directory).as_posix() for path in built.directory.rglob("*") if path.is_file()}
    listed = {line.split("  ", 1)[1] for line in (built.directory / "SHA256SUMS").read_text().splitlines()}
    assert listed == files - {"SHA256SUMS"}


def test_more_goals_go_on(made):
    """The plans that are there count; a plan that failed is left out, and the card says so."""
    queue = made[0]
    more = dataclasses.replace(SETTINGS, goals=(3, 4, 5))
    again = new_dataset(queue.directory, more, registry=load_registry())
    assert again.names() == ["goal-000003", "goal-000004", "goal-000005"]

    def fail(context):
        raise ValueError("no clay")

    assert [outcome.name for outcome in Worker(again, function=fail).work()] == ["goal-000005"]
    built = build_dataset(again, more, name="clay")
    assert len(built.episodes) == 2
    assert built.without_plan == {"goal-000005": "ValueError: no clay"}
    assert "- goal-000005: ValueError: no clay" in (built.directory / "README.md").read_text()


def test_unusable_options(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for arguments, message in (
        (["--scene", "moove", "--goals", "0:2"], 'Did you mean "move"'),
        (["--scene", "move", "--goals", "2:0"], "--goals"),
        (["--scene", "move", "--goals", "0:2", "--set", "goal=a.npz"], "Use --goals instead"),
        (["--scene", "move", "--goals", "0:2", "--success-iou", "1.5"], "--success-iou: got 1.5"),
        (["--scene", "move", "--goals", "0:2", "--particles", "0"], "--particles: got 0"),
    ):
        refused = CliRunner().invoke(app, ["dataset", "new", "clay", *arguments])
        assert (refused.exit_code, message in refused.stderr) == (2, True), refused.stderr
    assert not Path("clay").exists()
    assert CliRunner().invoke(app, ["dataset", "replay", "clay"]).exit_code == 2
