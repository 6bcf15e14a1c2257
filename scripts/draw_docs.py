"""Draw all pictures of README and docs: `make pictures`, or some: `python scripts/draw_docs.py writer page goals-multi-stage-1`.

``writer`` is a run of the task writer, ``page`` a screenshot of the page of a run of the task star (a headless Chromium is needed,
and the run takes half an hour), the others are the sheets of all tasks. Runs are kept in ``runs/pictures``: those that are finished
are drawn again without being made again. Delete the folder to make them anew.
"""

from __future__ import annotations

import io
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from cpdeform.tasks.draw_goals import SHEETS

ROOT = Path(__file__).resolve().parents[1]
DOCS, RUNS = ROOT / "docs", ROOT / "runs" / "pictures"
PAGE_SIZE = (1280, 900)
SHOWN = "#stage=12&step=10&colour=height&goal=1"


def draw_writer() -> None:
    """The picture at the top of the README."""
    directory = run("writer")
    command("draw", str(directory), "--what", "picture")
    shrink((directory / "picture.png").read_bytes(), DOCS / "writer.png")


def draw_page() -> None:
    """The page of a run, as a browser shows it."""
    from cpdeform.report.page.write import write_page
    from cpdeform.testing.browser import Browser

    page = write_page(run("star", "--strategy", "sculpt"))
    with Browser(width=PAGE_SIZE[0], height=PAGE_SIZE[1]) as browser:
        browser.open(page.as_uri() + SHOWN)
        browser.wait_for("document.documentElement?.dataset.ready")
        shrink(browser.screenshot(), DOCS / "pictures" / "page.png")


def draw_sheet(name: str) -> None:
    """A sheet of tasks."""
    out = ["--out", str(DOCS / "pictures"), "--sheet", name]
    subprocess.run([sys.executable, "-m", "cpdeform.tasks.draw_goals", *out], check=True)


def run(task: str, *options: str) -> Path:
    """The record of a run, made unless it is there."""
    directory = RUNS / task
    record = directory / "run.json"
    if not record.exists() or json.loads(record.read_text(encoding="utf-8"))["status"] != "finished":
        command("run", task, *options, "--no-pictures", "--overwrite", "--out", str(directory))
    return directory


def shrink(data: bytes, path: Path) -> None:
    """Write a PNG file as small as it gets without loss."""
    from PIL import Image

    Image.open(io.BytesIO(data)).convert("RGB").save(path, optimize=True)


def command(*arguments: str) -> None:
    """Run the command line of cpdeform."""
    subprocess.run([sys.executable, "-m", "cpdeform", *arguments], check=True)


def main() -> None:
    """Draw what the command line names, or everything."""
    makers: dict[str, Callable[[], None]] = {"writer": draw_writer, "page": draw_page}
    makers |= {name: lambda name=name: draw_sheet(name) for name in SHEETS}
    names = sys.argv[1:] or list(makers)
    if unknown := set(names) - set(makers):
        sys.exit(f"unknown: {', '.join(sorted(unknown))}; there are {', '.join(makers)}")
    for name in names:
        makers[name]()


if __name__ == "__main__":
    main()
