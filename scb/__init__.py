"""Synthetic contextual bandits: one-step environments evolved so that agents trained in them do well elsewhere.

Importing the package registers the bandits that ship with it:

    import gymnax, scb
    env, params = gymnax.make("Synthetic-Pendulum-v1")

    import gymnasium, scb
    env = gymnasium.make("scb/Synthetic-Pendulum-v1")
"""

from scb import start as start  # before what imports gymnax

# isort: split
from scb.agents.dqn import DQN, DQNConfig, DQNHyperparameters
from scb.agents.ppo import PPO, PPOConfig, PPOHyperparameters
from scb.agents.sac import SAC, SACConfig, SACHyperparameters
from scb.agents.spec import AgentSpec, environment_agent
from scb.agents.td3 import TD3, TD3Config, TD3Hyperparameters, ddpg_config, ddpg_hyperparameters
from scb.environments.registry import make
from scb.environments.synthetic import BanditConfig, BanditParams, SyntheticBandit
from scb.environments.synthetic_mdp import MDPConfig, SyntheticMDP
from scb.environments.zoo import load_bandit, register_zoo, save_bandit
from scb.errors import UserError
from scb.gymnasium import register as register_with_gymnasium
from scb.machine import package_versions

__version__ = package_versions()["lpo"]

register_zoo()
register_with_gymnasium()

__all__ = [
    "DQN",
    "PPO",
    "SAC",
    "TD3",
    "AgentSpec",
    "BanditConfig",
    "BanditParams",
    "DQNConfig",
    "DQNHyperparameters",
    "MDPConfig",
    "PPOConfig",
    "PPOHyperparameters",
    "SACConfig",
    "SACHyperparameters",
    "SyntheticBandit",
    "SyntheticMDP",
    "TD3Config",
    "TD3Hyperparameters",
    "UserError",
    "ddpg_config",
    "ddpg_hyperparameters",
    "environment_agent",
    "load_bandit",
    "make",
    "save_bandit",
]
