"""Which particles are worth a try, in which order: bodies by their mean priority, particles by their own."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.placer import Stage
from cpdeform.core.sampling import solid_index


@dataclasses.dataclass
class Exploration:
    """What has been tried in a stage.

    Attributes:
        stage: The stage.
        priorities: Its priorities (N,), checked, in the type of the positions.
        bodies: Index (N,) of each particle's body; bodies that touch at the scene's start are one.
        ranking: Bodies, that of the highest mean priority first.
        explored: Particles (N,) that are not proposed again.
        radius: Distance from a contact point within which particles count as explored, length units.
        attempt: Number of contact points so far, those out of reach included.
        rounds: Number of rounds of candidates so far.
    """

    stage: Stage
    priorities: Tensor
    bodies: Tensor
    ranking: list[int]
    explored: Tensor
    radius: float
    attempt: int = 0
    rounds: int = 0

    @classmethod
    def begin(cls, stage: Stage, *, radius: float) -> Exploration:
        """Explored is what lies around the contact points that gained nothing before.

        Args:
            stage: The stage.
            radius: Distance from a contact point within which particles count as explored, length units.

        Raises:
            InputError: The priorities are not finite, or do not fit the particles.
        """
        particles = stage.state.position[0].detach()
        priorities = stage.priorities.detach().to(particles)
        if priorities.shape != particles.shape[:1] or not bool(torch.isfinite(priorities).all()):
            raise InputError(
                "stage.priorities",
                came=f"shape {tuple(priorities.shape)}, {int((~torch.isfinite(priorities)).sum())} not finite",
                expected=f"{particles.shape[0]} finite priorities",
            )
        bodies = torch.as_tensor(solid_index(stage.scene)).to(particles.device).long()
        count = int(bodies.max()) + 1
        sums = torch.zeros(count, dtype=torch.float64, device=particles.device).index_add(0, bodies, priorities.double())
        means = sums / torch.bincount(bodies, minlength=count)
        ranking = means.argsort(descending=True, stable=True).tolist()
        exploration = cls(stage, priorities, bodies, ranking, torch.zeros_like(bodies, dtype=torch.bool), radius)
        for contact in stage.failed_contacts:
            exploration.explore(contact)
        for body in range(count):
            if bool(exploration.explored[bodies == body].all()):
                exploration.explored[bodies == body] = False
        return exploration

    def explore(self, contact: int, *, radius: float | None = None) -> None:
        """Count the surroundings of a particle, within `radius` (length units; defaults to the exploration's own), as explored."""
        self.explored |= self.near(contact, self.radius if radius is None else radius)

    def contact(self, body: int, *, excluded: Tensor | None = None) -> int | None:
        """The particle of a body with the largest priority that is neither explored nor excluded (N,); None where none is left."""
        allowed = (self.bodies == body) & ~self.explored
        if excluded is not None:
            allowed &= ~excluded
        if not bool(allowed.any()):
            return None
        return int(torch.where(allowed, self.priorities, -torch.inf).argmax())

    def near(self, contact: int, radius: float) -> Tensor:
        """Whether particles (N,) lie within `radius`, length units, of the particle `contact`."""
        particles = self.stage.state.position[0]
        distance: Tensor = torch.linalg.vector_norm(particles - particles[contact], dim=-1)
        return distance <= radius
