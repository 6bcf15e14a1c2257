"""All checks of a task, and those of its tools that every run makes."""

from __future__ import annotations

import warnings

from cpdeform.core.errors import InputError
from cpdeform.core.sampling import sample_particles
from cpdeform.core.scene import Scene
from cpdeform.core.task import Task, limited_task
from cpdeform.run.checks.bodies import check_near_bodies
from cpdeform.run.checks.finding import Finding
from cpdeform.run.checks.goal_detail import check_goal_detail
from cpdeform.run.checks.goal_height import check_goal_below_floor, check_goal_floating, check_goal_inside_floor
from cpdeform.run.checks.goal_reach import check_goal_reach
from cpdeform.run.checks.goal_rest import check_goal_rest
from cpdeform.run.checks.goal_volume import check_goal_volume
from cpdeform.run.checks.tool_speed import check_tool_speed
from cpdeform.run.checks.tool_thickness import check_tool_thickness


def check_tools(scene: Scene) -> list[Finding]:
    """What the grid and the time step cannot make of a scene's tools."""
    return [*check_tool_thickness(scene), *check_tool_speed(scene)]


def check_task(task: Task) -> list[Finding]:
    """Everything about a task that would go wrong without a word, as it runs: with the limits on its tools in force.

    Args:
        task: The task.

    Returns:
        Findings, tools first, then bodies, then the goal.

    Raises:
        InputError: A limit or the goal's file cannot be used.
    """
    task = limited_task(task)
    clay, goal = sample_particles(task.scene), task.load_goal()
    floating = check_goal_floating(task.scene, goal)
    return [
        *check_tools(task.scene),
        *check_near_bodies(task.scene),
        *check_goal_volume(clay, goal),
        *floating,
        *([] if floating else check_goal_rest(task.scene, goal)),
        *check_goal_below_floor(task.scene, clay, goal),
        *check_goal_inside_floor(task.scene, clay, goal),
        *check_goal_reach(task, clay, goal),
        *check_goal_detail(task.scene, goal),
    ]


def warn_about_tools(scene: Scene) -> None:
    """Warn of tools that clay passes through, once each, before a run.

    Raises:
        InputError: A tool can never be felt.
    """
    for finding in check_tools(scene):
        if finding.severity == "error":
            raise InputError(
                finding.where, came=finding.what.rstrip("."), expected="a tool that covers nodes", remedy=finding.remedy
            )
        warnings.warn(str(finding), UserWarning, stacklevel=3)
