"""Tables of measurements, and the machine they were made on."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from cpdeform.core.machine import available_cores
from cpdeform.core.plugins import Registry
from cpdeform.run.record_files import environment


def markdown(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A Markdown table."""
    header = list(header)
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def cell(value: Any, pattern: str = "") -> str:
    """A value as text, formatted by a pattern such as ``.3g``; a dash for None."""
    return "-" if value is None else format(value, pattern)


def describe_machine(*, device: str = "cpu") -> dict[str, Any]:
    """Processor, cores, memory, system, and the graphics processor where `device` is one; no names of persons or hosts."""
    description: dict[str, Any] = {
        "processor": _processor(),
        "cores": available_cores(),
        "memory_gb": _memory_gigabytes(),
        "system": f"{platform.system()} {platform.machine()}",
    }
    if device.startswith("cuda"):
        import torch

        description["gpu"] = torch.cuda.get_device_name(device) if torch.cuda.is_available() else None
    return description


def machine_line(machine: Mapping[str, Any], versions: Mapping[str, str | None]) -> str:
    """Machine and versions in a line."""
    memory = "" if machine["memory_gb"] is None else f", {machine['memory_gb']:.0f} GB"
    gpu = f", {machine['gpu']}" if machine.get("gpu") else ""
    installed = ", ".join(f"{name} {version}" for name, version in versions.items() if version is not None)
    return f"{machine['processor']}, {machine['cores']} cores{memory}{gpu}, {machine['system']}; {installed}"


def describe_versions(registry: Registry) -> dict[str, str | None]:
    """Versions of Python, of the packages that make a result, and of every distribution that registers a plugin."""
    versions: dict[str, str | None] = dict(environment()["versions"])
    for registration in registry.registrations():
        name, _, version = registration.distribution.rpartition(" ")
        versions.setdefault(name, version)
    return versions


def _processor() -> str:
    """The processor's model, where the system tells."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _memory_gigabytes() -> float | None:
    """Memory of the machine, 1e9 bytes; None where the system does not tell."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    except (AttributeError, OSError, ValueError):
        return None
