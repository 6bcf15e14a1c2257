"""Checks before any work is done: do the parts fit together, and can the run begin where it is asked to?"""

from __future__ import annotations

import torch

from cpdeform.core.bounded import MOST_COUNT, MOST_SEED, MOST_STAGES
from cpdeform.core.errors import CapabilityError, InputError
from cpdeform.core.options import whole_number
from cpdeform.core.ot import OTSolver, TransportProblem
from cpdeform.core.placer import Placer
from cpdeform.core.scene import Scene
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.simulator import Simulator
from cpdeform.core.state import State
from cpdeform.core.task import Task

MAX_START_DEPTH = 1e-3
"""How deep a particle may lie inside a tool at the scene's start, length units."""


def check_parts(task: Task, simulator: Simulator, placer: Placer, ot_solver: OTSolver, *, problem: TransportProblem | None) -> None:
    """Hold the parts against each other's declared capabilities.

    Raises:
        CapabilityError: The parts do not fit together.
        InputError: No tool moves, or the simulator has another scene.
    """
    if not simulator.capabilities.differentiable:
        raise CapabilityError(f"{type(simulator).__name__} has no gradient; choose a differentiable simulator.")
    if problem is not None and problem.exponent == 1 and ot_solver.capabilities.potentials != "entropic":
        raise CapabilityError(
            f"{type(ot_solver).__name__} gives exact dual potentials, which are no transport priorities: where the shapes "
            "agree they are arbitrary. Choose a solver with entropic potentials, such as pot or geomloss."
        )
    movable = sum(tool.movable for tool in task.scene.tools)
    if movable == 0:
        raise InputError("scene.tools", came="no movable tool", expected="at least one with a positive action_scale")
    most = placer.capabilities.max_tools
    if most is not None and movable > most:
        raise CapabilityError(
            f"{type(placer).__name__} places at most {most} movable tools, the scene has {movable}; use the placer fixed."
        )
    if simulator.scene != task.scene:
        raise InputError("simulator", came="a simulator of another scene", expected="one built from task.scene")


def check_run(stages: int, first_stage: int, seed: int) -> None:
    """Raise `InputError` unless the numbers of stages and the seed make sense."""
    whole_number("stages", stages, least=1, most=MOST_STAGES)
    whole_number("first_stage", first_stage, least=0, most=MOST_COUNT)
    whole_number("seed", seed, least=0, most=MOST_SEED)


def check_start(task: Task, simulator: Simulator, state: State) -> State:
    """Check a given start and move it to the simulator's device and type.

    Raises:
        InputError: The state holds several worlds or does not fit the scene.
    """
    state = state.to(device=simulator.device, dtype=simulator.dtype)
    if state.batch_size != 1:
        raise InputError("state", came=f"{state.batch_size} worlds", expected="a single world")
    simulator.check_inputs(state, torch.zeros(1, task.rollout_steps, task.scene.action_size))
    return state


def check_tools_outside(scene: Scene, state: State) -> None:
    """Raise `InputError` where a tool begins inside the body, from where the first step would throw the clay apart.

    Args:
        scene: Its tools.
        state: The scene's start, a single world.
    """
    for index, tool in enumerate(scene.tools):
        depth = -float(signed_distance(tool, state.tool_pose[0, index], state.position[0]).min())
        if depth > MAX_START_DEPTH:
            raise InputError(
                f"scene.tools.{index}",
                came=f"a {tool.kind} that starts {depth:.3g} length units deep inside the body",
                expected=f"a tool outside of it (at most {MAX_START_DEPTH:g} deep)",
                remedy=f"Change its position, for example with --set scene.tools.{index}.position=[x,y,z].",
            )
