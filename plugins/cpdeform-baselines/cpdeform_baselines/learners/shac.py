"""Short-horizon actor-critic (SHAC): a policy learnt through the simulator's gradient.

Written from its description in Xu, Makoviychuk, Narang, Ramos, Matusik, Garg, Macklin, "Accelerated Policy Learning with Parallel
Differentiable Simulation", ICLR 2022.
"""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.tensorboard.writer import SummaryWriter

from cpdeform.core.errors import InputError
from cpdeform.core.simulator import differentiable_rollout
from cpdeform_baselines.learners.configuration import LearnerConfiguration
from cpdeform_baselines.learners.environments import make_vector
from cpdeform_baselines.learners.evaluation import Policy
from cpdeform_baselines.learners.networks import Actor, Normalisation, layers
from cpdeform_baselines.learners.training import Learner, Note

STATE_FILE = "learner.pt"


@dataclasses.dataclass(frozen=True, kw_only=True)
class ShortHorizonOptions:
    """Options of the algorithm.

    Attributes:
        horizon: Steps h that gradients go back through.
        discount: Factor gamma of each further step's reward.
        trace: Lambda of the critic's TD(lambda) goals.
        actor_rate: Adam's step size of the actor.
        critic_rate: That of the critic.
        critic_passes: Passes over the horizon's data by which the critic is fitted.
        critic_batches: Batches of a pass.
        follow: Share by which the critic that bootstraps follows the one that is fitted, after each horizon.
        gradient_norm: The actor's gradient is scaled down to this norm.
        reward_scale: Factor of the rewards; None divides by the running standard deviation of the returns.
    """

    horizon: int = 8
    discount: float = 0.99
    trace: float = 0.95
    actor_rate: float = 2e-3
    critic_rate: float = 2e-3
    critic_passes: int = 16
    critic_batches: int = 4
    follow: float = 0.8
    gradient_norm: float = 1.0
    reward_scale: float | None = None


@dataclasses.dataclass
class _Horizon:
    """What happened in a horizon; lists over its steps, each entry of all B worlds.

    Attributes:
        observations: Normalised, before the step (B, O).
        rewards: Scaled, after it (B,).
        following: Normalised, after it, before a reset (B, O).
        over: Whether the episode ended with it.
        terminated: Whether it ended for good: nothing follows.
        loss: Of the actor.
    """

    observations: list[Tensor] = dataclasses.field(default_factory=list)
    rewards: list[Tensor] = dataclasses.field(default_factory=list)
    following: list[Tensor] = dataclasses.field(default_factory=list)
    over: list[Tensor] = dataclasses.field(default_factory=list)
    terminated: list[Tensor] = dataclasses.field(default_factory=list)
    loss: Tensor | None = None


class LearnerShortHorizon(Learner):
    """SHAC on the worlds of one simulator.

    Args:
        configuration: How; its `options` are those of `ShortHorizonOptions`.
        out: Where TensorBoard's files go.

    Raises:
        InputError: There is no option of a name.
    """

    def __init__(self, configuration: LearnerConfiguration, out: Path) -> None:
        try:
            self.options = ShortHorizonOptions(**configuration.options)
        except TypeError as error:
            known = ", ".join(field.name for field in dataclasses.fields(ShortHorizonOptions))
            raise InputError("options", came=str(configuration.options), expected=f"some of {known}") from error
        self._environment = make_vector(configuration)
        self._worlds = self._environment.worlds
        self._generator = torch.Generator().manual_seed(configuration.seed)
        observed, acted = self._worlds.observation.size, self._worlds.task.scene.action_size
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(configuration.seed)
            self._actor, self._critic = Actor(observed, acted), layers(observed, 1, (64, 64))
        self._bootstrap = copy.deepcopy(self._critic)
        self._normalisation = Normalisation(observed)
        self._adam = torch.optim.Adam(self._actor.parameters(), lr=self.options.actor_rate, betas=(0.7, 0.95))
        self._critic_adam = torch.optim.Adam(self._critic.parameters(), lr=self.options.critic_rate, betas=(0.7, 0.95))
        self._steps, self._seed = 0, configuration.seed
        self._returns = torch.zeros(configuration.worlds, dtype=torch.float64)
        self._discounted = torch.zeros(configuration.worlds, dtype=torch.float64)
        self._spread = Normalisation(1).double()
        self._writer: Any = SummaryWriter(str(out / "tensorboard"))
        self._environment.reset(seed=configuration.seed)

    @property
    def steps_done(self) -> int:
        """Environment steps so far."""
        return self._steps

    def learn(self, steps: int, note: Note) -> None:
        """Go on; whole horizons of all worlds are made."""
        last = self._steps + steps
        while self._steps < last:
            horizon = self._roll(note)
            actor_loss = self._improve_actor(horizon)
            critic_loss = self._fit_critic(horizon)
            with torch.no_grad():
                for slow, fast in zip(self._bootstrap.parameters(), self._critic.parameters(), strict=True):
                    slow.lerp_(fast, self.options.follow)
            self._writer.add_scalar("train/actor_loss", actor_loss, self._steps)
            self._writer.add_scalar("train/critic_loss", critic_loss, self._steps)

    def policy(self) -> Policy:
        """The mean action."""
        actor, normalisation = self._actor, self._normalisation

        def act(observation: NDArray[np.float32]) -> NDArray[Any]:
            with torch.no_grad():
                return np.asarray(actor(normalisation(torch.as_tensor(observation))).numpy())

        return act

    def save(self, directory: Path) -> None:
        """Networks, optimisers, normalisation and counters."""
        torch.save(self._content(), directory / STATE_FILE)

    def load(self, directory: Path) -> None:
        """Networks, optimisers, normalisation and counters; the worlds begin new episodes."""
        content = torch.load(directory / STATE_FILE, weights_only=True)
        parts: dict[str, Any] = self._parts()
        for name, part in parts.items():
            part.load_state_dict(content[name])
        self._steps = int(content["steps"])
        self._generator.set_state(content["generator"])
        self._environment.reset(seed=self._seed + self._steps)

    def _parts(self) -> dict[str, Any]:
        return {
            "actor": self._actor,
            "critic": self._critic,
            "bootstrap": self._bootstrap,
            "normalisation": self._normalisation,
            "spread": self._spread,
            "adam": self._adam,
            "critic_adam": self._critic_adam,
        }

    def _content(self) -> dict[str, Any]:
        states = {name: part.state_dict() for name, part in self._parts().items()}
        return {**states, "steps": self._steps, "generator": self._generator.get_state()}

    def _roll(self, note: Note) -> _Horizon:
        """A horizon of all worlds with its graph: the actor's loss is minus the mean of rewards and of what comes after them."""
        worlds, horizon = self._worlds, _Horizon()
        state = worlds.state
        total = torch.zeros(worlds.count)
        factor = torch.ones(worlds.count)
        for step in range(self.options.horizon):
            observation = worlds.observation.observe(state).float()
            self._normalisation.update(observation.detach())
            seen = self._normalisation(observation)
            noise = torch.randn(worlds.count, worlds.task.scene.action_size, generator=self._generator)
            actions = self._actor(seen, noise)
            trajectory = differentiable_rollout(worlds.simulator, state, actions.unsqueeze(1).to(state.position))
            terms = worlds.reward.terms(trajectory.positions[:, 1], trajectory.tool_poses[:, 1])
            reward = worlds.reward.combine(terms, worlds.start_terms())
            after = trajectory.final_state
            finite = torch.isfinite(worlds.observation.observe(after).detach()).all(dim=1) & torch.isfinite(reward.detach())
            # What broke has neither reward nor gradient, and begins anew.
            reward = torch.where(finite, reward, torch.zeros_like(reward)).float()
            scaled = self._scale(reward.detach()) * reward
            total = total + factor * scaled
            following = self._normalisation(worlds.observation.observe(after).float().nan_to_num())
            over = self._environment.count_step(torch.logical_not(finite).cpu().numpy())
            last = step == self.options.horizon - 1
            ends = torch.as_tensor(over) & finite | torch.full_like(finite, last) & finite
            value = self._bootstrap(following).squeeze(-1)
            total = total + torch.where(ends, factor * self.options.discount * value, torch.zeros_like(value))
            factor = torch.where(torch.as_tensor(over), torch.ones_like(factor), factor * self.options.discount)
            horizon.observations.append(seen.detach())
            horizon.rewards.append(scaled.detach())
            horizon.following.append(following.detach())
            horizon.over.append(torch.as_tensor(over))
            horizon.terminated.append(torch.logical_not(finite))
            self._steps += worlds.count
            state = self._go_on(after, reward.detach(), over, note)
        worlds.state = state.clone()
        horizon.loss = -total.sum() / (self.options.horizon * worlds.count)
        return horizon

    def _go_on(self, after: Any, reward: Tensor, over: NDArray[np.bool_], note: Note) -> Any:
        """The state of the next step: new episodes where the old ones are over, without a gradient to them."""
        self._returns += reward.double()
        if not over.any():
            return after
        self._worlds.state = after.clone()
        measures = self._worlds.measures() if not np.isnan(after.position.detach().numpy()).any() else {}
        for world in np.flatnonzero(over).tolist():
            note(self._steps, float(self._returns[world]), float(measures["w1"][world]) if measures else float("nan"))
            self._writer.add_scalar("rollout/return", float(self._returns[world]), self._steps)
            self._returns[world] = self._discounted[world] = 0.0
        self._environment.begin_anew(over)
        fresh, keep = self._worlds.state, torch.as_tensor(~over)

        def chosen(old: Tensor, new: Tensor) -> Tensor:
            return torch.where(keep.reshape(-1, *[1] * (old.ndim - 1)), old, new)

        fields = dataclasses.fields(after)
        return type(after)(**{field.name: chosen(getattr(after, field.name), getattr(fresh, field.name)) for field in fields})

    def _scale(self, reward: Tensor) -> float:
        """Factor of the rewards."""
        if self.options.reward_scale is not None:
            return self.options.reward_scale
        self._discounted = self.options.discount * self._discounted + reward.double()
        self._spread.update(self._discounted.unsqueeze(-1))
        return float(1.0 / (self._spread.square + 1e-8).sqrt())

    def _improve_actor(self, horizon: _Horizon) -> float:
        """One step of Adam through the simulator."""
        if horizon.loss is None:
            raise ValueError("a horizon without a loss")
        self._adam.zero_grad()
        horizon.loss.backward()  # type: ignore[no-untyped-call]
        gradients = [parameter.grad for parameter in self._actor.parameters() if parameter.grad is not None]
        if all(bool(torch.isfinite(gradient).all()) for gradient in gradients):
            torch.nn.utils.clip_grad_norm_(self._actor.parameters(), self.options.gradient_norm)
            self._adam.step()
        return float(horizon.loss.detach())

    def _fit_critic(self, horizon: _Horizon) -> float:
        """Fit the critic to TD(lambda) goals; returns its last loss."""
        goals = self._critic_goals(horizon)
        observations, wanted = torch.cat(horizon.observations), goals.flatten()
        loss = torch.zeros(())
        for _ in range(self.options.critic_passes):
            order = torch.randperm(len(wanted), generator=self._generator)
            for part in order.chunk(self.options.critic_batches):
                self._critic_adam.zero_grad()
                loss = (self._critic(observations[part]).squeeze(-1) - wanted[part]).square().mean()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(self._critic.parameters(), self.options.gradient_norm)
                self._critic_adam.step()
        return float(loss.detach())

    def _critic_goals(self, horizon: _Horizon) -> Tensor:
        """TD(lambda) goals (h, B) of the critic."""
        with torch.no_grad():
            values = [self._bootstrap(following).squeeze(-1) for following in horizon.following]
        return lambda_returns(
            torch.stack(horizon.rewards),
            torch.stack(values),
            torch.stack(horizon.over),
            torch.stack(horizon.terminated),
            discount=self.options.discount,
            trace=self.options.trace,
        )


def lambda_returns(
    rewards: Tensor, following: Tensor, over: Tensor, terminated: Tensor, *, discount: float, trace: float
) -> Tensor:
    """TD(lambda) returns of some steps.

    G_t = r_t + gamma ((1 - lambda) V_{t+1} + lambda G_{t+1}); at the end of an episode or of the data G_t = r_t + gamma V_{t+1},
    and V_{t+1} is 0 where the episode ended for good.

    Args:
        rewards: Rewards (h, B).
        following: Values (h, B) of the observation after each step.
        over: Whether the episode ended with the step (h, B).
        terminated: Whether nothing follows (h, B).
        discount: Gamma.
        trace: Lambda.

    Returns:
        Returns (h, B).
    """
    values = torch.where(terminated, torch.zeros_like(following), following)
    found = torch.zeros_like(rewards)
    further = values[-1]
    for step in reversed(range(len(rewards))):
        mixed = (1.0 - trace) * values[step] + trace * further
        mixed = torch.where(over[step], values[step], mixed)
        found[step] = further = rewards[step] + discount * mixed
    return found
