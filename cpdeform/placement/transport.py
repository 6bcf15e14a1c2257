"""The paper's placer: the tools go where the body has to move most."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.placer import LEAST_GAIN, Placement, PlacementResult, Placer, PlacerCapabilities, Stage
from cpdeform.core.scene import Manipulator
from cpdeform.core.signed_distance import signed_distance
from cpdeform.placement.grasp import TOOLS_PER_GRASP, Cost, GraspSearch
from cpdeform.placement.grid import GridOptions, ToolGrid, movable_manipulators
from cpdeform.placement.pose import APART, CURRENT, DIRECT, GRASP_DIRECTIONS, PUSH, check_poses
from cpdeform.placement.priorities import Exploration
from cpdeform.placement.push import Push, PushSearch
from cpdeform.placement.tool import tool_half_extents
from cpdeform.placement.touch import reduce_distances

EXPLORED_RADIUS = 2.0
"""Distance from a contact point within which particles count as explored, in half widths of the narrowest tool."""

MOST_CONTACTS = 60
"""Contact points of a stage after which no further one is looked for."""

PUSH_SPACING = 0.5
"""Distance between the contact points of pushes, in that of other contact points: where exactly a push begins matters."""

CURRENT_DEPTH = 1e-3
"""How deep a tool that stays where it is may reach into the body, length units."""


class PlacerTransport(Placer):
    """Places the tools around the particle of largest transport priority, free of collision, where their score is highest.

    With priorities f_i and the distance d_i(x) of particle i to the surface of the tool at position x, the score is
    1/N sum_i f_i / (d_i(x)^2 + 1). A single tool is placed on a grid of positions x around that particle and then on finer
    grids around the best. Several tools are placed in pairs, once per pose: of the positions that face the particle along the
    pose's direction and touch, the first tool takes that of the best score; the second one goes to the nearest position free
    of collision on the body's other side. Boxes turn to press their broadest face. Of several bodies that of the highest mean
    priority comes first, and further pairs take the next ones. The floor is no obstacle to tools, as in PlasticineLab.

    Distances count in units of `distance_scale`. With a scale of 1, the domain's edge, d^2 << 1 for every particle: the score is
    flat, far particles' small priorities outweigh the tool's neighbourhood, and on a board with one stroke the tool lands in a
    corner of the grid. The default, a tool's radius, makes the neighbourhood count. The score depends on the gauge of the
    priorities, which is fixed by `OTResult`: zero weighted median.

    Where no candidate of a stage lowers the loss by `least_gain`, the particles around the contact point count as explored, and
    the next body or the next priority is tried; they stay explored in the following stages until one of these gains more
    (`Stage.failed_contacts`).

    Args:
        grid_size: Positions along each axis of a single tool's grids (the paper: 20).
        refinements: Number of finer grids. A tool acts on the clay only within about 0.0035 of its surface, less than the
            first grid's spacing: without refinement the plan's gradient may be zero.
        clearance: Least distance between a tool and any particle, length units.
        margin: How far beyond touching the particle a single tool's first grid reaches, length units; half of the tool's
            smallest half extent where absent.
        distance_scale: Length that the score measures distances in; 1 is the paper's formula to the letter.
        max_gap: Largest distance between a single tool and the body beyond `clearance`, length units. The paper leaves this to
            the score, which pushes the tool off the body where priorities are negative; None does the same.
        poses: Candidates: ``"left-right"``, ``"top-bottom"``, ``"front-back"`` (along x, y, z), ``"direct"`` (a single tool,
            its rotation kept), ``"apart"`` (every tool at a contact point of its own), ``"push"`` (every tool behind clay of
            its own, on the side that it has to leave, see `PushSearch`; needs displacements as priorities) and ``"current"``
            (tools stay, unless they reach into the body). Where absent ``"direct"`` for one movable tool, the first three for
            several.
        attempts: The most rounds of candidates in a stage.
        contacts: Contact points proposed in one round.
        least_gain: Relative gain from which a stage counts as a success.

    Raises:
        InputError: An option is out of range.

    References:
        Li et al., "Contact Points Discovery for Soft-Body Manipulations with Differentiable Physics", ICLR 2022, sections
        "Direct Single Manipulator Placement" and "Multiple Manipulator Placement With Heuristic".
    """

    capabilities = PlacerCapabilities(needs_priorities=True, max_manipulators=None)

    def __init__(
        self,
        *,
        grid_size: int = 20,
        refinements: int = 2,
        clearance: float = 0.0,
        margin: float | None = None,
        distance_scale: float = 0.03,
        max_gap: float | None = 0.0005,
        poses: Sequence[str] | None = None,
        attempts: int = 3,
        contacts: int = 1,
        least_gain: float = LEAST_GAIN,
    ) -> None:
        if not 0.0 < distance_scale < float("inf"):
            raise InputError("distance_scale", came=str(distance_scale), expected="a finite number above 0")
        for name, number in (("attempts", attempts), ("contacts", contacts)):
            if number < 1:
                raise InputError(name, came=str(number), expected="at least 1")
        if not 0.0 <= least_gain < 1.0:
            raise InputError("least_gain", came=str(least_gain), expected="a share of at least 0 and below 1")
        self.options = GridOptions(
            grid_size=grid_size, refinements=refinements, clearance=clearance, margin=margin, max_gap=max_gap
        )
        self.distance_scale, self.attempts, self.contacts = distance_scale, attempts, contacts
        self.poses, self.least_gain = check_poses(poses), least_gain
        self._exploration: Exploration | None = None

    def ask(self, stage: Stage) -> list[Placement]:
        """Propose a placement per pose, around contact points that were not proposed before in this stage.

        Returns:
            Placements; none where every position collides, is out of the tools' bounds or does not touch.

        Raises:
            CapabilityError: The scene has no movable tool.
            InputError: The priorities are not finite, or do not fit the particles.
        """
        movable = movable_manipulators(stage)
        exploration = self._exploration
        if exploration is None or exploration.stage is not stage:
            narrowest = min(_half_width(stage.scene.manipulators[index]) for index in movable)
            exploration = self._exploration = Exploration.begin(stage, radius=EXPLORED_RADIUS * narrowest)
        placements: list[Placement] = []
        reached = 0
        # A contact point that no tool can reach does not count as an attempt.
        while reached < self.contacts and exploration.attempt < MOST_CONTACTS:
            # What depends on no contact point is proposed once.
            found = self._round(exploration, movable, first=exploration.attempt == 0)
            exploration.attempt += 1
            reached += any(placement.contact_particle is not None for placement in found)
            placements += found
        exploration.rounds += 1
        return placements

    def tell(self, results: list[PlacementResult]) -> bool:
        """Ask again as long as nothing lowered the loss and attempts are left."""
        exploration = self._exploration
        if exploration is None:
            return False
        enough = (1.0 - self.least_gain) * exploration.stage.loss
        gained = any(result.loss < enough for result in results)
        return not gained and exploration.rounds < self.attempts

    def _round(self, exploration: Exploration, movable: Sequence[int], *, first: bool) -> list[Placement]:
        """Candidates around the next contact point, whose surroundings then count as explored."""
        stage, ranking = exploration.stage, exploration.ranking
        poses = self.poses or ((DIRECT,) if len(movable) == 1 else tuple(GRASP_DIRECTIONS))
        if poses == (PUSH,):
            found = self._pushes(exploration, movable)
            # It has looked at all particles that are left.
            exploration.attempt = exploration.attempt if found else MOST_CONTACTS
            return found
        contact = exploration.contact(ranking[exploration.attempt % len(ranking)])
        if contact is None:
            return []
        candidates: list[Placement | None] = []
        for pose in poses:
            if pose == PUSH:
                candidates += self._pushes(exploration, movable)
            elif pose == CURRENT:
                candidates.append(_stay(stage) if first else None)
            elif pose in GRASP_DIRECTIONS:
                candidates.append(self._grasps(exploration, movable, pose, contact))
            elif pose == APART or len(movable) > 1:
                candidates.append(self._apart(exploration, movable, pose, contact))
            else:
                candidates.append(self._direct(exploration, movable[0], contact))
        exploration.explore(contact)
        return [placement for placement in candidates if placement is not None]

    def _cost(self, exploration: Exploration) -> Cost:
        """What the score loses, for tools at given positions."""
        particles, priorities = exploration.stage.state.position[0].detach(), exploration.priorities
        weighted = priorities != 0.0
        points, weights = particles[weighted], priorities[weighted] / priorities.shape[0]

        def cost(manipulator: Manipulator, quaternion: Tensor, positions: Tensor) -> Tensor:
            return reduce_distances(
                manipulator, quaternion, positions, points, lambda distance: score_loss(distance, weights, self.distance_scale)
            )

        return cost

    def _score(self, exploration: Exploration, cost: float) -> float:
        return float(exploration.priorities.double().mean()) - cost

    def _direct(self, exploration: Exploration, index: int, contact: int) -> Placement | None:
        """One tool, its rotation kept, wherever around the particle its score is best."""
        grid = ToolGrid(exploration.stage, index, self.options)
        found = self._search(exploration, grid, contact)
        if found is None:
            return None
        pose, cost = found
        return Placement(pose=pose, score=self._score(exploration, cost), label=DIRECT, contact_particle=contact)

    def _search(self, exploration: Exploration, grid: ToolGrid, contact: int) -> tuple[Tensor, float] | None:
        """Poses (M, 8) with the grid's tool at its best position, and the cost there."""
        cost, weights = self._cost(exploration), exploration.priorities / exploration.priorities.shape[0]
        noise = 4.0 * torch.finfo(weights.dtype).eps * float(weights.abs().sum()) * float(grid.half_extents.max()) ** 2
        found = grid.search(
            grid.particles[contact], lambda positions: cost(grid.manipulator, grid.quaternion, positions), tolerance=noise
        )
        return None if found is None else (grid.pose_at(found.position), found.cost)

    def _grasps(self, exploration: Exploration, movable: Sequence[int], pose: str, contact: int) -> Placement | None:
        """All tools in pairs that face each other along the pose's direction, each pair around a contact point of its own."""
        stage = exploration.stage
        particles = stage.state.position[0].detach()
        search = GraspSearch(manipulators=stage.scene.manipulators, particles=particles, clearance=self.options.clearance)
        direction = torch.tensor(GRASP_DIRECTIONS[pose]).to(particles)
        poses, cost = stage.state.manipulator_pose[0].detach().clone(), self._cost(exploration)
        placed = [index for index in range(len(stage.scene.manipulators)) if index not in movable]
        pairs = [movable[start : start + TOOLS_PER_GRASP] for start in range(0, len(movable), TOOLS_PER_GRASP)]
        costs = []
        for tools, point in zip(pairs, self._contacts(exploration, contact), strict=False):
            grasp = search.find(poses, tools, placed, particles[point], direction, cost)
            if grasp is None:
                return None
            poses, placed = grasp.poses, [*placed, *tools]
            costs.append(grasp.cost)
        if len(costs) < len(pairs):
            return None
        score = self._score(exploration, sum(costs) / len(costs))
        return Placement(pose=poses, score=score, label=pose, contact_particle=contact)

    def _apart(self, exploration: Exploration, movable: Sequence[int], label: str, contact: int) -> Placement | None:
        """Every tool as a single one, at a contact point of its own."""
        stage = exploration.stage
        poses, costs = stage.state.manipulator_pose[0].detach().clone(), []
        placed = [index for index in range(len(stage.scene.manipulators)) if index not in movable]
        points = self._contacts(exploration, contact)
        for index in movable:
            found = None
            while found is None:
                point = next(points, None)
                if point is None:
                    return None
                grid = ToolGrid(stage, index, self.options, poses=poses, obstacles=placed)
                found = self._search(exploration, grid, point)
            poses, placed = found[0], [*placed, index]
            costs.append(found[1])
        score = self._score(exploration, sum(costs) / len(costs))
        return Placement(pose=poses, score=score, label=label, contact_particle=contact)

    def _pushes(self, exploration: Exploration, movable: Sequence[int]) -> list[Placement]:
        """Every tool behind clay of its own, which then counts as explored; empty where there is no room for all of them."""
        stage = exploration.stage
        if stage.displacements is None:
            raise InputError(
                "poses",
                came=f'"{PUSH}" without displacements',
                expected="priorities from displacements",
                remedy="Set them with --set priorities.kind=displacement.",
            )
        search = PushSearch(
            manipulators=stage.scene.manipulators,
            particles=stage.state.position[0].detach(),
            displacements=stage.displacements,
            distance_scale=self.distance_scale,
            clearance=self.options.clearance,
        )
        poses = stage.state.manipulator_pose[0].detach().clone()
        placed = [index for index in range(len(stage.scene.manipulators)) if index not in movable]
        pushes: list[Push] = []
        taken = exploration.explored.clone()
        for index in movable:
            push, pose = search.next(~taken), None
            while push is not None and pose is None:
                pose = search.place(push, poses, index, placed)
                taken |= exploration.near(push.contact, exploration.radius)
                push = push if pose is not None else search.next(~taken)
            if push is None or pose is None:
                return []
            search.take_off(push)
            poses[index], placed, pushes = pose, [*placed, index], [*pushes, push]
        for push in pushes:
            exploration.explore(push.contact, radius=PUSH_SPACING * exploration.radius)
        score = sum(push.score for push in pushes) / len(pushes)
        return [Placement(pose=poses, score=score, label=PUSH, contact_particle=pushes[0].contact)]

    def _contacts(self, exploration: Exploration, contact: int) -> Iterator[int]:
        """The contact point, then that of the next body in the ranking and so on; on each body away from those before."""
        ranking = exploration.ranking
        widest = max(_half_width(tool, widest=True) for tool in exploration.stage.scene.manipulators if tool.movable)
        taken = exploration.near(contact, 2.0 * widest)
        yield contact
        number, empty = ranking.index(int(exploration.bodies[contact])), 0
        while empty < len(ranking):
            number += 1
            following = exploration.contact(ranking[number % len(ranking)], excluded=taken)
            empty = empty + 1 if following is None else 0
            if following is not None:
                taken |= exploration.near(following, 2.0 * widest)
                yield following


def _stay(stage: Stage) -> Placement | None:
    """The tools where they are, unless one reaches into the body."""
    poses = stage.state.manipulator_pose[0].detach()
    for manipulator, pose in zip(stage.scene.manipulators, poses, strict=True):
        if manipulator.movable and float(signed_distance(manipulator, pose, stage.state.position[0]).min()) < -CURRENT_DEPTH:
            return None
    return Placement(pose=poses.clone(), score=float("nan"), label=CURRENT)


def _half_width(manipulator: Manipulator, *, widest: bool = False) -> float:
    """Half of a tool's smallest or largest width, length units."""
    half = tool_half_extents(manipulator, torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    return float(half.max() if widest else half.min())


def score_loss(distance: Tensor, weights: Tensor, distance_scale: float = 1.0) -> Tensor:
    """What the score loses against a tool that touches every particle: sum_i w_i - sum_i w_i / (d_i^2 + 1).

    The score itself differs between positions only in its last digits, since d_i^2 is small beside 1; this form keeps them.

    Args:
        distance: Distances (..., P), length units.
        weights: Priorities over the number of particles (P,).
        distance_scale: Length that distances are measured in.

    Returns:
        Lost score (...), in the unit of `weights`.
    """
    squared = (distance / distance_scale) ** 2 if distance_scale != 1.0 else distance * distance
    return (squared / (squared + 1.0)) @ weights
