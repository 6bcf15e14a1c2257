"""Going on in the directory of a run that broke off: its record becomes that of one run that went through."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

from torch import Tensor

from cpdeform.core.task import Task
from cpdeform.planning.result import DeformResult, Status
from cpdeform.run.record import RunRecorder
from cpdeform.run.record_files import METRICS_FILE, replacing, stage_file, stage_files, to_json
from cpdeform.run.record_reader import RunRecord, load_record
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
    # The plan of an interrupted stage is not the one that it would have come to; and the end of a run comes with its last stage.
    stages = tuple(stage for stage in record.stages if stage.status is Status.FINISHED)[: planned - 1]
    return dataclasses.replace(record, stages=stages) if stages else None


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
        with self._writing():
            self._lock.acquire()
            for path in set(stage_files(self.directory)) - {self.directory / stage_file(index) for index in kept}:
                path.unlink()
            lines = [json.dumps(to_json(line)) for line in self._record.metrics if line.get("stage") in kept]
            with replacing(self.directory / METRICS_FILE) as temporary:
                temporary.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
            self._run = {**self._record.run, "status": "running", "advice": "", "stages_finished": self._record.finished_stages}
            self._write_run()

    def run_finished(self, result: DeformResult) -> None:
        """Complete the record, as if the run had gone through."""
        earlier = self._record.stages
        super().run_finished(
            dataclasses.replace(
                result,
                loss_initial=earlier[0].loss_before,
                gradient_evaluations=result.gradient_evaluations + sum(stage.gradient_evaluations for stage in earlier),
                rollouts=result.rollouts + sum(stage.rollouts for stage in earlier),
                seconds=result.seconds + sum(stage.seconds.get("total", 0.0) for stage in earlier),
            )
        )
