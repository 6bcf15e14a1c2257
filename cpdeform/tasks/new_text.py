"""The text of a new task file: what may be changed stands beside it."""

from __future__ import annotations

import json
from typing import Any

COMMENTS = {
    "position": "middle; y is up, clay rests at a height of 0.047",
    "widths": "edges",
    "particle_count": "more particles take finer shapes and more time",
    "lower_bound": "least x, y, z of its middle: upright it does not dip into the floor",
    "friction": "against the clay; 0 slips",
    "action_scale": "the most it moves in a step along x, y, z, and turns about them in radians",
    "half_extents": "half edges, without the rounding",
    "rounding": "radius of its edges",
    "file": "shape file, relative to this one",
    "radius": "radius",
    "height": "length between the centres of its ends",
}


def task_text(name: str, source: str, body: dict[str, Any], tools: list[dict[str, Any]], *, picture: bool) -> str:
    """A task file with comments.

    Args:
        name: Name of the task.
        source: Name of the file that the goal was made from.
        body: The clay.
        tools: The tools.
        picture: Whether the goal is a relief of a picture.
    """
    what = f"Press {source} into a board of clay" if picture else f"Shape clay into {source}"
    lines = [
        f"# Made by `cpdeform task new {name}`. Lengths are in edges of the domain, the cube from 0 to 1; times in seconds.",
        f"#   cpdeform task show {name}.yaml     draws it",
        f"#   cpdeform task check {name}.yaml    tells what would go wrong",
        f"#   cpdeform run {name}.yaml           makes it",
        f"name: {name}",
        f"summary: {json.dumps(what, ensure_ascii=False)}",
        f"goal: {name}-goal.npz            # particles of the shape wanted",
        "metric: wasserstein             # what the result is judged by; incremental_iou is the other one",
        "step_count: 10                  # steps of a stage in which tools act",
        "rest_steps: 5                   # steps after them in which they hold still: the shape is judged at rest",
        f"stage_count: {8 if picture else 6}                  # contacts that are looked for, one after the other",
        "scene:",
        "  ground_friction: 100.0        # 0 slips, 10 and above sticks",
        "  material:",
        "    youngs_modulus: 5000.0      # stiffness",
        "    poisson_ratio: 0.2",
        "    yield_stress: 50.0          # lower: softer clay, that also sags more",
        "  bodies:",
        *_entry(body),
        "  tools:",
    ]
    for tool in tools:
        lines += _entry(tool)
    return "\n".join(lines) + "\n"


def _entry(fields: dict[str, Any]) -> list[str]:
    lines: list[str] = []
    for key, value in fields.items():
        text = f"{key}: {json.dumps(value) if isinstance(value, (str, list)) else value}"
        mark = "    - " if not lines else "      "
        comment = COMMENTS.get(key)
        lines.append(f"{mark}{text:<56}  # {comment}" if comment else f"{mark}{text}")
    return lines
