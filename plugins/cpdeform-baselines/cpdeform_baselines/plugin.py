"""Registers the searches, the learners and the command `cpdeform rl`."""

from __future__ import annotations

from cpdeform.core.hookspecs import PluginSpec, hookimpl

SEARCHES = "cpdeform_baselines.searches"
LEARNERS = "cpdeform_baselines.learners.stage"


@hookimpl
def cpdeform_strategies() -> list[PluginSpec]:
    """Searches over contact plans, and learners."""
    return [
        PluginSpec(
            name="restarts",
            target=f"{SEARCHES}.restarts:StrategyRestarts",
            summary="plain Adam from 15 random contact plans a stage, the best kept",
        ),
        PluginSpec(
            name="bayesopt",
            target=f"{SEARCHES}.bayesopt:StrategyBayesian",
            summary="plain Adam from 15 contact plans a stage that a Gaussian process proposes",
        ),
        PluginSpec(
            name="cma",
            target=f"{SEARCHES}.cma:StrategyEvolution",
            summary="contact plan and actions by CMA-ES, rollouts alone",
        ),
        PluginSpec(
            name="mppi",
            target=f"{SEARCHES}.mppi:StrategyPathIntegral",
            summary="contacts and actions by sampling and path integral updates, rollouts alone",
        ),
        PluginSpec(
            name="sampled-gradients",
            target=f"{SEARCHES}.sampled:StrategySampledGradients",
            summary="descent from the best of 64 random contacts and motions",
        ),
        PluginSpec(name="sac", target=f"{LEARNERS}:StrategySoftActorCritic", summary="a policy learnt by SAC in each stage"),
        PluginSpec(name="ppo", target=f"{LEARNERS}:StrategyProximalPolicy", summary="a policy learnt by PPO in each stage"),
        PluginSpec(name="td3", target=f"{LEARNERS}:StrategyTwinDelayed", summary="a policy learnt by TD3 in each stage"),
    ]


@hookimpl
def cpdeform_placers() -> list[PluginSpec]:
    """The searches' ways of proposing contact plans."""
    return [
        PluginSpec(
            name="bayesopt",
            target=f"{SEARCHES}.bayesopt:PlacerBayesian",
            summary="contact plans that a Gaussian process proposes from the losses of those before",
        ),
        PluginSpec(
            name="cma",
            target=f"{SEARCHES}.cma:PlacerEvolution",
            summary="contact plans with actions by CMA-ES, a generation a round",
        ),
        PluginSpec(
            name="mppi",
            target=f"{SEARCHES}.mppi:PlacerPathIntegral",
            summary="random contact plans with actions, then path integral updates of the best one's actions",
        ),
        PluginSpec(
            name="samples",
            target=f"{SEARCHES}.sampled:PlacerSamples",
            summary="random contact plans with random actions",
        ),
    ]


@hookimpl
def cpdeform_commands() -> list[PluginSpec]:
    """The learners."""
    return [
        PluginSpec(name="rl", target="cpdeform_baselines.cli:rl", summary="Train a policy on a task by reinforcement learning.")
    ]
