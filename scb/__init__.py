"""Synthetic contextual bandits: one-step environments evolved so that agents trained in them do well elsewhere.

Importing the package registers the bandits that ship with it:

    import gymnax, scb
    env, params = gymnax.make("Synthetic-Pendulum-v1")
"""

from scb.agents.ppo import PPO, PPOConfig, PPOHyperparameters
from scb.environments.registry import make
from scb.environments.synthetic import BanditConfig, BanditParams, SyntheticBandit
from scb.environments.zoo import load_bandit, register_zoo, save_bandit
from scb.errors import UserError

register_zoo()

__all__ = [
    "PPO",
    "BanditConfig",
    "BanditParams",
    "PPOConfig",
    "PPOHyperparameters",
    "SyntheticBandit",
    "UserError",
    "load_bandit",
    "make",
    "save_bandit",
]
