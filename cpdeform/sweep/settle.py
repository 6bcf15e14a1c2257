"""The end of an attempt: what it has made takes its place."""

from __future__ import annotations

import contextlib
import os
import shutil
from pathlib import Path


def settle(attempt: Path, place: Path) -> bool:
    """Move what came of a job to where it belongs, in place of an earlier record; do nothing if nothing came of it.

    Args:
        attempt: Directory of the attempt.
        place: Where it belongs, on the same file system. Files there that are no record's stay.

    Returns:
        Whether the attempt was still there: a worker that goes on from where this one was takes its directory.
    """
    from cpdeform.run.record_files import own_files

    if not attempt.is_dir():
        return False
    if not any(attempt.iterdir()):
        shutil.rmtree(attempt, ignore_errors=True)
        return True
    place.parent.mkdir(parents=True, exist_ok=True)
    old = attempt.with_name(f".old-{os.urandom(6).hex()}")
    with contextlib.suppress(FileNotFoundError):
        place.rename(old)
        for path in set(old.iterdir()) - set(own_files(old)):
            if not (attempt / path.name).exists():
                path.rename(attempt / path.name)
    attempt.rename(place)
    shutil.rmtree(old, ignore_errors=True)
    return True
