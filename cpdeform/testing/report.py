"""What a set of checks found: one line a check, with the figure that was measured and its bound."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Generic, Literal, TypeVar

from cpdeform.core.errors import CpdeformError, UnknownNameError

Bench = TypeVar("Bench")
CheckStatus = Literal["passed", "failed", "skipped"]


class CheckError(CpdeformError, AssertionError):
    """A part that does not keep its interface's contract; the text lists what failed."""


class Skip(Exception):  # noqa: N818 - not an error: raised inside a check that does not apply
    """A check that does not apply to the part at hand; its text says why."""


@dataclasses.dataclass(frozen=True)
class Finding:
    """A measured figure; the check passes where it is at most `bound` (a figure of nan fails).

    Attributes:
        figure: What was measured: an error, or a number of violations.
        bound: The largest value that passes.
        note: What the figure is about, e.g. which of several quantities was worst; empty where the check's name says it.
    """

    figure: float
    bound: float
    note: str = ""


@dataclasses.dataclass(frozen=True)
class Check:
    """Outcome of one check.

    Attributes:
        name: What was checked.
        status: ``"passed"``, ``"failed"`` or ``"skipped"``.
        figure: What was measured; None where nothing was, because the check was skipped or raised.
        bound: The largest figure that passes; None where nothing was measured.
        advice: What to do about a failure, or why the check was skipped; empty for a passed check.
    """

    name: str
    status: CheckStatus
    figure: float | None = None
    bound: float | None = None
    advice: str = ""

    def __str__(self) -> str:
        measured = "" if self.figure is None else f"{self.figure:.3g} (bound {self.bound:.3g})"
        line = f"{self.status:<8}{self.name:<58}{measured}".rstrip()
        return f"{line}\n{'':<8}{self.advice}" if self.advice else line


@dataclasses.dataclass(frozen=True)
class Report:
    """Outcome of all checks of one part.

    Attributes:
        subject: Name of the part.
        checks: The checks, in the order in which they ran.
    """

    subject: str
    checks: tuple[Check, ...]

    def select(self, status: CheckStatus) -> tuple[Check, ...]:
        """Checks of one status."""
        return tuple(check for check in self.checks if check.status == status)

    @property
    def passed(self) -> bool:
        """Whether no check failed."""
        return not self.select("failed")

    def raise_if_failed(self) -> None:
        """Raise what failed.

        Raises:
            CheckError: A check failed.
        """
        failed = self.select("failed")
        if failed:
            lines = "\n".join(str(check) for check in failed)
            raise CheckError(f"{self.subject}: {len(failed)} of {len(self.checks)} checks failed\n{lines}")

    def to_dict(self) -> dict[str, Any]:
        """The report as plain data, for JSON."""
        return {"subject": self.subject, "passed": self.passed, "checks": [dataclasses.asdict(check) for check in self.checks]}

    def __str__(self) -> str:
        counts = ", ".join(f"{len(self.select(status))} {status}" for status in ("passed", "failed", "skipped"))
        return "\n".join([f"{self.subject}: {counts}", *(str(check) for check in self.checks)])


@dataclasses.dataclass(frozen=True)
class CheckItem(Generic[Bench]):
    """A check before it runs.

    Attributes:
        name: What is checked.
        measure: Measures on a bench, which holds the part; raises `Skip` where the check does not apply.
        advice: What the author of the part should do about a failure.
    """

    name: str
    measure: Callable[[Bench], Finding]
    advice: str

    def run(self, bench: Bench) -> Check:
        """Run the check; whatever the part raises is a failure of this check, not an error."""
        try:
            finding = self.measure(bench)
        except Skip as reason:
            return Check(self.name, "skipped", advice=str(reason))
        except Exception as error:
            raised = " ".join(f"It raised {type(error).__name__}: {error}".split()).rstrip(".:")
            return Check(self.name, "failed", advice=f"{raised}. {self.advice}")
        if finding.figure <= finding.bound:
            return Check(self.name, "passed", finding.figure, finding.bound)
        note = f"Worst: {finding.note}. " if finding.note else ""
        return Check(self.name, "failed", finding.figure, finding.bound, note + self.advice)


def choose(items: Sequence[CheckItem[Bench]], only: Sequence[str]) -> list[CheckItem[Bench]]:
    """Checks that have one of the given texts as name or, where no check has, as part of it; all where none is given.

    Raises:
        UnknownNameError: A text is part of no check's name.
    """
    names, chosen = [item.name for item in items], set()
    for text in only:
        found = [text] if text in names else [name for name in names if text in name]
        if not found:
            raise UnknownNameError("check", text, names)
        chosen.update(found)
    return [item for item in items if not only or item.name in chosen]


def run_checks(subject: str, items: Sequence[CheckItem[Bench]], bench: Bench) -> Report:
    """Run checks one after the other."""
    return Report(subject, tuple(item.run(bench) for item in items))


def worst(figures: dict[str, float], bound: float) -> Finding:
    """The finding of the largest of several named figures; nan counts as largest.

    Args:
        figures: Name to figure; at least one.
        bound: Bound of all of them.
    """
    name = max(figures, key=lambda key: float("inf") if figures[key] != figures[key] else figures[key])
    return Finding(figures[name], bound, name)


def violations(complaints: Sequence[str]) -> Finding:
    """A finding that counts complaints, none of which may be there."""
    return Finding(float(len(complaints)), 0.0, "; ".join(complaints))


def complaint_unless_raised(
    call: Callable[[], object], error_type: type[Exception], *, words: Sequence[str], what: str
) -> list[str]:
    """Call something that must raise.

    Args:
        call: What to call.
        error_type: What it must raise.
        words: Text of which at least one must be in the message.
        what: Name of the case, for the complaint.

    Returns:
        No complaint, or one.
    """
    try:
        call()
    except error_type as error:
        named = any(word in str(error) for word in words)
        return [] if named else [f'{what}: {error_type.__name__} does not name {" or ".join(words)}, but says "{error}"']
    except Exception as error:
        return [f"{what}: raised {type(error).__name__} ({error}) instead of {error_type.__name__}"]
    return [f"{what}: raised nothing instead of {error_type.__name__}"]
