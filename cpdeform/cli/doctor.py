"""`cpdeform doctor`: what is installed, what would be taken and why, and what is in the way."""

from __future__ import annotations

import json
import os
import shutil
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from cpdeform.core.plugins import Registry

PARTS = {"simulator": "--backend", "ot_solver": "--ot"}
NO_COMPILER = "none: the native simulator and solver cannot be built; Warp and GeomLoss take their place"
COMPILERS = ("c++", "g++", "clang++", "cl")
TEXT_INDENT = 10
"""Where the text begins after ``system``, ``versions`` and the like."""
EXTRAS = {"pictures": "report", "meshes": "meshes"}
"""What needs packages of an extra."""


def doctor(as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False) -> None:
    """Tell what is installed, which simulator and solver would be taken and why, compiler, GPU, cache folders.

    Exit code 0: runs can be made; 1: something that every run needs is missing.
    """
    from cpdeform.core.machine import available_cores
    from cpdeform.core.plugins import load_registry
    from cpdeform.run.record_files import environment

    registry = load_registry()
    parts = {kind: [_part(registry, kind, item.spec.name) for item in registry.registrations(kind)] for kind in PARTS}
    chosen = {kind: _chosen(registry, kind) for kind in PARTS}
    found = {
        **environment(),
        "cores_at_hand": available_cores(),
        "parts": parts,
        "auto": chosen,
        "failures": [f"{failure.entry_point} [{failure.distribution}]: {failure.reason}" for failure in registry.failures],
        "compiler": next((path for name in (os.environ.get("CXX"), *COMPILERS) if name and (path := shutil.which(name))), None),
        "cuda": _cuda(),
        "pictures": _installed("matplotlib", "skimage", "imageio", "imageio_ffmpeg"),
        "meshes": _installed("trimesh", "igl", "PIL"),
        "caches": _caches(),
    }
    typer.echo(json.dumps(found) if as_json else _text(found))
    if any(choice["name"] is None for choice in chosen.values()):
        raise typer.Exit(1)


def _part(registry: Registry, kind: str, name: str) -> dict[str, Any]:
    """Whether a part can be imported, and for which devices "auto" may take it."""
    from cpdeform.core.errors import CpdeformError

    try:
        registry.load(kind, name)
        reason = ""
    except CpdeformError as error:
        reason = str(error)
    return {"name": name, "available": not reason, "reason": reason, "rank": dict(registry.find(kind, name).spec.automatic)}


def _chosen(registry: Registry, kind: str) -> dict[str, Any]:
    """What "auto" stands for on the CPU."""
    from cpdeform.core.errors import CpdeformError
    from cpdeform.core.plugins import AUTO

    try:
        return {"name": registry.resolve(kind, AUTO, device="cpu"), "reason": "the one of the highest rank that can be imported"}
    except CpdeformError as error:
        return {"name": None, "reason": str(error)}


def _cuda() -> list[str]:
    """Names of the GPUs that torch sees."""
    import torch

    return [torch.cuda.get_device_name(number) for number in range(torch.cuda.device_count())] if torch.cuda.is_available() else []


def _installed(*names: str) -> dict[str, bool]:
    """Which of some packages are there."""
    from importlib.util import find_spec

    return {name: find_spec(name) is not None for name in names}


def _caches() -> dict[str, str]:
    """Folders that simulators keep compiled kernels in."""
    from cpdeform.backends.kernel_cache import user_cache

    warp = os.environ.get("WARP_CACHE_PATH") or str(user_cache() / "warp")
    return {"warp": warp, "taichi": str(user_cache() / "taichi")}


def _text(found: dict[str, Any]) -> str:
    from cpdeform.cli.wrapped import wrapped
    from cpdeform.core.wording import counted

    versions = ", ".join(f"{name} {version or 'missing'}" for name, version in found["versions"].items())
    lines = [f"system    {found['platform']}, {counted(found['cores_at_hand'], 'core')} at hand", f"versions  {versions}"]
    for kind, flag in PARTS.items():
        choice = found["auto"][kind]
        lines.append(f"{kind}: auto takes {choice['name'] or 'nothing'} on the CPU ({choice['reason']})")
        for part in found["parts"][kind]:
            rank = ", ".join(f"{device} {number}" for device, number in part["rank"].items()) or "never chosen by auto"
            lines.append(
                f"  {flag} {part['name']:<10} {'rank ' + rank if part['available'] else 'NOT AVAILABLE: ' + part['reason']}"
            )
    lines += [f"failed to load: {failure}" for failure in found["failures"]]
    lines += [
        f"compiler  {found['compiler'] or NO_COMPILER}",
        f"GPU       {', '.join(found['cuda']) or 'none that torch sees'}",
        *(f"{what:<9} {_missing(found[what], extra)}" for what, extra in EXTRAS.items()),
        *(f"cache     {name}: {folder}" for name, folder in found["caches"].items()),
    ]
    return "\n".join(wrapped(line, indent=TEXT_INDENT) for line in lines)


def _missing(packages: dict[str, bool], extra: str) -> str:
    """What is missing, and the command that installs it."""
    missing = [name for name, there in packages.items() if not there]
    return f'missing: {", ".join(missing)}; pip install "cpdeform[{extra}]"' if missing else "all that they need is there"
