"""Draw all pictures of README and docs: `make pictures`, or some: `python scripts/draw_docs.py writer page goals-multi-stage-1`.

``writer`` is a run of the task writer, ``sculpted`` and ``sculpted-2`` show runs of tasks of several stages, ``meshes`` those
of three meshes, ``letters`` the heights of a board that was written on, ``page`` is a screenshot of the page of one of them (a
headless Chromium is needed); each of these runs takes 10 to 60 minutes. The others are the sheets of all tasks. Runs are kept in
``runs/pictures``: those that are finished are drawn again without being made again. Delete the folder to make them anew.
"""

from __future__ import annotations

import io
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from own_meshes import FILES, UPWARDS, write_meshes

from cpdeform.tasks.draw_goals import SHEETS

ROOT = Path(__file__).resolve().parents[1]
DOCS, RUNS = ROOT / "docs", ROOT / "runs" / "pictures"
PAGE_SIZE = (1280, 900)
CAMERAS = {
    "star": "top",
    "airplane": "top",
    "bottle": "front",
    "chair": "default",
    "rope++": "top",
    "move++": "top",
    "pinch": "default",
    "airplane-1000": "top",
    "bowl": "default",
    "heart": "top",
    "mug": "default",
}
"""Tasks of the pictures of sculpted shapes, and where they are looked at from."""
SCULPTED = {
    "sculpted": ("star", "airplane", "bottle", "chair"),
    "sculpted-2": ("rope++", "move++", "pinch", "airplane-1000"),
    "meshes": ("bowl", "heart", "mug"),
}
"""Pictures and their rows: that of the README, what the results page shows beside it, and runs of `own_meshes`."""
GENERATED = {"airplane-1000": ("airplane", 1000)}
"""Rows that are a task with a generated goal: task and seed."""
TOUCHES_SHOWN = 3
"""Touches of a run in such a picture, from its first one on."""
ENDED = ("finished", "no_improvement")
"""States of runs that need not be made again: in the second one the last stage found nothing more."""
SHOWN = "#stage=11&step=10&colour=height&goal=1&view=top"


def draw_writer() -> None:
    """The picture at the top of the README."""
    directory = run("writer")
    command("draw", str(directory), "--what", "picture")
    shrink((directory / "picture.png").read_bytes(), DOCS / "writer.png")


def draw_letters() -> None:
    """Heights of the board of writer++: start, result and goal."""
    directory = run("writer++")
    command("draw", str(directory), "--what", "heights")
    shrink((directory / "heights.png").read_bytes(), DOCS / "pictures" / "letters.png")


def draw_sculpted(picture: str) -> None:
    """A row a run: three touches with priorities and tools, the first of them on the start, the result, and the goal."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from torch import cat

    from cpdeform.report.pictures import draw_panel, draw_priorities, make_view
    from cpdeform.run.record_reader import load_record

    tasks = SCULPTED[picture]
    figure = Figure(figsize=(12.5, 2.6 * len(tasks)), dpi=80, layout="constrained", facecolor="white")
    for task, axes in zip(tasks, figure.subplots(len(tasks), 5, squeeze=False), strict=True):
        record = load_record(run(task))
        view = make_view(record, camera=CAMERAS[task])
        stages = [stage for stage in record.stages if stage.status.executed]
        shown = [stages[number * len(stages) // TOUCHES_SHOWN] for number in range(TOUCHES_SHOWN)]
        for axis, stage in zip(axes, shown, strict=False):
            draw_priorities(figure, axis, view, record, stage, stage.tool_poses[0], bar=False)
            axis.set_title(f"{task}: touch {stage.index + 1}" if stage is shown[0] else f"touch {stage.index + 1}", fontsize=11)
        start, result = stages[0].state_before.position[0], stages[-1].state.position[0]
        for axis, title, cloud in zip(axes[-2:], (f"after {len(stages)} touches", "goal"), (result, record.goal), strict=True):
            draw_panel(axis, view, record, title, cloud.double(), None)
        seen = view.camera.project(cat([start, record.goal]).double().numpy())
        low, high = seen.min(axis=0), seen.max(axis=0)
        margin = 0.25 * max(high[:2] - low[:2])
        for axis in axes:
            for arrow in list(axis.texts):
                arrow.remove()
            axis.set_xlim(low[0] - margin, high[0] + margin)
            axis.set_ylim(low[1] - margin, high[1] + margin)
    drawn = io.BytesIO()
    FigureCanvasAgg(figure).print_figure(drawn, format="png")
    shrink(drawn.getvalue(), DOCS / "pictures" / f"{picture}.png")


def draw_page() -> None:
    """The page of a run, as a browser shows it."""
    from cpdeform.report.page.write import write_page
    from cpdeform.testing.browser import Browser

    page = write_page(run("star"))
    with Browser(width=PAGE_SIZE[0], height=PAGE_SIZE[1]) as browser:
        browser.open(page.as_uri() + SHOWN)
        browser.wait_for("document.documentElement?.dataset.ready")
        shrink(browser.screenshot(), DOCS / "pictures" / "page.png")


def draw_sheet(name: str) -> None:
    """A sheet of tasks."""
    out = ["--out", str(DOCS / "pictures"), "--sheet", name]
    subprocess.run([sys.executable, "-m", "cpdeform.tasks.draw_goals", *out], check=True)


def run(task: str) -> Path:
    """The record of a run, made unless it is there."""
    directory = RUNS / task
    record = directory / "run.json"
    if not record.exists() or json.loads(record.read_text(encoding="utf-8"))["status"] not in ENDED:
        command("run", *arguments_of(task), "--no-pictures", "--overwrite", "--out", str(directory))
    return directory


def arguments_of(name: str) -> list[str]:
    """What `cpdeform run` has to be told to make a row: a task, one with a generated goal, or that of a mesh."""
    if name in FILES:
        return [str(mesh_task(name))]
    if name not in GENERATED:
        return [name]
    task, seed = GENERATED[name]
    goal = RUNS / "goals" / f"{name}.npz"
    goal.parent.mkdir(parents=True, exist_ok=True)
    command("task", "generate", task, "--seed", str(seed), "--out", str(goal), "--overwrite")
    return [task, "--goal", str(goal)]


def mesh_task(name: str) -> Path:
    """The task file of a mesh, made unless it is there."""
    folder = RUNS / "meshes"
    path = folder / f"{name}.yaml"
    if not path.exists():
        write_meshes(folder)
        up = ["--up", UPWARDS[name]] if name in UPWARDS else []
        subprocess.run([sys.executable, "-m", "cpdeform", "task", "new", name, "--goal", FILES[name], *up], cwd=folder, check=True)
    return path


def shrink(data: bytes, path: Path) -> None:
    """Write a PNG file as small as it gets without loss."""
    from PIL import Image

    Image.open(io.BytesIO(data)).convert("RGB").save(path, optimize=True)


def command(*arguments: str) -> None:
    """Run the command line of cpdeform."""
    subprocess.run([sys.executable, "-m", "cpdeform", *arguments], check=True)


def main() -> None:
    """Draw what the command line names, or everything."""
    makers: dict[str, Callable[[], None]] = {"writer": draw_writer, "letters": draw_letters, "page": draw_page}
    makers |= {picture: lambda picture=picture: draw_sculpted(picture) for picture in SCULPTED}
    makers |= {name: lambda name=name: draw_sheet(name) for name in SHEETS}
    names = sys.argv[1:] or list(makers)
    if unknown := set(names) - set(makers):
        sys.exit(f"unknown: {', '.join(sorted(unknown))}; there are {', '.join(makers)}")
    for name in names:
        makers[name]()


if __name__ == "__main__":
    main()
