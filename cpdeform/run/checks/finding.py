"""What a check tells."""

from __future__ import annotations

import dataclasses
from typing import Literal

Severity = Literal["error", "warning", "note"]
"""``"error"``: the task cannot do what it is meant to; ``"warning"``: it hardly will; ``"note"``: it will, if that is meant."""


@dataclasses.dataclass(frozen=True)
class Finding:
    """Something about a task that its maker should know.

    Attributes:
        severity: How bad it is.
        kind: Which check found it, e.g. ``"tool thickness"``.
        where: What of the task it is about, as a path of fields, e.g. ``"scene.tools.0"``.
        what: What is found, with figures, one sentence.
        remedy: What to do about it, one sentence.
    """

    severity: Severity
    kind: str
    where: str
    what: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what} {self.remedy}"
