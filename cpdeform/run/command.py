"""The command line that repeats a run."""

from __future__ import annotations

import json
import shlex
from typing import Any

from cpdeform.run.flags import FLAGS
from cpdeform.run.origins import Origin, flatten
from cpdeform.run.record_reader import RunRecord
from cpdeform.run.resume import recorded_configuration


def command_of(record: RunRecord) -> str | None:
    """The command that makes a recorded run again; parts chosen by "auto" are named, so that it is the same run elsewhere.

    Args:
        record: The run.

    Returns:
        The command; None for a run made in Python with objects of its own, which no command line has.
    """
    origins = recorded_origins(record)
    if Origin.OBJECT.value in origins.values() or record.run.get("configuration") is None:
        return None
    configuration = flatten(recorded_configuration(record).model_dump(mode="json"))
    resumed = record.run.get("resumed_from")
    words = ["cpdeform", "run"]
    words += ["--resume", str(resumed["directory"])] if resumed else [str(configuration["task"])]
    named = {"backend", "ot"}
    for path, value in configuration.items():
        if path == "task" or (path not in named and origins.get(path) != Origin.GIVEN.value):
            continue
        words += [FLAGS[path], _text(value)] if path in FLAGS else ["--set", f"{path}={_text(value)}"]
    return shlex.join(words)


def recorded_origins(record: RunRecord) -> dict[str, str]:
    """Where each value of a record's configuration comes from.

    Records of earlier versions do not say so: there a value that is not the default counts as given.
    """
    content = record.run.get("origins")
    if isinstance(content, dict):
        return {str(path): str(origin) for path, origin in content.items()}
    from cpdeform.run.configuration import RunConfiguration

    default = flatten(RunConfiguration().model_dump(mode="json"))
    values = flatten(recorded_configuration(record).model_dump(mode="json"))
    return {
        path: (Origin.DEFAULT if path in default and default[path] == value else Origin.GIVEN).value
        for path, value in values.items()
    }


def _text(value: Any) -> str:
    """A value as ``--set`` and the flags read it."""
    return value if isinstance(value, str) else json.dumps(value)
