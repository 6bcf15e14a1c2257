"""Draw all pictures of README and docs: `make pictures`, or some: `python scripts/draw_docs.py writer page goals`.

``writer`` is a run of the task writer, ``page`` a screenshot of the page of a run of the task star (a headless Chromium is needed),
``goals`` are the sheets of all tasks.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

DOCS = Path(__file__).parent.parent / "docs"
PAGE_SIZE = (1280, 900)
SHOWN = "#stage=2&step=8&colour=priority&goal=1"
STAGES, ITERATIONS = 3, 20


def draw_writer(folder: Path) -> None:
    """The picture at the top of the README."""
    command("run", "writer", "--out", str(folder / "writer"))
    shutil.copy(folder / "writer" / "picture.png", DOCS / "writer.png")


def draw_page(folder: Path) -> None:
    """The page of a run, as a browser shows it."""
    from cpdeform.report.page.write import write_page
    from cpdeform.testing.browser import Browser

    options = ["--stages", str(STAGES), "--iterations", str(ITERATIONS), "--no-pictures"]
    command("run", "star", *options, "--out", str(folder / "star"))
    page = write_page(folder / "star")
    with Browser(width=PAGE_SIZE[0], height=PAGE_SIZE[1]) as browser:
        browser.open(page.as_uri() + SHOWN)
        browser.wait_for("document.documentElement?.dataset.ready")
        shrink(browser.screenshot(DOCS / "pictures" / "page.png"), DOCS / "pictures" / "page.png")


def draw_goals(folder: Path) -> None:
    """The sheets of all tasks."""
    subprocess.run([sys.executable, "-m", "cpdeform.tasks.draw_goals", "--out", str(DOCS / "pictures")], check=True)


def shrink(data: bytes, path: Path) -> None:
    """Write a PNG file of 256 colours: a third of the size, and no difference to see."""
    import io

    from PIL import Image

    picture = Image.open(io.BytesIO(data)).convert("RGB")
    picture.quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)


def command(*arguments: str) -> None:
    """Run the command line of cpdeform."""
    subprocess.run([sys.executable, "-m", "cpdeform", *arguments], check=True)


MAKERS = {"writer": draw_writer, "page": draw_page, "goals": draw_goals}


def main() -> None:
    """Draw what the command line names, or everything."""
    names = sys.argv[1:] or list(MAKERS)
    if unknown := set(names) - set(MAKERS):
        sys.exit(f"unknown: {', '.join(sorted(unknown))}; there are {', '.join(MAKERS)}")
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            MAKERS[name](Path(folder))


if __name__ == "__main__":
    main()
