"""The Markdown table of errors against recorded PlasticineLab rollouts; `cpdeform check golden ... --markdown FILE` writes it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from cpdeform.core.plugins import Registry
from cpdeform.experiments.tables import cell, describe_machine, describe_versions, machine_line, markdown
from cpdeform.testing.golden import COSINE_BOUND, NORM_BOUND, POSITION_BOUND, VELOCITY_BOUND, GoldenErrors

HEADER = (
    "scene",
    "backend",
    "position error",
    "velocity error",
    "1 - cosine",
    "norm error",
    "loss error",
    "status",
)


def golden_table(results: Mapping[str, Sequence[GoldenErrors]], *, command: str, device: str, registry: Registry) -> str:
    """Markdown page of the errors of each recording and backend.

    Args:
        results: Errors of each backend's recordings, by the backend's name.
        command: How to make the page again, without paths of this machine.
        device: Where the backends ran.
        registry: Its plugins' versions are named.

    Returns:
        The page.
    """
    rows = [
        _row(errors, backend)
        for _, errors, backend in sorted(
            ((errors.name, errors, backend) for backend, all_errors in results.items() for errors in all_errors),
            key=lambda row: (row[0], row[2]),
        )
    ]
    reasons = [
        f"- {errors.name}, {backend}: {errors.reason}"
        for backend, all_errors in results.items()
        for errors in all_errors
        if errors.reason
    ]
    parts = [
        "# Errors against recorded PlasticineLab rollouts",
        f"Written by `{command}`, where `GOLDEN_DIR` is a folder of rollouts and gradients recorded from PlasticineLab in double "
        f"precision (they are not part of this project). Device: {device}.",
        machine_line(describe_machine(device=device), describe_versions(registry)) + ".",
        markdown(HEADER, rows),
        "\n".join(
            [
                "| figure | what it is | tolerance |",
                "| --- | --- | --- |",
                f"| position error | largest error of a coordinate at the end, domain edges | {POSITION_BOUND:g} |",
                f"| velocity error | error of the final velocities, relative to their norm | {VELOCITY_BOUND:g} |",
                f"| 1 - cosine | of the angle between the gradients of the actions | {1.0 - COSINE_BOUND:.3g} |",
                f"| norm error | relative error of the gradient's norm | {NORM_BOUND:g} |",
                "| loss error | relative error of PlasticineLab's loss | none |",
            ]
        ),
        "A dash: not recorded (files without a gradient), or not run.",
        *(["\n".join(["Not passed:", "", *reasons])] if reasons else []),
    ]
    return "\n\n".join(parts) + "\n"


def _row(errors: GoldenErrors, backend: str) -> list[str]:
    cosine = None if errors.gradient_cosine is None else max(1.0 - errors.gradient_cosine, 0.0)
    figures = (errors.position_error, errors.velocity_error, cosine, errors.gradient_norm_error, errors.loss_error)
    return [errors.name, backend, *(cell(figure, ".1e") for figure in figures), errors.status]


def golden_command(backends: Sequence[str], *, device: str, dtype: str | None, settings: Sequence[str], out: Path) -> str:
    """The command that writes the page, with `GOLDEN_DIR` for the folder and no absolute path."""
    words = ["cpdeform check golden GOLDEN_DIR", *(f"--backend {backend}" for backend in backends)]
    words += [] if device == "cpu" else [f"--device {device}"]
    words += [] if dtype is None else [f"--dtype {dtype}"]
    words += [f"--set {setting}" for setting in settings]
    return " ".join([*words, f"--markdown {out.name if out.is_absolute() else out}"])
