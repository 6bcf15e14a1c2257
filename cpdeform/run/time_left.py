"""How much time a run still takes, by its estimate at first and more and more by what really happened."""

from __future__ import annotations

import time
from collections.abc import Callable

from cpdeform.run.estimate import RunEstimate


class TimeLeft:
    """Told of stages and evaluations, tells the time that is left.

    Args:
        estimate: Of the run; None where there is none: then nothing is known before a stage is finished.
        stages: Number of stages.
        clock: Tells seconds.
    """

    def __init__(self, estimate: RunEstimate | None, *, stages: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._estimate, self._stages = estimate, stages
        self._begin = self._stage_begin = clock()
        self._finished: list[float] = []
        self._gradients = 0

    @property
    def elapsed(self) -> float:
        """Seconds since the beginning."""
        return self._clock() - self._begin

    def stage_started(self) -> None:
        """A stage begins."""
        self._stage_begin, self._gradients = self._clock(), 0

    def evaluated(self, worlds: int) -> None:
        """The gradients of so many worlds were computed."""
        self._gradients += worlds

    def stage_finished(self) -> None:
        """A stage is over."""
        now = self._clock()
        # Stages whose results come together, as those of a beam, share their time.
        begin = self._begin + sum(self._finished)
        self._finished.append(max(0.0, now - begin))
        self._stage_begin, self._gradients = now, 0

    def seconds(self) -> float | None:
        """Seconds left; None while nothing is known."""
        stage = self._stage_seconds()
        if stage is None:
            return None
        after = max(0, self._stages - len(self._finished) - 1)
        if len(self._finished) >= self._stages:
            return 0.0
        spent = self._clock() - self._stage_begin
        by_estimate = max(0.0, stage - spent)
        done = self._share_done()
        by_rate = spent * (1.0 - done) / done if done > 0.0 else by_estimate
        return after * stage + (1.0 - done) * by_estimate + done * by_rate

    def _stage_seconds(self) -> float | None:
        """Seconds of a stage to come: the mean of those that are over, or the estimate."""
        if self._finished:
            return sum(self._finished) / len(self._finished)
        return None if self._estimate is None else self._estimate.stage_seconds

    def _share_done(self) -> float:
        """Share (0 to 1) of a stage's gradients that were computed."""
        return 0.0 if self._estimate is None else min(1.0, self._gradients / self._estimate.stage_gradients)


def duration(seconds: float) -> str:
    """Seconds as text: 45 s, 3 min, 1 h 20 min."""
    if seconds < 90.0:
        return f"{max(1, round(seconds))} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"


def duration_range(seconds: tuple[float, float]) -> str:
    """Least and most seconds as text; one where both read the same."""
    least, most = (duration(number) for number in seconds)
    return least if least == most else f"{least} to {most}"
