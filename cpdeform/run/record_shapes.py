"""Shape files of tools and bodies from meshes: a record keeps its own copies."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from cpdeform.core.errors import InputError
from cpdeform.core.scene import Scene
from cpdeform.run.record_files import replacing


def keep_shapes(content: dict[str, Any], directory: Path) -> dict[str, Any]:
    """Copy the shape files of a dumped scene to a record.

    Args:
        content: The scene's fields, as `Scene.model_dump` gives them.
        directory: The record's.

    Returns:
        The fields with the names of the copies.

    Raises:
        InputError: A file cannot be read.
    """
    result = dict(content)
    for name in ("bodies", "tools"):
        result[name] = [_kept(item, directory) if "file" in item else item for item in content[name]]
    return result


def _kept(item: dict[str, Any], directory: Path) -> dict[str, Any]:
    data = _read(Path(item["file"]))
    name = f"shape-{hashlib.sha256(data).hexdigest()[:16]}.npz"
    with replacing(directory / name) as temporary:
        temporary.write_bytes(data)
    return {**item, "file": name}


def scene_content(scene: Scene) -> dict[str, Any]:
    """A scene's fields, with what shape files hold in place of where they lie: two scenes of one content are the same."""
    result = scene.model_dump()
    for name in ("bodies", "tools"):
        result[name] = [
            {**item, "file": hashlib.sha256(_read(Path(item["file"]))).hexdigest()} if "file" in item else item
            for item in result[name]
        ]
    return result


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        came = f"a file that cannot be read ({error.strerror or error})"
        raise InputError(f"shape file {path}", came=came, expected="a shape file") from error
