"""The result of a run that was resolved, with what defined it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from cpdeform.planning.result import DeformResult
from cpdeform.run.configuration import RunConfiguration
from cpdeform.run.record import save_result
from cpdeform.run.record_reader import RunRecord


@dataclasses.dataclass(frozen=True)
class RunResult(DeformResult):
    """A whole run, and what defined it.

    Attributes:
        configuration: All names and values of the run.
        resumed_from: The record that the run went on from; None for one from the task's start.
        origins: Where each value of the configuration comes from, see `cpdeform.run.origins`.
    """

    configuration: RunConfiguration = dataclasses.field(default_factory=RunConfiguration)
    resumed_from: RunRecord | None = None
    origins: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def save(self, directory: str | Path, *, overwrite: bool = False) -> Path:
        """Write the run record (configuration, metrics, states, actions) and return its directory.

        `cpdeform.report.draw_run` adds the picture and the animation.

        Args:
            directory: Where to write; made if missing.
            overwrite: Allow a directory that is not empty; files of an earlier record are then removed, others are left alone.

        Raises:
            InputError: The directory exists and is not empty (without `overwrite`), or cannot be written.
            RecordError: Writing failed on the way, e.g. because the disk is full.
        """
        return save_result(
            self,
            Path(directory),
            configuration=self.configuration,
            overwrite=overwrite,
            resumed_from=self.resumed_from,
            origins=self.origins,
        )

    def _repr_html_(self) -> str:
        """How a notebook shows it: pictures, losses, metric."""
        from cpdeform.run.notebook import result_html

        return result_html(self)
