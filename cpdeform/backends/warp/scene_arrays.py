"""The scene as the kernels read it: constants, tools and material on a device."""

from __future__ import annotations

import dataclasses
from typing import Any

import warp as wp

from cpdeform.backends.scene_numbers import material_numbers, scene_numbers, tool_grids, tool_numbers
from cpdeform.backends.warp.kernels_types import build_types
from cpdeform.core.scene import Scene


def make_parameters(scene: Scene, real: Any, device: str) -> Any:
    """The constants of a scene as the struct `Parameters`."""
    types = build_types(real)
    parameters = types.Parameters()
    for name, value in dataclasses.asdict(scene_numbers(scene)).items():
        setattr(parameters, name, types.vec3(*value) if isinstance(value, tuple) else value)
    parameters.grids = wp.array(tool_grids(scene), dtype=real, device=device)
    return parameters


def make_tools(scene: Scene, real: Any, device: str) -> Any:
    """The tools of a scene as an array of the struct `Tool`; one unused entry where there is none."""
    types = build_types(real)
    vectors = {3: types.vec3, 4: types.vec4, 7: types.vec7}
    tools = []
    for numbers in tool_numbers(scene):
        tool = types.Tool()
        for name, value in dataclasses.asdict(numbers).items():
            setattr(tool, name, vectors[len(value)](*value) if isinstance(value, tuple) else value)
        tools.append(tool)
    return wp.array(tools or [types.Tool()], dtype=types.Tool, device=device)


def make_constants(scene: Scene, real: Any, device: str) -> Any:
    """Shear modulus, Lame lambda and yield stress (N,) of each particle."""
    return wp.array(material_numbers(scene), dtype=build_types(real).vec3, device=device)
