"""Gymnasium environments of cpdeform's tasks.

Importing this package registers them, as Gymnasium expects of a package with environments::

    import cpdeform_gymnasium
    import gymnasium

    environment = gymnasium.make("cpdeform/Writer-v1")
    vector = gymnasium.make_vec("cpdeform/Writer-v1", num_envs=8)
"""

from cpdeform_gymnasium.environment import DeformEnv
from cpdeform_gymnasium.registration import environment_ids, register
from cpdeform_gymnasium.rewards import Reward, RewardPlasticineLab, RewardTransport
from cpdeform_gymnasium.vector import DeformVectorEnv
from cpdeform_gymnasium.worlds import RewardGradient, Snapshot, Worlds

__all__ = [
    "DeformEnv",
    "DeformVectorEnv",
    "Reward",
    "RewardGradient",
    "RewardPlasticineLab",
    "RewardTransport",
    "Snapshot",
    "Worlds",
    "environment_ids",
    "register",
]

register()
