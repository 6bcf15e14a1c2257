"""The further experiments: their figures, equal cost, and that an interruption changes nothing."""

from __future__ import annotations

import csv
import itertools
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from toy_fixtures import write_toy_distribution, write_toy_task
from typer.testing import CliRunner

from cpdeform.cli.main import app
from cpdeform.core.plugins import load_registry
from cpdeform.core.task import load_task
from cpdeform.experiments import experiment_row
from cpdeform.experiments.experiment_plan import ExperimentSettings, configure, planned_runs
from cpdeform.experiments.shape_figures import SHAPE_FIGURES
from cpdeform.experiments.studies import equal_cost, rivals
from cpdeform.experiments.studies.equal_cost import JUDGED, budget_values, known_shares, rollout_share
from cpdeform.experiments.studies.statistics import Interval, mean, rank_correlation
from cpdeform.experiments.studies.study import PRESETS, STUDIES
from cpdeform.experiments.studies.trace import learning_curve, stage_points, value_at
from cpdeform.planning.strategies.sculpt import StrategySculpt
from cpdeform.run.configuration import RunConfiguration
from cpdeform.run.record import load_record

PARTS = ["--tasks", "shift.yaml", "--backend", "toy", "--ot", "toy"]
RUNS = [*PARTS, "--methods", "cpdeform,random,fixed", "--iterations", "3", "--seeds", "0,1", "--stages", "1"]
TIMES = (
    "seconds",
    "seconds_low",
    "seconds_high",
    "loss_ratio_in_seconds",
    "loss_ratio_in_seconds_low",
    "loss_ratio_in_seconds_high",
)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current directory, with a task file in it and the toy parts installed."""
    write_toy_task(tmp_path)
    monkeypatch.syspath_prepend(str(write_toy_distribution(tmp_path)))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def experiment(name, *arguments):
    return CliRunner().invoke(app, ["experiment", name, *(str(argument) for argument in arguments)])


def values(out, *, apart=()):
    with (Path(out) / "summary.csv").open() as file:
        return [{key: value for key, value in line.items() if key not in apart} for line in csv.DictReader(file)]


def test_means_with_intervals():
    found = mean([1.0, 2.0, 3.0, 4.0, math.nan])
    assert (found.value, found.count) == (2.5, 4)
    assert 1.0 < found.low < 2.0 < 3.0 < found.high < 4.0
    assert found == mean([1.0, 2.0, 3.0, 4.0])
    assert not mean([5.0]).known
    assert math.isnan(mean([]).value)
    assert mean([2.0, 2.0]).text(".1f") == "2.0 [2.0, 2.0]"
    assert Interval(0.1, -0.1, 0.3, 3).excludes_zero() is False
    assert Interval(0.2, 0.1, 0.3, 3).excludes_zero() is True


def test_an_interval_covers_the_mean_as_often_as_it_says():
    generator = np.random.default_rng(0)
    found = [mean(generator.normal(1.0, 2.0, 40).tolist()) for _ in range(60)]
    covered = sum(item.low <= 1.0 <= item.high for item in found)
    assert 51 <= covered <= 60


def test_rank_correlations():
    numbers = list(range(30))
    assert rank_correlation(numbers, [number**3 for number in numbers]).value == pytest.approx(1.0)
    assert rank_correlation(numbers, [-number for number in numbers]).high == pytest.approx(-1.0)
    # Where nothing varies there is no correlation.
    assert rank_correlation(numbers, [1.0] * 30).text(".2f") == "-"
    generator = np.random.default_rng(0)
    unrelated = rank_correlation(generator.normal(size=60).tolist(), generator.normal(size=60).tolist())
    assert unrelated.low < 0.0 < unrelated.high


def test_presets_stay_below_what_a_task_asks_for():
    assert PRESETS["quick"]["stages"] == 1
    assert set(PRESETS["paper"]) == {"seeds"}
    assert all(study.methods[0] == "cpdeform" for study in STUDIES.values())


@pytest.mark.parametrize("method", ["fixed", "random", "restarts", "bayesopt", "cma", "mppi", "sculpt", "sampled-gradients", "sac"])
@pytest.mark.parametrize(("cost", "share"), [(24.0, 0.2), (90.0, 0.25), (7.5, 0.5), (900.0, 0.2)])
def test_every_method_is_sized_for_the_budget(method, cost, share):
    found = budget_values(method, cost, share=share, iterations=8)
    options, optimizer = found.get("strategy_options", {}), found.get("optimizer", {})
    gradients, rollouts = 0, 0
    if method in ("fixed", "random"):
        gradients = optimizer["iterations"]
    elif method in ("restarts", "bayesopt"):
        gradients = optimizer["iterations"] * options["restarts" if method == "restarts" else "evaluations"]
    elif method == "cma":
        rollouts = options["population"] * options["generations"]
    elif method == "mppi":
        rollouts = options["samples"] * (options["updates"] + 1)
    elif method == "sac":
        rollouts = options["episodes"] + JUDGED
    elif method == "sculpt":
        assert StrategySculpt(**options).together == 1
        rollouts = options["touches"] + 2 * options["variations"]
        gradients = sum(math.prod(step) for step in zip(options["polished"], options["iterations"], strict=True))
        gradients += options["joint_gradients"]
    else:
        gradients, rollouts = optimizer["iterations"] * options["keep"], options["samples"]
    assert gradients + share * rollouts == pytest.approx(cost, rel=0.35)


@pytest.mark.parametrize("stages", [2, 3, 8, 12, 14, 24])
def test_descents_over_several_touches_are_within_the_budget(stages):
    cost, share = 60.0, 0.2
    options = budget_values("sculpt", cost, share=share, iterations=20, stages=stages)["strategy_options"]
    strategy = StrategySculpt(**options)
    joint = strategy.joint_descents(stages)
    assert joint[-1].after == stages
    gradients = sum(part.stages * part.iterations[1] for part in joint)
    assert gradients == pytest.approx(equal_cost.JOINT_SHARE_OF_SEVERAL * cost * stages, rel=0.15)
    gradients += stages * sum(math.prod(step) for step in zip(strategy.polished, strategy.iterations, strict=True))
    assert gradients + stages * share * (strategy.touches + 2 * strategy.variations) == pytest.approx(cost * stages, rel=0.1)


def test_the_search_study(folder):
    finished = experiment("search", *RUNS, "--out", "out")
    assert finished.exit_code == 0, finished.output
    lines = values("out")
    assert [(line["task"], line["method"], line["seeds"]) for line in lines] == [
        ("shift", "cpdeform", "2"), ("shift", "fixed", "2"), ("shift", "random", "2"),
    ]  # fmt: skip
    with Path("out/table.csv").open() as file:
        own = [float(row["w1_final"]) for row in csv.DictReader(file) if row["method"] == "random"]
    assert float(lines[2]["w1_final"]) == pytest.approx(np.mean(own))
    text = Path("out/summary.md").read_text()
    assert "| shift | " in text
    assert "95% bootstrap intervals" in text
    assert text in finished.output
    for form, magic in (("png", b"\x89PNG"), ("pdf", b"%PDF")):
        assert Path(f"out/figure.{form}").read_bytes().startswith(magic)


def test_curves_of_a_record(folder):
    assert experiment("ablation", *PARTS, "--methods", "cpdeform,random", "--iterations", "4", "--out", "out").exit_code == 0
    record = load_record("out/shift/cpdeform-seed0")
    curve, points = learning_curve(record), stage_points(record)
    evaluations = [count for count, _ in curve]
    assert evaluations == sorted(evaluations)
    assert evaluations[-1] == points[-1].gradient_evaluations == record.run["gradient_evaluations"]
    assert curve[0] == (0, 1.0)
    # The best so far never rises, and ends where the run ends.
    assert all(later <= earlier for (_, earlier), (_, later) in itertools.pairwise(curve))
    assert curve[-1][1] == pytest.approx(record.run["loss_final"] / record.run["loss_initial"])
    assert value_at(curve, 0) == 1.0
    assert [point.stage for point in points] == [-1, 0, 1]
    assert points[2].cost(0.5) == points[2].gradient_evaluations + 0.5 * points[2].rollouts
    assert {line["method"] for line in values("out")} == {"cpdeform", "random"}


def test_runtimes_are_those_of_the_stages(folder):
    assert experiment("runtime", *PARTS, "--methods", "fixed", "--iterations", "2", "--out", "out").exit_code == 0
    record = load_record("out/shift/fixed-seed0")
    found = [float(line["seconds"]) for line in values("out")]
    assert found == pytest.approx(np.cumsum([0.0, *(stage.seconds["total"] for stage in record.stages)]))


def test_rivals_spend_what_the_reference_spent(folder, monkeypatch):
    monkeypatch.setattr(rivals, "OWN", ("cpdeform", "random"))
    finished = experiment("rivals", *RUNS, "--out", "out")
    assert finished.exit_code == 0, finished.output
    lines = {line["method"]: line for line in values("out")}
    assert float(lines["cpdeform"]["w1_minus_reference"]) == 0.0
    difference = float(lines["fixed"]["w1_final"]) - float(lines["cpdeform"]["w1_final"])
    assert float(lines["fixed"]["w1_minus_reference"]) == pytest.approx(difference)
    spent = {name: float(line["cost"]) for name, line in lines.items()}
    assert spent["fixed"] == pytest.approx(spent["cpdeform"], rel=0.5)
    text = Path("out/summary.md").read_text()
    for own in ("cpdeform", "random"):
        assert f"`{own}` is ahead of all rivals on" in text
        ahead = float(lines[own]["w1_final"]) < float(lines["fixed"]["w1_final"])
        behind = mean([float(lines["fixed"]["w1_final"]) - float(lines[own]["w1_final"])])
        _, verdict = text.split(f"its W1 minus that of {own}, same seeds |")
        assert verdict.splitlines()[2].startswith(f"| shift | {'yes' if ahead else 'no'} | fixed | {behind.value:.4f}")
    assert known_shares(Path("out"))["shift"] > 0.0
    assert "The shapes of the same runs" not in text


def test_rivals_show_the_shapes_where_they_are_asked_for(folder, monkeypatch):
    rest = {"shape_iou_start": 0.25, "shape_iou_final": 0.5, "shape_iou_ceiling": 0.75, "normalised_shape_iou": 0.625}
    monkeypatch.setattr(experiment_row, "shape_figures", lambda record: {**dict.fromkeys(SHAPE_FIGURES), **rest})
    finished = experiment("rivals", *RUNS, "--shape", "--out", "out")
    assert finished.exit_code == 0, finished.output
    assert [float(line["normalised_shape_iou"]) for line in values("out")] == [0.625] * 3
    _, shapes = Path("out/summary.md").read_text().split("## The shapes of the same runs")
    assert "| shift | 0.62 [0.62, 0.62] | 0.62 [0.62, 0.62] | 0.62 [0.62, 0.62] |" in shapes


def test_iterations_are_for_the_methods_that_take_them(folder):
    registry = load_registry()
    options = {"name": "rivals", "tasks": ("shift.yaml",), "out": Path("out"), "iterations": 7, "backend": "toy", "ot": "pot"}
    settings = ExperimentSettings(**options, methods=("cpdeform", "sculpt"))
    own, touches = planned_runs(settings, registry=registry)
    assert configure(own, settings, registry=registry).configuration.optimizer.iterations == 7
    # Warnings are errors here.
    assert configure(touches, settings, registry=registry).configuration.optimizer.iterations != 7
    # Who asks for them for this method alone is told.
    alone = ExperimentSettings(**options, methods=("sculpt",))
    resolved = configure(touches, alone, registry=registry)
    with pytest.warns(UserWarning, match="--iterations: no effect"):
        resolved.planner()


def test_of_workers_that_measure_at_once_the_first_one_counts(folder, monkeypatch):
    """A share that another worker wrote while this one measured is taken instead of the own one."""
    task, out = load_task("shift.yaml"), Path("together")
    shares = iter([0.25, 0.5])

    def measured(task, configuration, *, registry):
        own = next(shares)
        if own == 0.25:
            assert rollout_share(task, configuration, out, registry=registry) == 0.5
        return own

    monkeypatch.setattr(equal_cost, "measured_share", measured)
    assert rollout_share(task, RunConfiguration(), out, registry=load_registry()) == 0.5
    assert known_shares(out) == {"shift": 0.5}
    assert [path.name for path in (out / "rollout-shares").iterdir()] == ["shift.json"]


def test_an_interrupted_study_gives_the_table_of_an_uninterrupted_one(folder, monkeypatch):
    from cpdeform_toy.simulator import SimulatorToy

    runs = [*PARTS, "--methods", "cpdeform,fixed", "--iterations", "3", "--seeds", "0,1", "--stages", "1"]
    assert experiment("rivals", *runs, "--out", "whole").exit_code == 0
    shutil.copytree("whole/rollout-shares", "broken/rollout-shares")
    rollout, calls = SimulatorToy.rollout, []
    stops = {5, 13}

    def interrupt(self, state, actions):
        calls.append(1)
        if len(calls) in stops:
            raise KeyboardInterrupt
        return rollout(self, state, actions)

    codes = []
    with monkeypatch.context() as patch:
        patch.setattr(SimulatorToy, "rollout", interrupt)
        for _ in range(len(stops) + 1):
            codes.append(experiment("rivals", *runs, "--out", "broken").exit_code)
    assert codes == [130] * len(stops) + [0]
    assert values("broken", apart=TIMES) == values("whole", apart=TIMES)


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("search", ["--preset", "huge"], "--preset"),
        ("multi-stage", ["--preset", "quick"], "The further experiments have presets"),
        ("search", ["--size", "3"], "--size"),
        ("search", ["--variants", "v1"], "--variants"),
        ("rivals", ["--methods", "fixed,random"], "methods with cpdeform"),
        ("landscape", ["--methods", "fixed"], "--methods"),
        ("landscape", ["--size", "1"], "--size"),
        ("landscape", ["--stages", "2"], "--stages"),
        ("landscape", ["--tasks", "writer,star"], "one task"),
    ],
)
def test_unusable_options(folder, name, arguments, message):
    finished = experiment(name, *([] if "--tasks" in arguments else PARTS), *arguments)
    assert finished.exit_code == 2, finished.output
    assert message in finished.stderr


def test_a_landscape_goes_on_where_it_was(folder, monkeypatch):
    from cpdeform_toy.simulator import SimulatorToy

    arguments = [*PARTS, "--size", "3", "--iterations", "2"]
    finished = experiment("landscape", *arguments, "--out", "whole")
    assert finished.exit_code == 0, finished.output
    lines = values("whole")
    assert [(line["row"], line["column"]) for line in lines] == [(str(row), str(column)) for row in range(3) for column in range(3)]
    assert all(float(line["loss_ratio"]) < 1.0 for line in lines if line["loss_ratio"] != "nan")
    assert "rank correlation of priority and loss (Spearman)" in Path("whole/summary.md").read_text()
    rollout, calls = SimulatorToy.rollout, []

    def interrupt(self, state, actions):
        calls.append(1)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return rollout(self, state, actions)

    with monkeypatch.context() as patch:
        patch.setattr(SimulatorToy, "rollout", interrupt)
        assert experiment("landscape", *arguments, "--out", "broken").exit_code == 130
        assert 0 < len(values("broken")) < 9
        assert experiment("landscape", *arguments, "--out", "broken").exit_code == 0
    assert values("broken") == lines
    # Another setting makes other rows.
    assert experiment("landscape", *PARTS, "--size", "3", "--iterations", "1", "--out", "broken").exit_code == 0
    assert values("broken") != lines


def test_cards_say_what_the_table_says(folder):
    Path("table").mkdir()
    lines = [
        "writer-v2,cpdeform,3,0.0010,0.0009,0.0011,24",
        "writer-v2,random,3,0.0013,0.0012,0.0014,24",
        "star,cma,1,nan,nan,nan,",
    ]
    Path("table/summary.csv").write_text("task,method,seeds,w1_final,w1_final_low,w1_final_high,cost\n" + "\n".join(lines) + "\n")
    finished = CliRunner().invoke(app, ["bench", "cards", "table/summary.csv", "--out", "cards"])
    assert finished.exit_code == 0, finished.output
    card = Path("cards/writer-v2.md").read_text()
    assert "| cpdeform | 3 | 0.0010 [0.0009, 0.0011] | 24 |" in card
    assert card.index("| cpdeform |") < card.index("| random |")
    for part in ("10000 particles", "Capsule", "those of the body, moved", "1 stage of 10 environment steps", "(writer-v2.png)"):
        assert part in card
    assert "| cma | 1 | - |" in Path("cards/star.md").read_text()
    assert Path("cards/writer-v2.png").read_bytes().startswith(b"\x89PNG")
    assert "[star](star.md)" in Path("cards/README.md").read_text()
    Path("other.csv").write_text("a,b\n1,2\n")
    refused = CliRunner().invoke(app, ["bench", "cards", "other.csv"])
    assert refused.exit_code == 2
    assert "without task, method" in refused.stderr
