"""Going on in the directory of a run that broke off: its record becomes that of one run that went through."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from cpdeform.core.task import Task
from cpdeform.planning.result import DeformResult, Status
from cpdeform.run.record import RunRecorder
from cpdeform.run.record_files import (
    METRICS_FILE,
    replacing,
    stage_file,
    stage_files,
    to_json,
    unrevised_file,
    unrevised_files,
)
from cpdeform.run.record_reader import RunRecord, load_record, with_unrevised_stages
from cpdeform.run.record_stage import write_stage
from cpdeform.run.resume import recorded_configuration


def broken_off(directory: Path) -> RunRecord | None:
    """What is left of a run that was killed or interrupted, to be gone on from: finished stages, but not the run's last one.

    Args:
        directory: Its record.

    Returns:
        The record with those stages alone; None where there is none.

    Raises:
        InputError: The record is damaged.
    """
    record = load_record(directory)
    planned = recorded_configuration(record).stages or record.task.stage_count
    numbers = {stage.index for stage in record.stages}
    revised = max((line["stage"] for line in record.metrics if _is_revision(line) and line.get("stage") in numbers), default=-1)
    copies = unrevised_files(directory)
    if copies and (max(copies) > revised or len(numbers) == planned):
        # The revision broke off, or the run did before it could say that it was its end.
        record = with_unrevised_stages(record)
    # The end of a run comes with its last stage.
    stages = list(record.stages[: planned - 1])
    # The plan of an interrupted stage is not the one that it would have come to; and one without a plan may be a run's last one.
    while stages and stages[-1].status is not Status.FINISHED and stages[-1].index > revised:
        del stages[-1]
    if not stages:
        return None
    return dataclasses.replace(record, stages=tuple(stages), metrics=_lines_up_to(record.metrics, stages[-1].index))


def _is_revision(line: Mapping[str, Any]) -> bool:
    """Whether a line of the metrics tells of a revision that was complete."""
    return line.get("kind") == "revision" and bool(line.get("complete", True))


def _lines_up_to(metrics: Sequence[Mapping[str, Any]], last: int) -> tuple[dict[str, Any], ...]:
    """The lines of the stages up to a certain one, without those of a revision that broke off after it."""
    lines = [dict(line) for line in metrics if line.get("stage") in range(last + 1)]
    ends = [number for number, line in enumerate(lines) if line.get("kind") == "stage" or _is_revision(line)]
    return tuple(lines[: ends[-1] + 1]) if ends else ()


class RunContinuer(RunRecorder):
    """Writes the stages that a broken-off run had left to the record of that run.

    Args:
        record: The run that broke off; see `broken_off`.

    Raises:
        InputError: The record's directory cannot be written, or another run is writing to it.
    """

    def __init__(self, record: RunRecord) -> None:
        super().__init__(record.directory, overwrite=True)
        self._record = record

    def run_started(self, task: Task, goal: Tensor, names: dict[str, str], seed: int) -> None:
        """Go on with the record; what is left of the stage that broke off is removed."""
        kept = {stage.index for stage in self._record.stages}
        lines = [json.dumps(to_json(line)) for line in self._record.metrics]
        for line in self._record.metrics:
            if isinstance(number := line.get("batch"), int):
                self._batch[line["stage"]] = max(self._batch.get(line["stage"], -1), number)
        with self._writing():
            self._lock.acquire()
            for stage in self._record.stages:
                if (self.directory / unrevised_file(stage.index)).exists():
                    write_stage(self.directory / stage_file(stage.index), stage)
            self._forget_unrevised()
            for path in set(stage_files(self.directory)) - {self.directory / stage_file(index) for index in kept}:
                path.unlink()
            with replacing(self.directory / METRICS_FILE) as temporary:
                temporary.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
            self._run = {**self._record.run, "status": "running", "advice": "", "stages_finished": self._record.finished_stages}
            self._write_run()

    def run_finished(self, result: DeformResult) -> None:
        """Complete the record, as if the run had gone through."""
        earlier = [stage for stage in self._record.stages if stage.index < result.stages[0].index]
        super().run_finished(
            dataclasses.replace(
                result,
                loss_initial=(*earlier, *result.stages)[0].loss_before,
                gradient_evaluations=result.gradient_evaluations + sum(stage.gradient_evaluations for stage in earlier),
                rollouts=result.rollouts + sum(stage.rollouts for stage in earlier),
                seconds=result.seconds + sum(stage.seconds.get("total", 0.0) for stage in self._record.stages),
            )
        )
