"""Registers the task files of this package."""

from __future__ import annotations

from cpdeform.core.hookspecs import PluginSpec, hookimpl

TASKS = (
    ("airplane", "airplane.yaml", "Squeeze a slab of clay into an airplane"),
    ("chair", "chair.yaml", "Press a block of clay into an armchair"),
    ("bottle", "bottle.yaml", "Squeeze a block of clay into a bottle"),
    ("star", "star.yaml", "Squeeze a slab of clay into a star"),
    ("move++", "move_plus_plus.yaml", "Push three cubes of clay to three other places"),
    ("rope++", "rope_plus_plus.yaml", "Bend a rope of clay into a zigzag"),
    ("writer++", "writer_plus_plus.yaml", "Write the letters ICLR into a board of clay"),
    ("pinch", "pinch.yaml", "Dent a block of clay in several places"),
    ("move", "move.yaml", "Carry a ball of clay through the air between two balls"),
    ("triple-move", "triple-move.yaml", "Carry three cubes of clay between three pairs of balls"),
    ("torus", "torus.yaml", "Press a ring into a board of clay"),
    ("rope", "rope.yaml", "Bend a rope of clay around a post"),
    ("rolling-pin", "rolling-pin.yaml", "Roll a board of clay out"),
    ("chopsticks", "chopsticks.yaml", "Lift a rod of clay with chopsticks"),
    ("assembly", "assembly.yaml", "Lay a ball of clay onto a block of clay"),
    ("table", "table.yaml", "Push a leg of a table of clay outwards"),
    ("writer", "writer.yaml", "Press a pen into a board of clay"),
)
"""Name, file and summary of each task."""


@hookimpl
def cpdeform_tasks() -> list[PluginSpec]:
    """Register the built-in tasks."""
    return [PluginSpec(name=name, target=f"cpdeform.tasks:{file}", summary=summary) for name, file, summary in TASKS]
