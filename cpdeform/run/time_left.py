"""How much time a run still takes, by its estimate at first and more and more by what really happened."""

from __future__ import annotations

import time
from collections.abc import Callable

from cpdeform.planning.effort import JointEffort
from cpdeform.run.estimate import RunEstimate


class TimeLeft:
    """Told of stages, descents over several of them and evaluations, tells the time that is left.

    Args:
        estimate: Of the run; None where there is none: then nothing is known before a stage is finished.
        stages: Number of stages.
        clock: Tells seconds.
    """

    def __init__(self, estimate: RunEstimate | None, *, stages: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._estimate, self._stages = estimate, stages
        self._begin = self._part_begin = clock()
        self._finished: list[float] = []
        self._evaluated = 0
        self._due = list(() if estimate is None else estimate.joint)
        self._joint: JointEffort | None = None
        self._joint_seconds = 0.0
        self._joint_spent, self._joint_expected = 0.0, 0.0
        """What those that were expected took, and what they were expected to take."""

    @property
    def elapsed(self) -> float:
        """Seconds since the beginning."""
        return self._clock() - self._begin

    def stage_started(self) -> None:
        """A stage begins; descents over stages before it that did not come will not come."""
        self._next_part()
        self._due = [joint for joint in self._due if joint.after > len(self._finished)]

    def evaluated(self, worlds: int) -> None:
        """The gradients of so many worlds were computed."""
        self._evaluated += worlds

    def stage_finished(self) -> None:
        """A stage is over."""
        # Stages whose results come together, as those of a beam, share their time.
        begin = self._begin + sum(self._finished) + self._joint_seconds
        self._finished.append(max(0.0, self._clock() - begin))
        self._next_part()

    def joint_started(self) -> None:
        """A descent over several finished stages begins."""
        due = [joint for joint in self._due if joint.after == len(self._finished)]
        self._next_part()
        self._joint = due[0] if due else None

    def joint_finished(self) -> None:
        """It is over."""
        spent = self._clock() - self._part_begin
        self._joint_seconds += spent
        if self._joint is not None:
            self._due.remove(self._joint)
            self._joint_spent += spent
            self._joint_expected += self._expected(self._joint)
        self._next_part()

    def seconds(self) -> float | None:
        """Seconds left; None while nothing is known."""
        stage = self._stage_seconds()
        if stage is None:
            return None
        stages = max(0, self._stages - len(self._finished))
        others = sum(self._joint_time(joint) for joint in self._due if joint is not self._joint)
        if self._joint is not None:
            done = min(1.0, self._evaluated / max(1, self._joint.iterations[1]))
            return stages * stage + others + self._left(self._joint_time(self._joint), done)
        if stages == 0:
            return others
        return (stages - 1) * stage + others + self._left(stage, self._share_done())

    def _next_part(self) -> None:
        """Something else begins."""
        self._part_begin, self._evaluated, self._joint = self._clock(), 0, None

    def _left(self, expected: float, done: float) -> float:
        """Seconds that are left of what goes on now, of which a share (0 to 1) is done."""
        spent = self._clock() - self._part_begin
        by_expectation = max(0.0, expected - spent)
        by_rate = spent * (1.0 - done) / done if done > 0.0 else by_expectation
        return (1.0 - done) * by_expectation + done * by_rate

    def _stage_seconds(self) -> float | None:
        """Seconds of a stage to come: the mean of those that are over, or the estimate."""
        if self._finished:
            return sum(self._finished) / len(self._finished)
        return None if self._estimate is None else self._estimate.stage_seconds

    def _joint_time(self, joint: JointEffort) -> float:
        """Seconds of a descent to come: as estimated, corrected by those that are over."""
        factor = self._joint_spent / self._joint_expected if self._joint_expected > 0.0 else 1.0
        return factor * self._expected(joint)

    def _expected(self, joint: JointEffort) -> float:
        return 0.0 if self._estimate is None else self._estimate.joint_seconds(joint)

    def _share_done(self) -> float:
        """Share (0 to 1) of a stage's gradients that were computed."""
        return 0.0 if self._estimate is None else min(1.0, self._evaluated / self._estimate.stage_gradients)


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
