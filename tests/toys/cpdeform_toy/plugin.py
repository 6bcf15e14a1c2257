"""Registers the toys as a third party would."""

from __future__ import annotations

from cpdeform.core.hookspecs import PluginSpec, hookimpl


@hookimpl
def cpdeform_simulators() -> list[PluginSpec]:
    return [
        PluginSpec("toy", "cpdeform_toy.simulator:SimulatorToy", "shifts the body"),
        PluginSpec("toy-missing", "cpdeform_toy.missing:Simulator", "needs what is not there", extra="cpdeform-toy[more]"),
    ]


@hookimpl
def cpdeform_ot_solvers() -> list[PluginSpec]:
    return [
        PluginSpec("toy", "cpdeform_toy.parts:OTSolverToy", "centres of mass"),
        PluginSpec("toy-exact", "cpdeform_toy.parts:OTSolverExactToy", "no priorities"),
    ]


@hookimpl
def cpdeform_placers() -> list[PluginSpec]:
    return [
        PluginSpec("toy", "cpdeform_toy.parts:PlacerToy", "in a row"),
        PluginSpec("toy-fixed", "cpdeform_toy.parts:PlacerFixedToy", "stays"),
    ]


@hookimpl
def cpdeform_tasks() -> list[PluginSpec]:
    return [PluginSpec("toy", "cpdeform_toy:missing.yaml", "a task whose file is missing")]


@hookimpl
def cpdeform_commands() -> list[PluginSpec]:
    return [
        PluginSpec("toy-greet", "cpdeform_toy.commands:greet", "Greet somebody."),
        PluginSpec("toy-lost", "cpdeform_toy.commands:lost", "Not there."),
        PluginSpec("tasks", "cpdeform_toy.commands:greet", "Not the built-in one."),
    ]
