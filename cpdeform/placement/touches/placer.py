"""The placer that draws touches, many of them, and varies the best."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.ot import TransportProblem
from cpdeform.core.placer import Candidate, Placer, PlacerCapabilities, Proposal, Stage
from cpdeform.core.priorities import DISPLACEMENT_EXPONENT
from cpdeform.core.scene import Scene, Tool, ToolCapsule, ToolCylinder, ToolRollingPin, ToolSphere
from cpdeform.core.tool_surface import ToolSurfaces
from cpdeform.placement.grid import movable_tools
from cpdeform.placement.touches.draw import LONGEST_WAY, TouchDraw
from cpdeform.placement.touches.parking import parked
from cpdeform.placement.touches.together import label
from cpdeform.placement.touches.touch import Move, Room, Touch

BACK_SHARE = 0.2
"""Share of a touch's steps in which the tools back off at its end."""

BACK_SPEED = 0.5
"""How fast they do, in the speed of the touch."""

TRIES = 8
"""Touches drawn for each that is proposed, at most: there is not always room."""

TOLERANCE = 1e-2
"""Tolerance of the transport that touches are drawn by. On 10,000 particles of `star` the displacements are off by 3% on average
and come 14 times sooner than with 1e-4."""

ROLLING_RADIUS = 0.03
"""Length units that a rolling pin moves for each radian."""


@dataclasses.dataclass
class _Search:
    """Touches of a stage and what became of them."""

    stage: Stage
    room: Room
    draw: TouchDraw
    asked: list[Touch] = dataclasses.field(default_factory=list)
    tried: list[tuple[float, Touch, int | None]] = dataclasses.field(default_factory=list)
    parents: list[int | None] = dataclasses.field(default_factory=list)
    rounds: int = 0


class PlacerTouch(Placer):
    """Proposes many touches, to be screened by rollouts, then variations of those that did best.

    A touch is a placement and a first motion in a few numbers: a push, a press from above, a drag along a side, a pinch of two
    tools, a stroke of a ball or pen that is the only one, or several at once. Contacts are drawn with the probability of how far
    transport (cost |x - y|^2) wants to move a particle: the paper's priority as a prior. Tools begin free of the clay and above
    the floor, and back off at the end. Lengths follow from the clay's volume and from what the tools can do in a stage.

    Args:
        count: Random touches of a stage.
        variations: Touches of each round of variations.
        widths: How wide the variations of each round are drawn.
        parents: Best touches that are varied.

    Raises:
        InputError: An option is out of range.
    """

    capabilities = PlacerCapabilities(needs_priorities=True, max_tools=None)

    def __init__(self, *, count: int = 96, variations: int = 32, widths: tuple[float, ...] = (1.0, 0.5), parents: int = 8) -> None:
        for name, number in (("count", count), ("variations", variations), ("parents", parents)):
            if number < 1:
                raise InputError(name, came=str(number), expected="at least 1")
        if not all(0.0 < width < float("inf") for width in widths):
            raise InputError("widths", came=str(widths), expected="positive finite numbers")
        self.count, self.variations, self.widths, self.parents = count, variations, tuple(widths), parents
        self._search: _Search | None = None

    @property
    def transport_problem(self) -> TransportProblem:
        """Displacements are where the contacts are drawn by; drawing needs no three digits of them."""
        return TransportProblem(exponent=DISPLACEMENT_EXPONENT, tolerance=TOLERANCE)

    def expected_proposals(self, movable: int) -> tuple[int, int]:
        """See `Placer`; the rounds of variations are smaller."""
        rounds = 1 + len(self.widths)
        return (self.count + self.variations * len(self.widths)) // rounds, rounds

    def ask(self, stage: Stage) -> list[Proposal]:
        """Random touches in the first round of a stage, variations of the best in the others.

        Raises:
            CapabilityError: The scene has no movable tool.
        """
        if self._search is None or self._search.stage is not stage:
            self._search = _begin(stage)
        search = self._search
        if search.rounds == 0:
            return self._propose(search, self.count, None)
        best = sorted(search.tried, key=lambda item: item[0])[: self.parents]
        width = self.widths[search.rounds - 1]
        return self._propose(search, self.variations, [(touch, family) for _, touch, family in best], width)

    def tell(self, results: list[Candidate]) -> bool:
        """Remember what became of the touches; ask again as long as rounds of variations are left."""
        search = self._search
        if search is None:
            return False
        for result, touch, family in zip(results, search.asked, search.parents, strict=True):
            if np.isfinite(result.loss):
                search.tried.append((result.loss, touch, family))
        search.rounds += 1
        return search.rounds <= len(self.widths) and bool(search.tried)

    def _next(self, search: _Search, parents: list[tuple[Touch, int | None]] | None, width: float) -> tuple[Touch, int | None]:
        """A random touch, or a variation of one of the parents; and the particle that the first of its family was drawn at."""
        if parents is None:
            touch = search.draw.draw()
            return touch, search.room.nearest(touch.contact)
        parent, family = parents[int(search.draw.generator.integers(len(parents)))]
        return parent.varied(search.draw.generator, width), family

    def _propose(
        self, search: _Search, count: int, parents: list[tuple[Touch, int | None]] | None, width: float = 1.0
    ) -> list[Proposal]:
        """Touches that there is room for, up to a number."""
        proposals: list[Proposal] = []
        search.asked, search.parents = [], []
        for _ in range(TRIES * count):
            if len(proposals) == count:
                break
            touch, family = self._next(search, parents, width)
            placed = place(touch, search.room, steps=search.stage.step_count)
            if placed is not None:
                poses, actions = placed
                proposals.append(Proposal(poses, float("nan"), label(touch), family, actions))
                search.asked.append(touch)
                search.parents.append(family)
        return proposals


def place(touch: Touch, room: Room, *, steps: int) -> tuple[Tensor, Tensor] | None:
    """Poses (M, 8) of all tools and first actions (T, A) of a touch; None where there is no room for it.

    Args:
        touch: The touch.
        room: Clay and tools. Movable tools that take no part wait where they are in nobody's way.
        steps: Environment steps T.
    """
    moves = touch.moves(room)
    if moves is None or not room.apart(moves):
        return None
    poses = room.poses.clone()
    actions = torch.zeros(steps, room.scene.action_size)
    back = max(1, round(BACK_SHARE * steps))
    going = max(1, steps - back)
    offset = 0
    for index, tool in enumerate(room.scene.tools):
        if index in moves:
            poses[index] = moves[index].pose
            commands = _commands(tool, moves[index], going)
            actions[:going, offset : offset + 3] = commands
            # Back along the way by which it came to the clay.
            actions[going:, offset : offset + 3] = -BACK_SPEED * commands[0]
        offset += tool.action_size
    # A tool that cannot go where the touch would have it makes none.
    return (poses, actions) if bool(actions.any()) else None


def _commands(tool: Tool, move: Move, steps: int) -> Tensor:
    """Actions (steps, 3) that move a tool along its way, and then along the next one; each has its share of the steps."""
    if move.then is None or steps < 2:
        return _command(tool, move.way / steps).expand(steps, 3)
    first, second = (float(torch.linalg.vector_norm(way)) for way in (move.way, move.then))
    count = min(max(1, round(steps * first / (first + second))), steps - 1)
    legs = ((move.way, count), (move.then, steps - count))
    return torch.cat([_command(tool, way / number).expand(number, 3) for way, number in legs])


def _command(tool: Tool, step: Tensor) -> Tensor:
    """Actions (3,) that move a tool by a vector (3,), length units, in an environment step, as far as they can."""
    scale = torch.tensor(tool.action_scale[:3])
    if isinstance(tool, ToolRollingPin):
        # It rolls across its axis and lifts; it does not turn here.
        level = float(torch.linalg.vector_norm(step[[0, 2]])) * (1.0 if float(step[0] + step[2]) >= 0.0 else -1.0)
        step = torch.tensor([level / ROLLING_RADIUS, 0.0, float(step[1])])
    moved = torch.where(scale > 0.0, step.to(scale) / scale.clamp(min=1e-12), 0.0)
    # The fastest component sets the pace, so that a way that is too long keeps its direction.
    return moved / moved.abs().max().clamp(min=1.0)


def _begin(stage: Stage) -> _Search:
    movable = movable_tools(stage)
    particles = stage.state.position[0].detach()
    surfaces = ToolSurfaces(stage.scene)
    room = Room(
        scene=stage.scene,
        particles=particles,
        poses=parked(stage, movable),
        floors=surfaces.floors(float(particles[:, 1].min())),
        surfaces=surfaces,
    )
    seed = int(torch.randint(2**31, (1,), generator=stage.generator))
    edge = _clay_volume(stage.scene) ** (1.0 / 3.0)
    speed = max(max(stage.scene.tools[index].action_scale[:3]) for index in movable)
    draw = TouchDraw(
        particles=particles.double().cpu().numpy(),
        displacements=stage.displacements.detach().double().cpu().numpy(),
        tools=tuple(movable),
        reach=min(LONGEST_WAY * edge, (1.0 - BACK_SHARE) * speed * stage.step_count),
        generator=np.random.default_rng(seed),
        strokes=len(movable) == 1 and _draws_strokes(stage.scene.tools[movable[0]]),
    )
    return _Search(stage, room, draw)


def _draws_strokes(tool: Tool) -> bool:
    """Whether a tool is a ball or a pen and can come down and move along."""
    level, down, across = tool.action_scale[:3]
    return isinstance(tool, (ToolSphere, ToolCapsule, ToolCylinder)) and down > 0.0 and max(level, across) > 0.0


def _clay_volume(scene: Scene) -> float:
    return sum(body.volume for body in scene.bodies)
