"""The run record: a directory that holds all of a run, readable at any moment, also of a run that was killed.

``run.json``
    Configuration, task, status, versions, machine; losses and metric once the run is over. A number that is not finite is
    null. ``status`` is ``"running"`` until the run is over: a killed run keeps it. ``"interrupted"``: by the user; the last
    stage then has that status, too, if it had a plan, and its state is that after the best plan so far. ``memory``: estimate
    and measured peak of the rollouts and gradients of the largest batch, bytes. ``resumed_from``: the record that the run
    went on from, or null; its stages go on counting, so that the first file is that of the stage after the other record's
    last one, or of an earlier one that was revised.
``metrics.jsonl``
    A JSON object a line: ``"kind": "iteration"`` for each gradient evaluation, ``"kind": "stage"`` for each stage,
    ``"kind": "revision"`` where several stages up to that one got other plans, which their files then hold; ``complete`` is
    false where that was interrupted. ``time`` is when an iteration was done (Unix seconds), ``gradient_norm`` that of its
    gradient by the actions.
``.run.lock``
    Number of the process that writes, while it does.
``goal.h5``, ``stage-000.h5``, ...
    The goal, and each finished stage; the attributes of every dataset say what it holds.
``unrevised-000.h5``, ...
    Stages as they were before the last revision, until the next stage is finished: where the revision broke off, a run that goes
    on in this directory begins there.
"""

from __future__ import annotations

import contextlib
import datetime
import errno
import json
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import torch
from torch import Tensor

from cpdeform.core.errors import RecordError
from cpdeform.core.memory import MemoryUse
from cpdeform.core.task import Task
from cpdeform.planning.optimizer import Iteration
from cpdeform.planning.result import DeformResult, Observer, Revision, StageResult, Status
from cpdeform.run.configuration import RunConfiguration
from cpdeform.run.record_files import (
    GOAL_FILE,
    METRICS_FILE,
    RUN_FILE,
    check_directory,
    environment,
    own_files,
    replacing,
    replacing_hdf5,
    stage_file,
    to_json,
    unrevised_file,
    unrevised_files,
    write_dataset,
    write_json,
)
from cpdeform.run.record_lock import RecordLock
from cpdeform.run.record_reader import RunRecord, load_record
from cpdeform.run.record_shapes import keep_shapes
from cpdeform.run.record_stage import write_stage

__all__ = ["RunRecord", "RunRecorder", "load_record", "save_result"]

FORMAT = 3
"""Version of the record's layout."""

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
FULL_REMEDY = "Free some space, or choose another directory (--out); the finished stages are kept, and --resume goes on from them."


class RunRecorder(Observer):
    """Writes the record of a run while it goes on.

    Nothing is written before the run starts. As a context manager it also records how the run broke off, if it does:
    ``"interrupted"`` (by the user) or ``"failed"``. While the run goes on no other process can write to the directory.

    Args:
        directory: Where to write; made if missing.
        configuration: What defines the run, kept in the record.
        overwrite: Allow a directory that is not empty; files of an earlier record are then removed, others are left alone.
        resumed_from: The record that the run goes on from, to be named in this one.
        origins: Where each value of the configuration comes from, see `cpdeform.run.origins`.

    Raises:
        InputError: The directory is not empty (without `overwrite`) or cannot be written, or another run is writing to it.
    """

    def __init__(
        self,
        directory: Path | str,
        *,
        configuration: RunConfiguration | None = None,
        overwrite: bool = False,
        resumed_from: RunRecord | None = None,
        origins: Mapping[str, str] | None = None,
    ) -> None:
        self.directory = Path(directory)
        self._configuration = configuration
        self._resumed_from = resumed_from
        self._origins = origins
        self._overwrite = overwrite
        self._run: dict[str, Any] = {}
        self._batch: dict[int, int] = {}
        self._rescued = False
        check_directory(self.directory, overwrite=overwrite)
        self._lock = RecordLock(self.directory)
        self._lock.check()

    @property
    def rescued(self) -> bool:
        """Whether the last stage was interrupted and its best plan so far is recorded."""
        return self._rescued

    @property
    def stages(self) -> int:
        """Number of stages that are recorded and executed a plan."""
        return int(self._run.get("stages_finished", 0))

    @property
    def started(self) -> bool:
        """Whether there is a record."""
        return bool(self._run)

    def run_started(self, task: Task, goal: Tensor, names: dict[str, str], seed: int) -> None:
        """Begin the record: everything that is known before the first stage."""
        check_directory(self.directory, overwrite=self._overwrite)
        with self._writing():
            self.directory.mkdir(parents=True, exist_ok=True)
            self._lock.acquire()
            # Another run may have come to its end here since the check above.
            check_directory(self.directory, overwrite=self._overwrite)
            for path in own_files(self.directory):
                path.unlink()
            content = task.model_dump(mode="json")
            self._run = {
                "format": FORMAT,
                "status": "running",
                "advice": "",
                "names": dict(names),
                "seed": seed,
                "stages_finished": 0,
                "resumed_from": _origin(self._resumed_from),
                "memory": None,
                "recorded_at": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
                **environment(),
                "configuration": self._configuration.model_dump(mode="json") if self._configuration else None,
                "origins": None if self._origins is None else dict(self._origins),
                # The goal is the copy beside this file.
                "task": {**content, "scene": keep_shapes(content["scene"], self.directory), "goal": GOAL_FILE},
            }
            with replacing_hdf5(self.directory / GOAL_FILE) as file:
                write_dataset(file, "position", goal, shape="particle, xyz", units="length (domain edge = 1)")
                _write_goal_extras(file, task)
            (self.directory / METRICS_FILE).write_text("", encoding="utf-8")
            self._write_run()

    def optimization_started(self, stage: int, worlds: int, memory_estimate: int) -> None:
        """Note the memory that the rollouts are going to need, for a run that is killed for want of it."""
        self._note_memory(MemoryUse(worlds, memory_estimate, None))
        with self._writing():
            self._write_run()

    def _note_memory(self, use: MemoryUse) -> None:
        noted = self._run["memory"]
        if noted is None or (use.estimate, use.peak or 0) >= (noted["estimate_bytes"], noted["peak_bytes"] or 0):
            self._run["memory"] = {"worlds": use.worlds, "estimate_bytes": use.estimate, "peak_bytes": use.peak}

    def iteration_finished(self, stage: int, iteration: Iteration) -> None:
        """Append an iteration to the metrics."""
        if iteration.memory is not None:
            self._note_memory(iteration.memory)
        # The optimiser counts anew for each batch of candidates; the number of the batch keeps lines apart.
        self._batch[stage] = self._batch.get(stage, -1) + (1 if iteration.index == 0 else 0)
        self._append(
            {
                "kind": "iteration",
                "stage": stage,
                "batch": self._batch[stage],
                "phase": iteration.phase,
                "iteration": iteration.index,
                "loss": iteration.loss,
                "best_loss": iteration.best_loss,
                "gradient_norm": iteration.gradient_norm,
                "seconds": iteration.seconds,
                "time": round(iteration.time, 3),
            }
        )

    def stage_finished(self, result: StageResult) -> None:
        """Append a stage to the metrics and write its file; the file comes last and marks the stage as finished."""
        self._append(
            {
                "kind": "stage",
                "stage": result.index,
                "status": result.status.value,
                "loss_before": result.loss_before,
                "loss": result.loss,
                "best": result.best,
                "candidates": [candidate.proposal.label for candidate in result.candidates],
                "candidate_loss": [candidate.loss for candidate in result.candidates],
                "gradient_evaluations": result.gradient_evaluations,
                "rollouts": result.rollouts,
                "seconds": result.seconds,
            }
        )
        self._rescued = result.status is Status.INTERRUPTED
        with self._writing():
            write_stage(self.directory / stage_file(result.index), result)
            self._forget_unrevised()
            self._run["stages_finished"] += result.status.executed
            self._write_run()

    def stages_revised(self, revision: Revision) -> None:
        """Write the stages' files anew, the last one first: it is where a run that goes on begins.

        Those of before are kept beside them until the next stage is finished, for a run that breaks off and is to go on as if it
        had not.
        """
        with self._writing():
            for result in revision.results:
                self._keep_unrevised(result.index)
        for result in reversed(revision.results):
            with self._writing():
                write_stage(self.directory / stage_file(result.index), result)
        last = revision.results[-1]
        line = {"kind": "revision", "stage": last.index, "stages": len(revision.results), "loss": last.loss}
        self._append({**line, "complete": revision.complete})
        with self._writing():
            # A run that goes on with another record may have revised stages of that one.
            self._run["stages_finished"] = max(
                self._run["stages_finished"], sum(result.status.executed for result in revision.results)
            )
            self._write_run()

    def _forget_unrevised(self) -> None:
        for path in unrevised_files(self.directory).values():
            path.unlink()

    def _keep_unrevised(self, index: int) -> None:
        path = self.directory / stage_file(index)
        if path.exists():
            with replacing(self.directory / unrevised_file(index)) as temporary:
                shutil.copyfile(path, temporary)

    def run_finished(self, result: DeformResult) -> None:
        """Complete the record."""
        with self._writing():
            self._forget_unrevised()
        self._finish(
            status=result.status.value,
            advice=result.status.advice,
            loss_initial=result.loss_initial,
            loss_final=result.loss_final,
            metric=result.metric_name,
            metric_initial=result.metric_initial,
            metric_value=result.metric_value,
            gradient_evaluations=result.gradient_evaluations,
            rollouts=result.rollouts,
            seconds=result.seconds,
        )
        self._lock.release()

    def __enter__(self) -> RunRecorder:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Record that the run broke off, unless it is over or never began."""
        try:
            if error is not None and self._run.get("status") == "running":
                self._break_off(error)
        finally:
            self._lock.release()

    def _break_off(self, error: BaseException) -> None:
        if isinstance(error, KeyboardInterrupt):
            advice = "Interrupted; the finished stages are complete."
            self._finish(status=Status.INTERRUPTED.value, advice=Status.INTERRUPTED.advice if self._rescued else advice)
        else:
            # What broke the run is raised anyway; that the record cannot say so must not hide it.
            with contextlib.suppress(RecordError):
                self._finish(status="failed", advice=f"{type(error).__name__}: {error}")

    def _finish(self, **fields: Any) -> None:
        self._run.update(fields)
        with self._writing():
            self._write_run()

    def _write_run(self) -> None:
        write_json(self.directory / RUN_FILE, self._run)

    def _append(self, line: dict[str, Any]) -> None:
        """Append a line to the metrics; the file is closed at once, so that the line outlives this process."""
        with self._writing(), (self.directory / METRICS_FILE).open("a", encoding="utf-8") as file:
            file.write(json.dumps(to_json(line), allow_nan=False) + "\n")

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._lock.release()
            text = f"cannot write the run record in {self.directory}: {error.strerror or error}."
            raise RecordError(f"{text} {FULL_REMEDY}" if error.errno in FULL else text) from error


def _write_goal_extras(file: h5py.File, task: Task) -> None:
    """Keep what else the goal's file says, so that a run which goes on is judged by the same goal."""
    corresponds = torch.tensor(task.goal_corresponds())
    write_dataset(file, "corresponds", corresponds, shape="", units="whether the particles are the body's, one to one, moved")
    grid = task.load_goal_grid()
    if grid is not None:
        cells = torch.nonzero(torch.as_tensor(grid))
        write_dataset(file, "grid_cells", cells, shape="node, axis", units="index of a grid node")
        write_dataset(file, "grid_mass", torch.as_tensor(grid)[tuple(cells.T)], shape="node", units="mass")


def _origin(record: RunRecord | None) -> dict[str, Any] | None:
    """What a record says about the one that its run goes on from."""
    if record is None:
        return None
    names = record.run.get("names", {})
    return {"directory": str(record.directory), "status": record.status, "stages": record.next_stage, "names": names}


def save_result(
    result: DeformResult,
    directory: Path,
    *,
    configuration: RunConfiguration | None = None,
    overwrite: bool = False,
    resumed_from: RunRecord | None = None,
    origins: Mapping[str, str] | None = None,
) -> Path:
    """Write the record of a run that is over, the same as `RunRecorder` writes during one.

    Args:
        result: The run.
        directory: Where to write; made if missing.
        configuration: What defined the run, kept in the record.
        overwrite: As for `RunRecorder`.
        resumed_from: The record that the run went on from.
        origins: As for `RunRecorder`.

    Returns:
        The directory.

    Raises:
        InputError: The directory is not empty (without `overwrite`) or cannot be written.
        RecordError: Writing failed on the way, e.g. because the disk is full.
    """
    recorder = RunRecorder(directory, configuration=configuration, overwrite=overwrite, resumed_from=resumed_from, origins=origins)
    recorder.run_started(result.task, result.goal, result.names, result.seed)
    for stage in result.stages:
        for iteration in stage.history:
            recorder.iteration_finished(stage.index, iteration)
        recorder.stage_finished(stage)
    recorder.run_finished(result)
    return recorder.directory
