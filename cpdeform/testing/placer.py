"""`check_placer`: does a placer keep the contract of `Placer` and `Proposal`?"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from cpdeform.core.errors import CpdeformError
from cpdeform.core.ot import OTResult
from cpdeform.core.placer import Candidate, Placer, Proposal, Stage
from cpdeform.core.priorities import DISPLACEMENT_EXPONENT
from cpdeform.core.scene import Scene
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.state import initial_state
from cpdeform.testing.report import Check, CheckItem, Finding, Report, Skip, choose, run_checks, violations

PEAK = (0.56, 0.11, 0.5)
"""Where the priorities of the test stage are largest, length units."""

ROUNDS = 100
"""The most rounds that a placer may ask for in a stage."""


@dataclasses.dataclass(frozen=True)
class PlacerBench:
    """A placer under test.

    Attributes:
        make: Makes a fresh placer.
        stage: A stage with one tool, which has room.
        placements: What a fresh placer proposes for it.
    """

    make: Callable[[], Placer]
    stage: Stage
    placements: list[Proposal]

    @property
    def stays(self) -> bool:
        """Whether the placer leaves the tools where they are."""
        return bool(self.placements) and all(_is_current(item, self.stage) for item in self.placements)


def _is_current(placement: Proposal, stage: Stage) -> bool:
    pose = stage.state.tool_pose[0]
    return placement.pose.shape == pose.shape and torch.allclose(placement.pose.to(pose), pose, atol=1e-7)


def make_stage(placer: Placer | None = None, *, dtype: torch.dtype = torch.float64, fixed: bool = False, **changes: Any) -> Stage:
    """A block on the floor whose priorities are largest near one end of its top, and a movable ball above it.

    Args:
        placer: The stage's transport is the solution of its problem, if it declares one; defaults to potentials.
        dtype: Type of the state.
        fixed: Whether a fixed ball comes before and after the movable one in the order of the tools.
        changes: Fields of the movable ball.
    """
    body = {"kind": "box", "position": (0.5, 0.06, 0.5), "widths": (0.16, 0.1, 0.12), "particle_count": 200}
    ball = {
        "kind": "Sphere",
        "radius": 0.03,
        "position": (0.5, 0.25, 0.5),
        "action_scale": (0.02, 0.02, 0.02),
        "lower_bound": (0.1, 0.0, 0.1),
        "upper_bound": (0.55, 0.9, 0.9),
        **changes,
    }
    posts = [{"kind": "Sphere", "radius": 0.03, "position": (0.2, 0.1, z)} for z in (0.4, 0.6)]
    tools = [posts[0], ball, posts[1]] if fixed else [ball]
    scene = Scene.model_validate({"bodies": [body], "tools": tools, "grid_size": 32})
    state = initial_state(scene, dtype=dtype)
    distance = (state.position[0] - torch.tensor(PEAK).to(state.position)).norm(dim=1)
    priorities = 0.02 * torch.exp(-((distance / 0.03) ** 2))
    priorities = priorities - priorities.median()
    goal = state.position[0] - torch.tensor([0.0, 0.01, 0.0]).to(state.position)
    problem = None if placer is None else placer.transport_problem
    displacements = None
    if problem is not None and problem.exponent == DISPLACEMENT_EXPONENT:
        displacements = priorities.clamp(min=0.0)[:, None] * torch.tensor([0.0, -1.0, 0.0]).to(priorities)
    transport = transport_of(priorities, displacements)
    return Stage(0, scene, state, goal, transport, torch.Generator().manual_seed(0))


def transport_of(priorities: Tensor, displacements: Tensor | None = None) -> OTResult:
    """A made-up solution whose priorities (N,) are these; of displacements (N, 3), if given, their lengths.

    Args:
        priorities: Potentials (N,), cost units; without meaning where displacements are given.
        displacements: Where the transport moves each particle, length units.
    """
    count = priorities.shape[0]
    gradient = torch.zeros(count, 3).to(priorities) if displacements is None else displacements * (-2.0 / count)
    exponent = 1 if displacements is None else 2
    value = torch.zeros((), dtype=priorities.dtype)
    return OTResult(value, priorities, torch.zeros_like(priorities), gradient, True, 1, 0.0, 5e-3, exponent=exponent)


def reseeded(stage: Stage, seed: int = 0, **changes: Any) -> Stage:
    """The stage with a fresh generator."""
    return dataclasses.replace(stage, generator=torch.Generator().manual_seed(seed), **changes)


def _gap(placement: Proposal, stage: Stage) -> float:
    """Least distance between a tool and a particle, negative inside."""
    points = stage.state.position[0].double()
    poses = placement.pose.double()
    return min(float(signed_distance(tool, poses[index], points).min()) for index, tool in enumerate(stage.scene.tools))


def check_found(bench: PlacerBench) -> Finding:
    """There is room for the tool, so there is a placement."""
    return Finding(0.0 if bench.placements else 1.0, 0.0)


def check_shapes(bench: PlacerBench) -> Finding:
    """Poses have shape (M, 8), are finite, and their quaternions have length 1; scores and labels have their types."""
    complaints = []
    particles, tools = bench.stage.scene.bodies[0].particle_count, len(bench.stage.scene.tools)
    for item in bench.placements:
        if tuple(item.pose.shape) != (tools, 8) or not bool(torch.isfinite(item.pose).all()):
            complaints.append(f"pose has shape {tuple(item.pose.shape)} instead of {(tools, 8)}, or is not finite")
        elif float((item.pose[:, 3:7].double().norm(dim=1) - 1.0).abs().max()) > 1e-5:
            complaints.append("a quaternion is not of length 1")
        if not isinstance(item.score, float):
            complaints.append(f"score is a {type(item.score).__name__}, not a float")
        if not isinstance(item.label, str) or not item.label:
            complaints.append("label is not a text")
        contact = item.contact_particle
        if contact is not None and not (type(contact) is int and 0 <= contact < particles):
            complaints.append(f"contact_particle is {contact!r}, neither None nor the index of a particle")
    return violations(sorted(set(complaints)))


def check_collision(bench: PlacerBench) -> Finding:
    """How deep a tool reaches into the body."""
    depths = []
    for dtype in (torch.float64, torch.float32):
        stage = make_stage(bench.make(), dtype=dtype)
        depths += [-_gap(item, stage) for item in bench.make().ask(stage)]
    return Finding(max(depths, default=0.0), 1e-6)


def check_bounds(bench: PlacerBench) -> Finding:
    """How far a tool is out of its bounds."""
    outside = [0.0]
    for seed in range(2):
        for item in bench.make().ask(reseeded(bench.stage, seed)):
            for index, tool in enumerate(bench.stage.scene.tools):
                position = item.pose[index, :3].double().cpu()
                lower, upper = (torch.tensor(bound, dtype=torch.float64) for bound in (tool.lower_bound, tool.upper_bound))
                outside.append(float(torch.maximum(lower - position, position - upper).max()))
    return Finding(max(outside), 1e-6)


def check_fixed_tools(bench: PlacerBench) -> Finding:
    """Tools that no action moves stay where they are."""
    stage = make_stage(bench.make(), fixed=True)
    current, moved = stage.state.tool_pose[0], [0.0]
    for item in bench.make().ask(stage):
        for index, tool in enumerate(stage.scene.tools):
            if not tool.movable:
                moved.append(float((item.pose[index].to(current) - current[index]).abs().max()))
    return Finding(max(moved), 1e-6)


def _difference(first: Sequence[Proposal], second: Sequence[Proposal]) -> float:
    if len(first) != len(second):
        return math.inf
    differences = [float((one.pose.double() - other.pose.double()).abs().max()) for one, other in zip(first, second, strict=True)]
    same = all(one.label == other.label for one, other in zip(first, second, strict=True))
    return max(differences, default=0.0) if same else math.inf


def check_reproducible(bench: PlacerBench) -> Finding:
    """The same generator seed gives the same placements, whatever was drawn from torch's own generator."""
    with torch.random.fork_rng(devices=[]):
        torch.rand(7)
        again = bench.make().ask(reseeded(bench.stage))
    return Finding(_difference(bench.placements, again), 0.0)


def check_stage_untouched(bench: PlacerBench) -> Finding:
    """State, goal and priorities are as they were."""
    stage = make_stage(bench.make())
    kept = [tensor.clone() for tensor in _tensors(stage)]
    bench.make().ask(stage)
    changed = [not torch.equal(now, before) for now, before in zip(_tensors(stage), kept, strict=True)]
    return Finding(float(sum(changed)), 0.0)


def _tensors(stage: Stage) -> tuple[Tensor, ...]:
    return (stage.state.position, stage.state.tool_pose, stage.goal, stage.priorities)


def check_impossible(bench: PlacerBench) -> Finding:
    """Where the bounds hold the tool inside the body, no placement is proposed."""
    if bench.stays:
        raise Skip("It leaves the tools where they are.")
    inside = (0.5, 0.06, 0.5)
    stage = make_stage(bench.make(), position=inside, lower_bound=inside, upper_bound=inside)
    return Finding(float(len(bench.make().ask(stage))), 0.0)


def check_priorities(bench: PlacerBench) -> Finding:
    """Without declared need, priorities of nan change nothing; with it, they are refused or placed nowhere."""
    nothing = torch.full_like(bench.stage.priorities, math.nan)
    stage = reseeded(bench.stage, transport=transport_of(nothing))
    if not bench.make().capabilities.needs_priorities:
        return Finding(_difference(bench.placements, bench.make().ask(stage)), 0.0)
    try:
        return Finding(float(len(bench.make().ask(stage))), 0.0, "placements by priorities of nan")
    except CpdeformError:
        return Finding(0.0, 0.0)


def check_rounds(bench: PlacerBench) -> Finding:
    """`tell` takes the results, answers with a bool, and ends after some rounds."""
    placer, stage = bench.make(), reseeded(bench.stage)
    actions = torch.zeros(2, stage.scene.action_size)
    for count in range(ROUNDS):
        results = [Candidate(item, 1.0 / (1 + index), actions) for index, item in enumerate(placer.ask(stage))]
        again = placer.tell(results)
        if not isinstance(again, bool):
            return Finding(1.0, 0.0, f"tell returned a {type(again).__name__}")
        if not again:
            return Finding(float(count + 1), float(ROUNDS))
    return Finding(math.inf, float(ROUNDS), "tell never returned False")


PLACER_CHECKS: tuple[CheckItem[PlacerBench], ...] = (
    CheckItem("finds a placement where there is room", check_found, "The body's top is free: propose at least one placement."),
    CheckItem("shapes and types of placements", check_shapes, "See the attributes of Proposal."),
    CheckItem(
        "no collision with the body", check_collision, "Test candidates with cpdeform.core.signed_distance against all particles."
    ),
    CheckItem("tools within their bounds", check_bounds, "Keep each position between the tool's lower_bound and upper_bound."),
    CheckItem("fixed tools stay", check_fixed_tools, "Start from stage.state.tool_pose and change movable tools only."),
    CheckItem("reproducible by the generator", check_reproducible, "Draw from stage.generator only; keep no state between stages."),
    CheckItem("stage is not modified", check_stage_untouched, "Clone tensors of the stage before writing to them."),
    CheckItem(
        "proposes nothing where nothing is possible", check_impossible, "Return an empty list; the run then says what to do."
    ),
    CheckItem(
        "needs_priorities is honoured", check_priorities, "Declare needs_priorities=True, or do not read them; never place by nan."
    ),
    CheckItem("rounds end", check_rounds, "Return False from tell once no round is wanted."),
)


def check_placer(placer: Placer | Callable[[], Placer], *, only: Sequence[str] = ()) -> Report:
    """Check a placer: collision, bounds, shapes, reproducibility, and what it declares.

    Args:
        placer: A placer, of which copies are tested, or what makes one without arguments, e.g. its class.
        only: Run only the checks of these names, or whose names contain these texts.

    Returns:
        What was found; `Report.raise_if_failed` turns failures into an error.

    Raises:
        InputError: No check has a name that `only` asks for.
    """
    items = choose(PLACER_CHECKS, only)
    name = type(placer).__name__ if isinstance(placer, Placer) else str(getattr(placer, "__name__", type(placer).__name__))
    try:
        make: Callable[[], Placer] = (lambda: copy.deepcopy(placer)) if isinstance(placer, Placer) else placer
        made = make()
        if not isinstance(made, Placer):
            raise TypeError(f"it is a {type(made).__name__}, not a cpdeform.core.placer.Placer")
        name = type(made).__name__
        stage = make_stage(made)
        bench = PlacerBench(make, stage, list(made.ask(reseeded(stage))))
    except Exception as error:
        advice = f"Building it and asking it for placements raised {type(error).__name__}: {error}"
        return Report(name, (Check("it places", "failed", advice=advice),))
    return run_checks(name, items, bench)
