"""Measurements in fresh processes: what one needs, leaks or breaks does not touch the next.

`call_in_worker("package.module:function", request)` starts a Python process that imports the function, calls it with the request
and sends back what it returns; both are plain JSON objects.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from typing import Any, cast

ERROR_LENGTH = 200


class WorkerError(Exception):
    """A worker that gave no result; the text says why, in a line."""


def call_in_worker(
    target: str, request: Mapping[str, Any], *, timeout: float | None = None, environment: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Call a function in a process of its own and wait for it.

    Args:
        target: ``"package.module:function"``; the function takes and returns a dictionary that JSON can hold.
        request: Its argument.
        timeout: Seconds after which the process is killed; None to wait for ever.
        environment: Environment variables to set above those of this process.

    Returns:
        What the function returned.

    Raises:
        WorkerError: It raised, the process died, or the time is over (then the text is ``"timeout"``).
    """
    command = [sys.executable, "-P", "-m", "cpdeform.experiments.worker", target]
    try:
        finished = subprocess.run(
            command,
            input=json.dumps(request),
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout,
            env={**os.environ, **(environment or {})},
        )
    except subprocess.TimeoutExpired as error:
        raise WorkerError("timeout") from error
    if finished.returncode != 0:
        raise WorkerError(_death(finished))
    answer: dict[str, Any] = json.loads(finished.stdout)
    if "error" in answer:
        raise WorkerError(answer["error"])
    return cast(dict[str, Any], answer["result"])


def measured(row: Mapping[str, Any], target: str, request: Mapping[str, Any], *, threads: int, timeout: float) -> dict[str, Any]:
    """Fill a row of a bench with what a function finds in a process of its own.

    Args:
        row: What the row says already.
        target: See `call_in_worker`.
        request: See `call_in_worker`.
        threads: Threads of the libraries in that process.
        timeout: Seconds after which it is given up.

    Returns:
        The row with the findings, and ``error``: None, or why there are none.
    """
    environment = {"OMP_NUM_THREADS": str(threads), "MKL_NUM_THREADS": str(threads)}
    try:
        return {**row, **call_in_worker(target, request, timeout=timeout, environment=environment), "error": None}
    except WorkerError as error:
        return {**row, "error": str(error)}


def _death(finished: subprocess.CompletedProcess[str]) -> str:
    """Why a process ended without an answer."""
    if finished.returncode < 0:
        number = -finished.returncode
        name = signal.Signals(number).name if number in set(signal.Signals) else str(number)
        hint = " (out of memory?)" if name == "SIGKILL" else ""
        return f"the process was killed by {name}{hint}"
    lines = [line.strip() for line in finished.stderr.splitlines() if line.strip()]
    return _shorten(f"the process ended with exit code {finished.returncode}: {lines[-1] if lines else 'no message'}")


def _shorten(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= ERROR_LENGTH else line[: ERROR_LENGTH - 3] + "..."


def _answer(target: str, request: dict[str, Any]) -> dict[str, Any]:
    from cpdeform.core.errors import CpdeformError

    module, _, name = target.partition(":")
    try:
        function: Callable[[dict[str, Any]], dict[str, Any]] = getattr(importlib.import_module(module), name)
        return {"result": function(request)}
    except CpdeformError as error:
        return {"error": _shorten(str(error))}
    except MemoryError:
        return {"error": "out of memory"}
    except Exception as error:
        return {"error": _shorten(f"{type(error).__name__}: {error}")}


def main() -> None:
    """Read the request from stdin, write the answer to stdout; what anybody else prints goes to stderr."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    with answers:
        json.dump(_answer(sys.argv[1], json.load(sys.stdin)), answers)


if __name__ == "__main__":
    main()
