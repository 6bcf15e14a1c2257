"""Reads damaged inputs, in a process of its own: ``campaign.py KINDS COUNT SEED DIRECTORY``, with kinds such as ``goal,grid``.

The folder `tests` has to be on PYTHONPATH. The last line of the output is a JSON object with what was found of each kind. A case
that takes too long is interrupted.
"""

from __future__ import annotations

import json
import random
import resource
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import damage
import numpy as np
import yaml
from bases import make_bases, registry_with_toys

from cpdeform.cli.run import resolve_command
from cpdeform.core.errors import MESSAGE_LENGTH, CpdeformError, InputError
from cpdeform.core.goal import load_correspondence, load_goal, load_goal_grid
from cpdeform.core.task import list_variants, read_task
from cpdeform.run.configuration import RunConfiguration
from cpdeform.run.record import load_record
from cpdeform.run.resolve import resolve
from cpdeform.tasks import grid_import
from cpdeform.testing.golden_file import read_golden

CASE_SECONDS, CASE_WAITING_SECONDS = 10, 120
"""Seconds that a case may compute, and that it may take in all, on a machine that does other things, too."""


class TooLongError(BaseException):
    """A case that goes on and on; no error, so that nothing that handles errors catches it."""


class Campaign:
    """Damages copies of files and reads them.

    Args:
        directory: Where files are made.
        choice: Random numbers.
    """

    def __init__(self, directory: Path, choice: random.Random) -> None:
        self.choice = choice
        self.bases = directory / "bases"
        self.registry = registry_with_toys()
        self.place = directory / "case"

    def _copy(self, name: str) -> Path:
        for path in (self.place, self.place.with_suffix(".file")):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
        source = self.bases / name
        self.place.mkdir()
        if source.is_dir():
            shutil.copytree(source, self.place, dirs_exist_ok=True)
            return self.place
        return Path(shutil.copy(source, self.place))

    def _damage_arrays(self, path: Path) -> None:
        """Damage a file of arrays."""
        action = self.choice.random()
        if action < 0.05:
            damage.special_file(path, self.choice)
        elif action < 0.4:
            path.write_bytes(damage.change_bytes(path.read_bytes(), self.choice))
        elif path.suffix == ".npz":
            with np.load(path) as file:
                arrays = dict(file)
            damage.write_npz(path, arrays, self.choice)
        elif path.suffix == ".npy":
            changed = damage.npy(damage.change_array(np.load(path), self.choice))
            path.write_bytes(damage.fake_header(self.choice) if action < 0.6 else changed)
        else:
            damage.change_hdf5(path, self.choice)

    def goal(self) -> None:
        path = self._copy(self.choice.choice(("goal.npz", "plain.npz", "plain.npy", "goal.h5")))
        self._damage_arrays(path)
        scene = read_task(self.bases / "task" / "shift.yaml").scene
        readers: tuple[Callable[[], Any], ...] = (
            lambda: load_goal(path, scene=scene),
            lambda: load_goal_grid(path, scene=scene),
            lambda: load_correspondence(path),
        )
        each(readers)

    def grid(self) -> None:
        path = self._copy(self.choice.choice(("dense.npy", "sparse.npz", "dense.npz")))
        self._damage_arrays(path)
        task = read_task(self.bases / "task" / "shift.yaml")
        grids = grid_import.read_grids(path)
        name = grid_import.choose_grid(grids, None if self.choice.random() < 0.8 else "x", path=path)
        # The fit itself takes seconds and is no reading.
        grid_import.fit_particles = lambda counts, scene, *, count, seed: np.full((count, 3), 0.5)
        grid_import.import_grid(grids[name], task, name=name, path=None, particles=self.choice.choice((None, 5, 0, 2 * 10**9)))

    def record(self) -> None:
        directory = self._copy("record")
        path = directory / self.choice.choice(("run.json", "metrics.jsonl", "goal.h5", "stage-000.h5", "stage-001.h5"))
        if path.suffix == ".h5":
            self._damage_arrays(path)
        elif self.choice.random() < 0.1:
            damage.special_file(path, self.choice)
        elif path.name == "run.json" and self.choice.random() < 0.8:
            content = damage.change_value(json.loads(path.read_text()), self.choice)
            path.write_text(json.dumps(content))
        elif self.choice.random() < 0.5:
            lines = [json.loads(line) for line in path.read_text().splitlines()] if path.name == "metrics.jsonl" else [{"a": 1}]
            content = damage.change_value(lines, self.choice)
            path.write_text("\n".join(json.dumps(line) for line in content) + "\n")
        else:
            path.write_bytes(damage.change_bytes(path.read_bytes(), self.choice))
        record = load_record(directory)
        resumed = resolve({}, record=record, registry=self.registry)
        each(
            (
                resumed.task.load_goal,
                resumed.task.load_goal_grid,
                resumed.task.goal_corresponds,
                lambda: record.state,
            )
        )

    def golden(self) -> None:
        root = self._copy("recordings")
        path = root / "golden" / "torus-v2-seed0.npz"
        scenes, goals = root / "plasticinelab" / "scenes.json", root / "plasticinelab" / "target_grids.npz"
        chosen = self.choice.random()
        if chosen < 0.7:
            self._damage_arrays(path)
        elif chosen < 0.85:
            self._damage_arrays(goals)
        else:
            scenes.write_text(json.dumps(damage.change_value(json.loads(scenes.read_text()), self.choice)))
        read_golden(path)

    def task(self) -> None:
        path = self._copy("task") / "shift.yaml"
        content = yaml.safe_load(path.read_text())
        action = self.choice.random()
        if action < 0.6:
            path.write_text(yaml.safe_dump(damage.change_value(content, self.choice)))
        elif action < 0.7:
            key = self.choice.choice(list(content))
            path.write_text(path.read_text() + f"\n{key}: {damage.bomb(self.choice)}\n")
        elif action < 0.75:
            path.write_text(damage.bomb(self.choice))
        elif action < 0.78:
            damage.special_file(path, self.choice)
        else:
            path.write_bytes(damage.change_bytes(path.read_bytes(), self.choice))
        each((lambda: list_variants(path),))
        task = read_task(path)
        resolve({"task": str(path)}, registry=self.registry)
        each((task.load_goal, task.load_goal_grid, task.goal_corresponds))

    def setting(self) -> None:
        task = self.bases / "task" / "shift.yaml"
        asked = RunConfiguration(task=str(task)).model_dump(mode="json")
        asked["scene"] = yaml.safe_load(task.read_text())["scene"]
        place = [str(part) for part in self.choice.choice(damage.paths(asked)[1:])]
        if self.choice.random() < 0.2:
            place[self.choice.randrange(len(place))] = self.choice.choice(
                ("²", "x", "-1", "9" * 5000, "٣", "10", "", " ", "a.b" * 3000)
            )
        text = damage.bomb(self.choice) if self.choice.random() < 0.1 else damage.text_of(damage.value(self.choice), self.choice)
        setting = ".".join(place) + ("=" if self.choice.random() < 0.98 else "") + text
        changed = resolve_command({"task": str(task)} if place[0] != "task" else {}, [setting]).task
        each((changed.load_goal, changed.load_goal_grid))


def each(readers: tuple[Callable[[], Any], ...]) -> None:
    """Call all, whichever of them find something to complain of; then raise the first complaint."""
    complaint: CpdeformError | None = None
    for reader in readers:
        try:
            reader()
        except CpdeformError as error:
            complaint = complaint or error
    if complaint is not None:
        raise complaint


def stop(number: int, frame: Any) -> None:
    raise TooLongError


def run(kind: str, count: int, seed: int, directory: Path) -> dict[str, Any]:
    """Read `count` damaged inputs of a kind."""
    campaign = Campaign(directory, random.Random(f"{kind} {seed}"))
    base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found: dict[str, Any] = {"kind": kind, "count": count, "accepted": 0, "refused": 0, "faults": [], "longest": 0.0}
    for index in range(count):
        began = time.monotonic()
        sys.stderr.write(f"{kind} {index}\n")
        signal.setitimer(signal.ITIMER_PROF, CASE_SECONDS)
        signal.alarm(CASE_WAITING_SECONDS)
        try:
            getattr(campaign, kind)()
            found["accepted"] += 1
        except CpdeformError as error:
            found["refused"] += 1
            if isinstance(error, InputError) and (len(str(error)) > MESSAGE_LENGTH or "\n" in str(error)):
                found["faults"].append(f"{index}: a message of {len(str(error))} characters")
        except (Exception, TooLongError, SystemExit):
            found["faults"].append(f"{index}: {traceback.format_exc()[-1500:]}")
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.alarm(0)
        found["longest"] = max(found["longest"], time.monotonic() - began)
    found["megabytes"] = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - base) / 1024
    return found


def main(kinds: str, count: int, seed: int, directory: Path) -> list[dict[str, Any]]:
    """Read `count` damaged inputs of each kind."""
    make_bases(directory / "bases")
    for number in (signal.SIGALRM, signal.SIGPROF):
        signal.signal(number, stop)
    return [run(kind, count, seed, directory) for kind in kinds.split(",")]


if __name__ == "__main__":
    sys.stdout.write(json.dumps(main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]))) + "\n")
