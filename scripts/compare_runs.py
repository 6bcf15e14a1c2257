"""Do seeded runs give the same numbers, bit for bit, as another revision of this repository did?

    .venv/bin/python scripts/compare_runs.py f60e65c

Both revisions run in processes of their own on this machine, one thread each, the other one from a worktree in a temporary
folder; the compiled extension is this checkout's. Runs before format 2 of the record had their settings in the task files; the
strategy ``tuned`` has them now.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import h5py

RUNS = {
    "writer": ("writer", "--iterations", "5"),
    "star": ("star", "--stages", "2", "--iterations", "4"),
    "rope++": ("rope++", "--stages", "1", "--iterations", "4"),
    "table-v1": ("table-v1", "--iterations", "4"),
    "move-v1": ("move-v1", "--iterations", "4"),
    "pinch": ("pinch", "--stages", "1", "--iterations", "4"),
}
DATASETS = ("actions", "positions", "manipulator_poses", "placements/actions", "placements/loss", "placements/pose")
STATE = ("position", "velocity", "affine", "elastic_strain", "manipulator_pose")
TUNED = "cpdeform/experiments/tuned.yaml"


def main() -> int:
    """Run both revisions and compare; exit code 1 where a number differs."""
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
            for name in options.runs.split(","):
                digests = [run(name, root, Path(folder) / f"{number}-{name}") for number, root in enumerate((other, here))]
                same = digests[0] == digests[1]
                different += not same
                sys.stdout.write(f"{name}: {'the same' if same else 'DIFFERENT'} in {len(digests[1])} arrays\n")
                sys.stdout.flush()
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", str(other)], cwd=here, check=True)
    return 1 if different else 0


def run(name: str, root: Path, out: Path) -> dict[str, str]:
    """Run with the package of a worktree; returns a digest of each array of its record."""
    command = [sys.executable, "-m", "cpdeform", "run", *RUNS[name], "--no-pictures", "--out", str(out)]
    if (root / TUNED).is_file():
        command += ["--strategy", "tuned"]
    environment = {**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    subprocess.run(command, cwd=out.parent, env=environment, check=True, capture_output=True)
    return digests(out)


def digests(record: Path) -> dict[str, str]:
    """A digest of every array that a plan consists of."""
    found = {}
    for path in sorted(record.glob("stage-*.h5")):
        with h5py.File(path, "r") as file:
            for name in (*DATASETS, *(f"state/{field}" for field in STATE)):
                found[f"{path.name}/{name}"] = hashlib.sha256(file[name][()].tobytes()).hexdigest()
    return found


if __name__ == "__main__":
    sys.exit(main())
