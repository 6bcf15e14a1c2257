"""Make or verify the target files: `python -m cpdeform.tasks.make_targets [--check]`."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from numpy.typing import NDArray

from cpdeform.core.plugins import load_registry
from cpdeform.core.task import load_task
from cpdeform.tasks.strokes import WRITER_STROKES, draw


def write_target(path: Path, position: NDArray[np.uint16]) -> None:
    """Write positions (N, 3) to an .npz file whose bytes depend on the positions only (no time stamp)."""
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, position, allow_pickle=False)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(zipfile.ZipInfo("position.npy"), buffer.getvalue(), zipfile.ZIP_DEFLATED, 9)


def main(
    check: Annotated[bool, typer.Option("--check", help="Compare with the files that are there instead of writing.")] = False,
    backend: Annotated[str, typer.Option(help="Simulator to draw with; must compute in float64.")] = "warp",
) -> None:
    """Draw the strokes of all variants of `writer` in float64 and write their targets."""
    registry = load_registry()
    different = 0
    for variant, stroke in WRITER_STROKES.items():
        task = load_task(f"writer-{variant}", registry=registry)
        simulator = registry.create("simulator", backend, scene=task.scene, dtype=torch.float64)
        position = draw(stroke, simulator)
        if check:
            same = np.array_equal(np.load(task.target)["position"], position)
            different += not same
            typer.echo(f"{task.target.name}: {'identical' if same else 'DIFFERENT'}")
        else:
            task.target.parent.mkdir(parents=True, exist_ok=True)
            write_target(task.target, position)
            typer.echo(f"{task.target.name}: {len(position)} particles, {task.target.stat().st_size} bytes")
    raise typer.Exit(1 if different else 0)


if __name__ == "__main__":
    typer.run(main)
