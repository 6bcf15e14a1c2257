"""Do seeded runs give the same numbers, bit for bit, as another revision of this repository did?

    .venv/bin/python scripts/compare_runs.py f60e65c

Both revisions run in processes of their own on this machine, one thread each, the other one from a worktree in a temporary folder,
with its own C++ plugin, which takes a minute or two to build. Runs before format 2 of the record had their settings in the task
files; the strategy ``tuned`` has them now.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import h5py
import numpy as np

RUNS = {
    "writer": ("writer", "--iterations", "5"),
    "star": ("star", "--stages", "2", "--iterations", "4"),
    "rope++": ("rope++", "--stages", "1", "--iterations", "4"),
    "table-v1": ("table-v1", "--iterations", "4"),
    "move-v1": ("move-v1", "--iterations", "4"),
    "pinch": ("pinch", "--stages", "1", "--iterations", "4"),
}
NATIVE = "plugins/cpdeform-native"
OLD_NAMES = {"tool_poses": "manipulator_poses", "state/tool_pose": "state/manipulator_pose"}
"""What arrays were called up to format 2 of the record."""

DATASETS = ("actions", "positions", "tool_poses", "placements/actions", "placements/loss", "placements/pose")
STATE = ("position", "velocity", "affine", "elastic_strain", "tool_pose")
WITHOUT_EDITABLE = (
    "import runpy, sys; sys.meta_path[:] = [finder for finder in sys.meta_path if 'ScikitBuild' not in type(finder).__name__]; "
    "sys.argv[0] = 'cpdeform'; runpy.run_module('cpdeform', run_name='__main__')"
)
"""Starts the command line without the finder of an editable C++ plugin, which would come before a folder on the path."""

TUNED = "cpdeform/experiments/tuned.yaml"


def main() -> int:
    """Run both revisions and compare; exit code 1 if a number differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("revision", help="what to compare with, e.g. f60e65c")
    parser.add_argument("--runs", default=",".join(RUNS), help="names, separated by commas")
    options = parser.parse_args()
    here = Path(__file__).resolve().parents[1]
    different = 0
    with tempfile.TemporaryDirectory() as folder:
        other = Path(folder) / "other"
        subprocess.run(["git", "worktree", "add", "--quiet", "--detach", str(other), options.revision], cwd=here, check=True)
        try:
            packages = {other: [other, built(other, Path(folder) / "site")], here: [here]}
            for name in options.runs.split(","):
                first, second = (run(name, root, paths, Path(folder)) for root, paths in packages.items())
                lines = [key for key in first if not np.array_equal(first[key], second[key], equal_nan=True)]
                largest = max((float(np.abs(first[key] - second[key]).max()) for key in lines), default=0.0)
                told = f"DIFFERENT in {len(lines)}, by {largest:.2g} at most, of" if lines else "the same in all of"
                different += bool(lines)
                sys.stdout.write(f"{name}: {told} {len(first)} arrays\n")
                sys.stdout.flush()
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", str(other)], cwd=here, check=True)
    return 1 if different else 0


def built(root: Path, site: Path) -> Path:
    """Build a worktree's C++ plugin into a folder of its own; returns the folder."""
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-build-isolation", "--no-deps", "--target", str(site)]
    tools = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    subprocess.run([*pip, str(root / NATIVE)], check=True, env={**os.environ, "PATH": tools})
    return site


def run(name: str, root: Path, paths: list[Path], folder: Path) -> dict[str, np.ndarray]:
    """Run with the packages of a worktree; returns the arrays of its record."""
    out = folder / f"{root.name}-{name}"
    start = ["-m", "cpdeform"] if len(paths) == 1 else ["-c", WITHOUT_EDITABLE]
    command = [sys.executable, *start, "run", *RUNS[name], "--no-pictures", "--out", str(out)]
    if (root / TUNED).is_file():
        command += ["--strategy", "tuned"]
    path = os.pathsep.join(map(str, paths))
    environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    subprocess.run(command, cwd=folder, env=environment, check=True, capture_output=True)
    return arrays(out)


def arrays(record: Path) -> dict[str, np.ndarray]:
    """Every array that a plan consists of."""
    found = {}
    for path in sorted(record.glob("stage-*.h5")):
        with h5py.File(path, "r") as file:
            for name in (*DATASETS, *(f"state/{field}" for field in STATE)):
                found[f"{path.name}/{name}"] = file[name if name in file else OLD_NAMES[name]][()]
    return found


if __name__ == "__main__":
    sys.exit(main())
