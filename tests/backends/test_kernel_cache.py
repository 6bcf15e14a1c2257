"""Compiled kernels find a place, whatever the user's home is."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from cpdeform.backends import kernel_cache
from cpdeform.backends.kernel_cache import cache_folder, user_cache
from cpdeform.core.errors import InputError

START = {
    "taichi": """
import torch
from cpdeform.backends.taichi import runtime
runtime.require(torch.device("cpu"), 1)
""",
    "warp": """
import pathlib, warp
from cpdeform.backends.warp.simulator import _initialize_warp
_initialize_warp()
(pathlib.Path(warp.config.kernel_cache_dir) / "kernel").write_text("can be written")
""",
}


def test_a_folder_that_can_be_written_to_is_taken(tmp_path: Path) -> None:
    wanted = tmp_path / "a" / "b"
    assert cache_folder(wanted, setting="WARP_CACHE_PATH") == wanted
    assert list(wanted.iterdir()) == []


def test_below_a_file_a_temporary_folder_takes_its_place(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    with pytest.warns(UserWarning, match=r"file/cache cannot hold .*\(not a directory\).* Set WARP_CACHE_PATH") as caught:
        chosen = cache_folder(file / "cache", setting="WARP_CACHE_PATH")
    assert len(caught) == 1
    (chosen / "kernel").write_text("can be written")


def test_a_full_disk_counts_as_no_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage

    def nearly_full(path: Path) -> object:
        return SimpleNamespace(free=1 << 20) if path == tmp_path / "full" else usage(path)

    monkeypatch.setattr(kernel_cache.shutil, "disk_usage", nearly_full)
    with pytest.warns(UserWarning, match=r"1\.0 MB free"):
        assert cache_folder(tmp_path / "full", setting="WARP_CACHE_PATH") != tmp_path / "full"


def test_without_any_place_the_setting_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_cache, "ROOM", 1 << 60)
    with pytest.raises(InputError, match=r"^WARP_CACHE_PATH: got .*MB free.*Set WARP_CACHE_PATH or TMPDIR"):
        cache_folder(tmp_path, setting="WARP_CACHE_PATH")


def test_the_users_cache_needs_no_home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert user_cache() == tmp_path
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.delenv("HOME", raising=False)
    assert user_cache().is_absolute()


@pytest.mark.parametrize(("backend", "home"), [("taichi", None), ("warp", "/dev/null")])
def test_backends_start_without_a_home(backend: str, home: str | None) -> None:
    environment = {name: value for name, value in os.environ.items() if name not in ("HOME", "XDG_CACHE_HOME", "WARP_CACHE_PATH")}
    if home is not None:
        environment["HOME"] = home
    child = subprocess.run(
        [sys.executable, "-c", START[backend]], env=environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert child.returncode == 0, child.stderr
    assert ("Set WARP_CACHE_PATH" in child.stderr) == (backend == "warp")
