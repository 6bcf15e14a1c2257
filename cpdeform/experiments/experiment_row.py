"""A row of an experiment's table: what the record of a run says, and how its result is judged."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import re
from collections.abc import Mapping
from typing import Any

from cpdeform import __version__
from cpdeform.core.errors import CpdeformError, InputError
from cpdeform.core.reading.json_text import read_json
from cpdeform.experiments.experiment_plan import PlannedRun
from cpdeform.experiments.shape_figures import SHAPE_FIGURES, shape_figures
from cpdeform.planning.result import Status
from cpdeform.run.record_files import replacing, to_json, write_json
from cpdeform.run.record_reader import RunRecord, load_record
from cpdeform.run.resume import recorded_configuration

EVALUATION_FILE, FAILURE_FILE = "evaluation.json", "failure.json"
"""Files beside a record: its figures, so that they need not be computed again, and why there is no record."""

OVER = frozenset(status.value for status in Status if status is not Status.INTERRUPTED)
"""Statuses of runs that came to an end of their own, with a plan or without."""

FIGURES = (
    "goal_particles",
    "w1_initial",
    "w1_final",
    "w1_floor",
    "w1_converged",
    "incremental_iou",
    "w1_paper_initial",
    "w1_paper_final",
    "w1_paper_floor",
    "w1_paper_blur",
    *SHAPE_FIGURES,
)
"""Fields of a row that `judge` gives."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExperimentRow:
    """One run. None stands for what is not known.

    Attributes:
        task: The task's name with its variant.
        method: A name of `cpdeform.experiments.experiment_plan.METHODS`.
        seed: The seed.
        status: That of the record, or ``"failed"`` without a record, or ``"not_run"``.
        reason: Why there is no better result; empty for a run that finished.
        stages: Stages whose plan was executed.
        stages_tried: Stages begun, with the one that found no plan.
        stages_planned: Stages asked for.
        particles: Number of particles.
        goal_particles: Number of particles of the goal.
        metric: Name of the task's metric.
        w1_initial: Converged W1 between start and goal, length units.
        w1_final: The same between the last state and the goal.
        w1_floor: W1 between the goal and a random sample of its shape with as many particles, what a perfect result would have; 0
            where the goal's particles are those of the body.
        w1_converged: Whether both W1 were iterated to convergence.
        ratio_above_floor: (final - floor) / (initial - floor).
        incremental_iou: Normalised incremental IoU, in [0, 1].
        w1_paper_initial: W1 between start and goal with the paper's settings.
        w1_paper_final: The same between the last state and the goal.
        w1_paper_floor: As `w1_floor`, with the paper's settings.
        w1_paper_blur: Entropic blur of both, length units.
        shape_iou_start: This and the fields up to `distance_95_goal_to_result` are those of
            `cpdeform.planning.shape_metrics.ShapeFigures`, from rest to rest.
        shape_iou_final: See there.
        shape_iou_ceiling: See there.
        normalised_shape_iou: See there.
        silhouette_iou_x: Silhouette IoU along x.
        silhouette_iou_y: That along y, from above.
        silhouette_iou_z: That along z.
        loose_share: See there.
        distance_95_result_to_goal: See there, in cells.
        distance_95_goal_to_result: See there, in cells.
        gradient_evaluations: Gradient evaluations of all stages and worlds.
        rollouts: Rollouts without a gradient of all stages and worlds.
        iterations: The most gradient evaluations per stage and world.
        seconds: Wall time of the run.
        reused: Whether the run was found, not made.
        configuration: That of the record; empty where there is none.
    """

    task: str
    method: str
    seed: int
    status: str
    reason: str = ""
    stages: int | None = None
    stages_tried: int | None = None
    stages_planned: int | None = None
    particles: int | None = None
    goal_particles: int | None = None
    metric: str | None = None
    w1_initial: float | None = None
    w1_final: float | None = None
    w1_floor: float | None = None
    w1_converged: bool | None = None
    ratio_above_floor: float | None = None
    incremental_iou: float | None = None
    w1_paper_initial: float | None = None
    w1_paper_final: float | None = None
    w1_paper_floor: float | None = None
    w1_paper_blur: float | None = None
    shape_iou_start: float | None = None
    shape_iou_final: float | None = None
    shape_iou_ceiling: float | None = None
    normalised_shape_iou: float | None = None
    silhouette_iou_x: float | None = None
    silhouette_iou_y: float | None = None
    silhouette_iou_z: float | None = None
    loose_share: float | None = None
    distance_95_result_to_goal: float | None = None
    distance_95_goal_to_result: float | None = None
    gradient_evaluations: int | None = None
    rollouts: int | None = None
    iterations: int | None = None
    seconds: float | None = None
    reused: bool = False
    configuration: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def over(self) -> bool:
        """Whether the run came to an end of its own."""
        return self.status in OVER

    @property
    def has_figures(self) -> bool:
        """Whether there is a state to judge, be it that of the start."""
        return self.w1_final is not None or self.incremental_iou is not None


def read_row(run: PlannedRun, *, paper_metric: bool, reused: bool, shape: bool = False) -> ExperimentRow:
    """The row of a run, from its record or from the note of its failure.

    Args:
        run: The run.
        paper_metric: Also take W1 with the paper's settings.
        reused: Whether the run was found, not made.
        shape: Also take the shape figures.
    """
    base: dict[str, Any] = {"task": run.task, "method": run.method, "seed": run.seed, "reused": reused}
    try:
        missing = not (run.directory / FAILURE_FILE).exists()
        failure = None if missing else read_json(run.directory / FAILURE_FILE, argument=str(run.directory / FAILURE_FILE))
    except InputError as error:
        failure = {"reason": str(error)}
    if failure is not None:
        reason = failure.get("reason") if isinstance(failure, dict) else None
        return ExperimentRow(**base, status="failed", reason=str(reason or "unknown"))
    if not run.directory.exists():
        return ExperimentRow(**base, status="not_run")
    try:
        record = load_record(run.directory)
        return _recorded_row(record, base, paper_metric=paper_metric, shape=shape)
    except CpdeformError as error:
        return ExperimentRow(**base, status="failed", reason=one_line(error))


def note_failure(run: PlannedRun, error: Exception) -> ExperimentRow:
    """The row of a run that could not be made; why is kept in the run's directory, for tables made later."""
    reason = one_line(error)
    # The row is told anyway, also where nothing can be written.
    with contextlib.suppress(OSError):
        run.directory.mkdir(parents=True, exist_ok=True)
        write_json(run.directory / FAILURE_FILE, {"reason": reason})
    return ExperimentRow(task=run.task, method=run.method, seed=run.seed, status="failed", reason=reason)


def forget_failure(run: PlannedRun) -> None:
    """Remove the note of a failure."""
    (run.directory / FAILURE_FILE).unlink(missing_ok=True)


def forget(run: PlannedRun) -> None:
    """Remove all that was noted about an earlier run in the same place."""
    forget_failure(run)
    (run.directory / EVALUATION_FILE).unlink(missing_ok=True)


def one_line(error: Exception) -> str:
    """An error as a line of text, directories left out."""
    text = str(error) if isinstance(error, CpdeformError) else f"{type(error).__name__}: {error}"
    return without_directories(" ".join(text.split()))


def without_directories(text: str) -> str:
    """Text in which absolute paths are cut down to their last part: tables say nothing about the machine's directories."""
    return re.sub(r"(?<![\w./~-])/(?:[^\s/\"':,]+/)+(?=[^\s/\"':,])", "", text)


def _recorded_row(record: RunRecord, base: Mapping[str, Any], *, paper_metric: bool, shape: bool) -> ExperimentRow:
    configuration = recorded_configuration(record)
    values: dict[str, Any] = {
        "status": "interrupted" if record.status == "running" else record.status,
        "reason": "" if record.status == Status.FINISHED.value else without_directories(record.run.get("advice", "")),
        "stages": record.finished_stages,
        "stages_tried": len(record.stages),
        "stages_planned": configuration.stages or record.task.stage_count,
        "particles": record.task.scene.particle_count,
        "metric": record.task.metric,
        "gradient_evaluations": sum(stage.gradient_evaluations for stage in record.stages),
        "rollouts": sum(stage.rollouts for stage in record.stages),
        "iterations": configuration.optimizer.iterations,
        "seconds": record.run.get("seconds", sum(stage.seconds["total"] for stage in record.stages)),
        "configuration": configuration.model_dump(mode="json"),
    }
    if record.stages:
        try:
            figures = _figures(record, paper_metric=paper_metric, shape=shape)
            values |= figures | {"ratio_above_floor": ratio_above_floor(figures)}
            if figures["w1_converged"] is False:
                values["reason"] = " ".join(filter(None, (values["reason"], "W1 did not converge.")))
        except Exception as error:
            # The run is recorded and stays a row; what cannot be judged is told.
            values["reason"] = " ".join(filter(None, (values["reason"], f"No figures: {one_line(error)}")))
    return ExperimentRow(**base, **values)


def ratio_above_floor(figures: Mapping[str, float | None]) -> float | None:
    """(final - floor) / (initial - floor) of W1; None where something is not known or the start is as good as the floor."""
    initial, final, floor = (figures.get(f"w1_{name}") for name in ("initial", "final", "floor"))
    if initial is None or final is None or floor is None or initial <= floor:
        return None
    return (final - floor) / (initial - floor)


def _figures(record: RunRecord, *, paper_metric: bool, shape: bool) -> dict[str, Any]:
    """Figures of a record: those beside it where they belong to it, else computed and kept there."""
    path = record.directory / EVALUATION_FILE
    key = {"recorded_at": record.run.get("recorded_at"), "stages": len(record.stages), "version": __version__}
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        kept = read_json(path, argument=str(path))
        if kept["key"] == key:
            if kept["paper_metric"] >= paper_metric and kept["shape"] >= shape:
                return {name: kept["figures"][name] for name in FIGURES}
            # What is there already is not lost where more is asked for.
            paper_metric, shape = paper_metric or kept["paper_metric"], shape or kept["shape"]
    figures = judge(record, paper_metric=paper_metric, shape=shape)
    content = {"key": key, "paper_metric": paper_metric, "shape": shape, "figures": figures}
    with contextlib.suppress(OSError), replacing(path) as temporary:
        temporary.write_text(json.dumps(content), encoding="utf-8")
    return figures


def judge(record: RunRecord, *, paper_metric: bool, shape: bool = False) -> dict[str, Any]:
    """Judge the last state of a record against its start and its goal, the same way for every method.

    Args:
        record: A record with at least one stage.
        paper_metric: Also take W1 with the paper's settings.
        shape: Also take the shape figures, from rest to rest.

    Returns:
        The figures `FIGURES`, W1 in length units; None for one that was not asked for or is not finite.
    """
    from cpdeform.run.evaluation import evaluate_record

    if record.stages[0].index != 0:
        raise InputError(f"run record {record.directory}", came="a run that went on from another", expected="one from the start")
    found = evaluate_record(record, paper=paper_metric)
    figures = {
        "goal_particles": found.goal_count,
        "w1_initial": found.wasserstein_start,
        "w1_final": found.wasserstein_final,
        "w1_floor": found.sampling_floor,
        "w1_converged": found.converged,
        "incremental_iou": found.incremental_iou,
        "w1_paper_initial": found.paper_start,
        "w1_paper_final": found.paper_final,
        "w1_paper_floor": found.paper_floor,
        "w1_paper_blur": found.paper_blur,
        **(shape_figures(record) if shape else dict.fromkeys(SHAPE_FIGURES)),
    }
    return {name: to_json(figures[name]) for name in FIGURES}
