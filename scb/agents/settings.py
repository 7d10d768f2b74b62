"""Settings for training an agent on an environment itself: the paper's experts on Brax, and classic control's."""

from dataclasses import dataclass
from typing import Any

from scb.agents.agent import Agent
from scb.agents.dqn import DQN, DQNConfig, DQNHyperparameters
from scb.agents.hyperparameters import ALGORITHMS
from scb.agents.ppo import PPO, PPOConfig, PPOHyperparameters
from scb.agents.sac import SAC, SACConfig, SACHyperparameters
from scb.agents.td3 import TD3, TD3Config, TD3Hyperparameters, ddpg_config
from scb.curriculum import with_limit
from scb.errors import unknown_name

MINATAR = (
    "Asterix-MinAtar",
    "Breakout-MinAtar",
    "Freeway-MinAtar",
    "Seaquest-MinAtar",
    "SpaceInvaders-MinAtar",
)


@dataclass(frozen=True)
class Setting:
    """An algorithm's static configuration and hyperparameters for an environment, and where they come from.

    Attributes:
      episode_limit: steps after which an episode of the training is cut, where that is not the
        environment's own limit: a longer one lets exploration reach a goal at all.
    """

    config: Any
    hyperparameters: Any
    source: str
    episode_limit: int | None = None

    def agent(self, env: Any) -> Agent:
        """The agent in an environment."""
        agents: dict[type, type[Agent]] = {
            PPOConfig: PPO,
            SACConfig: SAC,
            DQNConfig: DQN,
            TD3Config: TD3,
        }
        return agents[type(self.config)](env, self.config)

    def training_params(self, env_params: Any) -> Any:
        """The environment's parameters with the limit of the training's episodes."""
        return (
            env_params if self.episode_limit is None else with_limit(env_params, self.episode_limit)
        )

    @property
    def num_environment_steps(self) -> int:
        """Environment steps of one training."""
        return int(self.config.num_environment_steps)


# Tables "PPO | SAC | DDPG | TD3 expert hyperparameters": one column an environment.
_BRAX_COLUMNS = ("hopper", "walker2d", "swimmer", "halfcheetah", "humanoidstandup")
_BRAX_PPO: dict[str, tuple[float, ...]] = {
    "learning_rate": (2.5e-4, 1.7e-3, 2.8e-3, 1.7e-3, 1.7e-3),
    "num_envs": (32, 32, 128, 32, 32),
    "num_steps": (32, 32, 64, 32, 32),
    "num_epochs": (9, 2, 7, 2, 2),
    "num_minibatches": (2, 2, 8, 2, 2),
    "discount": (0.995, 0.99, 0.98, 0.99, 0.99),
    "gae_lambda": (0.95, 0.8, 0.99, 0.8, 0.8),
    "max_grad_norm": (1.0, 5.0, 0.5, 5.0, 5.0),
}
_BRAX_SAC: dict[str, tuple[float, ...]] = {
    "learning_rate": (5.7e-4, 2e-4, 5.7e-4, 2e-4, 2e-4),
    "batch_size": (128, 256, 128, 512, 256),
    "discount": (0.995, 0.99, 0.995, 0.98, 0.99),
    "polyak": (0.95, 0.99, 0.95, 0.995, 0.99),
}
_BRAX_DDPG: dict[str, tuple[float, ...]] = {
    "learning_rate": (1.4e-4, 1.4e-4, 4.6e-4, 2e-4, 2e-4),
    "discount": (0.995, 0.995, 0.995, 0.95, 0.95),
    "polyak": (0.98, 0.98, 0.995, 0.99, 0.99),
    "batch_size": (512, 512, 128, 512, 512),
    "max_grad_norm": (1.0, 1.0, 0.1, 0.1, 0.1),
    "exploration_noise": (0.2, 0.9, 1.0, 0.5, 0.5),
    "normalize_observations": (True, True, False, True, True),
}
_BRAX_TD3: dict[str, tuple[float, ...]] = {
    "learning_rate": (1.8e-4, 1.8e-4, 2.1e-4, 1.2e-4, 1.5e-4),
    "discount": (0.995, 0.995, 0.995, 0.99, 0.99),
    "polyak": (0.95, 0.95, 0.98, 0.99, 0.95),
    "batch_size": (256, 256, 512, 512, 256),
    "max_grad_norm": (2.0, 2.0, 0.1, 5.0, 0.2),
    "exploration_noise": (0.5, 0.5, 0.9, 0.3, 0.8),
    "target_noise": (0.8, 0.8, 0.9, 0.8, 1.0),
    "target_noise_clip": (0.5, 0.5, 0.9, 0.6, 0.9),
    "policy_delay": (3, 3, 1, 1, 10),
}


def _brax_expert(algorithm: str, environment: str) -> Setting:
    tables = {"ppo": _BRAX_PPO, "sac": _BRAX_SAC, "ddpg": _BRAX_DDPG, "td3": _BRAX_TD3}
    column = _BRAX_COLUMNS.index(environment)
    values: dict[str, Any] = {name: row[column] for name, row in tables[algorithm].items()}
    shared: dict[str, Any] = {"total_steps": 5 * 2**20, "normalize_observations": True}
    if algorithm != "ppo":
        shared |= {
            "num_envs": 128,
            "buffer_size": 2**20,
            "prefill": 2**13,
            "gradient_steps": 128,
        }
    if algorithm == "ddpg":
        shared |= {"num_critics": 1, "policy_delay": 1}
        values["target_noise"] = 0.0
    configs: Any
    numbers: Any
    configs, numbers = {
        "ppo": (PPOConfig, PPOHyperparameters),
        "sac": (SACConfig, SACHyperparameters),
        "ddpg": (TD3Config, TD3Hyperparameters),
        "td3": (TD3Config, TD3Hyperparameters),
    }[algorithm]
    static = {k: v for k, v in values.items() if k in configs.__dataclass_fields__}
    traced = {k: v for k, v in values.items() if k not in static}
    return Setting(
        configs(**shared | static),
        numbers(**traced),
        source=f"Liesen et al. (2024), table of {algorithm.upper()} expert hyperparameters",
    )


def _classic_sac() -> dict[str, Setting]:
    # Random actions that are held for 20 steps reach the goal of either mountain car a few times in
    # 20 000 steps; targets that follow within some hundred updates carry its value back to the valley.
    # With slower targets (0.99, or 16 environments an update) nothing is learned in 100 000 steps.
    car = SACConfig(
        num_envs=4,
        gradient_steps=4,
        buffer_size=60_000,
        prefill=20_000,
        prefill_hold=20,
        batch_size=128,
        total_steps=60_000,
        activation="relu",
        normalize_observations=True,
    )
    source = "found on seeds of its own: held random actions, targets that follow quickly"
    return {
        "MountainCar-v0": Setting(
            car,
            SACHyperparameters(learning_rate=1e-3, polyak=0.95, target_entropy_ratio=0.3),
            source,
            episode_limit=1000,
        ),
        "MountainCarContinuous-v0": Setting(
            car, SACHyperparameters(learning_rate=1e-3, polyak=0.95), source
        ),
        # With half the steps, or normalised observations, half of the agents never swing up.
        "Acrobot-v1": Setting(
            SACConfig(buffer_size=50_000, gradient_steps=4, total_steps=100_000),
            SACHyperparameters(learning_rate=1e-3, polyak=0.95, target_entropy_ratio=0.1),
            source="found on seeds of its own: ten times the inner loop's steps, twice its updates a step",
        ),
    }


def environment_settings(algorithm: str = "ppo") -> dict[str, Setting]:
    """Settings of their own, {environment: Setting}, for training in an environment itself."""
    if algorithm not in ALGORITHMS:
        raise unknown_name("algorithm", algorithm, ALGORITHMS)
    settings: dict[str, Setting] = {}
    if algorithm == "ppo":
        settings["Pendulum-v1"] = Setting(
            PPOConfig(num_envs=100, num_steps=100, total_steps=150_000, activation="relu"),
            PPOHyperparameters(learning_rate=1e-3, discount=0.995),
            source="a public tuned setting for Pendulum; network and minibatches as in the inner loop",
        )
        # 400 to 1000 entries an observation and thousands of steps to a first reward: large batches, few passes.
        minatar = Setting(
            PPOConfig(
                num_envs=64,
                num_steps=32,
                num_epochs=4,
                num_minibatches=8,
                total_steps=1_000_000,
                activation="relu",
                anneal_learning_rate=True,
            ),
            PPOHyperparameters(learning_rate=1e-3, max_grad_norm=0.5),
            source="usual values for games; annealing the learning rate earned a little more on Asterix, two agents",
        )
        settings |= dict.fromkeys(MINATAR, minatar)
    if algorithm == "sac":
        settings |= _classic_sac()
    if algorithm not in ("dqn", "ddqn"):
        settings |= {name: _brax_expert(algorithm, name) for name in _BRAX_COLUMNS}
    return settings


def environment_setting(name: str, algorithm: str = "ppo") -> Setting:
    """The setting of an algorithm for an environment; a general one where it has none of its own.

    PPO's general setting is the inner loop's with ten times the steps; the off-policy algorithms'
    takes one gradient step an environment step, with slowly moving targets.
    """
    settings = environment_settings(algorithm)
    if name in settings:
        return settings[name]
    if algorithm == "ppo":
        return Setting(
            PPOConfig(num_envs=10, num_steps=100, total_steps=100_000),
            PPOHyperparameters(learning_rate=1e-3),
            source="the inner loop's values, 10 environments, 100 000 steps",
        )
    static: dict[str, Any] = {
        "num_envs": 4,
        "gradient_steps": 4,
        "buffer_size": 20_000,
        "prefill": 1000,
        "batch_size": 128,
        "total_steps": 30_000,
        "activation": "relu",
    }
    source = "usual values: one gradient step an environment step, slowly moving targets"
    if algorithm == "sac":
        return Setting(
            SACConfig(**static),
            SACHyperparameters(learning_rate=1e-3, polyak=0.98, target_entropy_ratio=0.3),
            source,
        )
    if algorithm in ("dqn", "ddqn"):
        static |= {"total_steps": 60_000, "target_update_every": 400}
        return Setting(
            DQNConfig(**static), DQNHyperparameters(learning_rate=1e-3, discount=0.99), source
        )
    if algorithm == "ddpg":
        return Setting(
            ddpg_config(**static),
            TD3Hyperparameters(learning_rate=1e-3, polyak=0.98, target_noise=0.0),
            source,
        )
    return Setting(TD3Config(**static), TD3Hyperparameters(learning_rate=1e-3, polyak=0.98), source)
