"""The paper's hyperparameter tables and this project's own settings, as data.

`Liesen et al. (2024)`, appendix "Hyperparameters", and for training in an environment itself what its
tables leave out. Values are {field: value} over an algorithm's defaults, which are the paper's underlined
values; `scb.agents.spec` makes specifications of them. A new algorithm is its module and an entry here.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from scb.agents.agent import Algorithm
from scb.agents.dqn import DDQN_ALGORITHM, DQN_ALGORITHM
from scb.agents.ppo import PPO_ALGORITHM
from scb.agents.sac import SAC_ALGORITHM
from scb.agents.td3 import DDPG_ALGORITHM, TD3_ALGORITHM

Lists: TypeAlias = Mapping[str, Sequence[float]]
Values: TypeAlias = Mapping[str, Any]


@dataclass(frozen=True)
class Setting:
    """What an algorithm is trained with in an environment itself, and where the values come from.

    Attributes:
      episode_limit: steps after which an episode of the training is cut, where that is not the
        environment's own limit: a longer one lets exploration reach a goal at all.
    """

    values: Values
    source: str
    episode_limit: int | None = None


@dataclass(frozen=True)
class Tables:
    """What is tabulated of an algorithm.

    Attributes:
      lists: {hyperparameter: values} that the inner loop draws from.
      families: {family of environments: values} of its bandits' inner loops, where nothing is drawn.
      general: in an environment that has no row of its own.
      environments: {environment, or a family of them: its row}.
      continuous: the lists that are others where actions are continuous.
      by_default: whether the inner loop trains it where no algorithms are named.
    """

    algorithm: Algorithm
    lists: Lists
    general: Setting
    families: Mapping[str, Values] = field(default_factory=dict)
    environments: Mapping[str, Setting] = field(default_factory=dict)
    continuous: Lists = field(default_factory=dict)
    by_default: bool = True


# -- the inner loop, on bandits
# ------------------------------------------------------------------------

# The inner loop's networks are tanh elsewhere.
ACTIVATIONS = {"Pendulum-v1": "relu"}

_LEARNING_RATES = (0.01, 0.005, 0.001, 0.0005, 0.0001)
_DISCOUNTS = (1.0, 0.99, 0.95, 0.9, 0.8)
_POLYAK = (0.99, 0.95, 0.9, 0.7, 0.8)
_NOISE = (0.1, 0.2, 0.3, 0.5, 0.7, 0.9)

# Table "Hyperparameters for PPO in the inner loop", classic control. `drift` is the clip epsilon.
PPO_INNER_LOOP: dict[str, tuple[float, ...]] = {
    "learning_rate": _LEARNING_RATES,
    "discount": _DISCOUNTS,
    "gae_lambda": (1.0, 0.95, 0.9, 0.8, 0.5),
    "drift": (0.1, 0.2, 0.3, 0.4, 0.5),
    "entropy_coefficient": (0.0, 0.01, 0.05, 0.1, 0.5),
    "value_coefficient": (0.0, 0.5, 1.0, 1.5, 2.0),
}
# "Without 0.01 for continuous environments": of PPO's learning rates, and of no other algorithm's.
PPO_CONTINUOUS: dict[str, tuple[float, ...]] = {"learning_rate": _LEARNING_RATES[1:]}
# Tables "Hyperparameters for SAC | DQN | DDPG | TD3 in the inner loop", classic control.
SAC_INNER_LOOP: dict[str, tuple[float, ...]] = {
    "learning_rate": _LEARNING_RATES,
    "discount": _DISCOUNTS,
    "polyak": _POLYAK,
    "target_entropy_ratio": (0.1, 0.3, 0.5, 0.7, 0.9),
}
DDQN_INNER_LOOP: dict[str, tuple[float, ...]] = {
    "epsilon_end": (0.01, 0.05, 0.1, 0.2),
    "learning_rate": _LEARNING_RATES,
    "discount": _DISCOUNTS,
}
DQN_INNER_LOOP: dict[str, tuple[float, ...]] = {**DDQN_INNER_LOOP, "double": (1.0, 0.0)}
DDPG_INNER_LOOP: dict[str, tuple[float, ...]] = {
    "learning_rate": _LEARNING_RATES,
    "discount": _DISCOUNTS,
    "polyak": _POLYAK,
    "exploration_noise": _NOISE,
}
TD3_INNER_LOOP: dict[str, tuple[float, ...]] = {
    **DDPG_INNER_LOOP,
    "target_noise": _NOISE,
    "target_noise_clip": (0.1, 0.4, 0.5, 0.7, 1.0, 1.3),
}

# -- environments themselves
# ---------------------------------------------------------------------------

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
_BRAX_SHARED: Values = {"total_steps": 5 * 2**20, "normalize_observations": True}
_BRAX_OFF_POLICY: Values = {
    **_BRAX_SHARED,
    "num_envs": 128,
    "buffer_size": 2**20,
    "prefill": 2**13,
    "gradient_steps": 128,
}


def _experts(name: str, shared: Values, columns: Mapping[str, Sequence[Any]]) -> dict[str, Setting]:
    """{environment: its column of a table of experts}."""
    return {
        environment: Setting(
            {**shared, **{field: row[i] for field, row in columns.items()}},
            f"Liesen et al. (2024), table of {name.upper()} expert hyperparameters",
        )
        for i, environment in enumerate(_BRAX_COLUMNS)
    }


# 400 to 1000 entries an observation and thousands of steps to a first reward: large batches, few passes.
_MINATAR_PPO = Setting(
    {
        "num_envs": 64,
        "num_steps": 32,
        "num_epochs": 4,
        "num_minibatches": 8,
        "total_steps": 1_000_000,
        "activation": "relu",
        "anneal_learning_rate": True,
        "learning_rate": 1e-3,
        "max_grad_norm": 0.5,
    },
    "usual values for games; annealing the learning rate earned a little more on Asterix, two agents",
)
_PENDULUM_PPO = Setting(
    {
        "num_envs": 100,
        "num_steps": 100,
        "total_steps": 150_000,
        "activation": "relu",
        "learning_rate": 1e-3,
        "discount": 0.995,
    },
    "a public tuned setting for Pendulum; network and minibatches as in the inner loop",
)
_GENERAL_PPO = Setting(
    {"num_envs": 10, "num_steps": 100, "total_steps": 100_000, "learning_rate": 1e-3},
    "the inner loop's values, 10 environments, 100 000 steps",
)

# Random actions that are held for 20 steps reach the goal of either mountain car a few times in
# 20 000 steps; targets that follow within some hundred updates carry its value back to the valley.
# With slower targets (0.99, or 16 environments an update) nothing is learned in 100 000 steps.
_MOUNTAIN_CAR_SAC: Values = {
    "num_envs": 4,
    "gradient_steps": 4,
    "buffer_size": 60_000,
    "prefill": 20_000,
    "prefill_hold": 20,
    "batch_size": 128,
    "total_steps": 60_000,
    "activation": "relu",
    "normalize_observations": True,
    "learning_rate": 1e-3,
    "polyak": 0.95,
}
_HELD = "found on seeds of its own: held random actions, targets that follow quickly"
_CLASSIC_SAC = {
    "MountainCar-v0": Setting(
        {**_MOUNTAIN_CAR_SAC, "target_entropy_ratio": 0.3}, _HELD, episode_limit=1000
    ),
    "MountainCarContinuous-v0": Setting(_MOUNTAIN_CAR_SAC, _HELD),
    # With half the steps, or normalised observations, half of the agents never swing up.
    "Acrobot-v1": Setting(
        {
            "buffer_size": 50_000,
            "gradient_steps": 4,
            "total_steps": 100_000,
            "learning_rate": 1e-3,
            "polyak": 0.95,
            "target_entropy_ratio": 0.1,
        },
        "found on seeds of its own: ten times the inner loop's steps, twice its updates a step",
    ),
}


def _off_policy(**more: Any) -> Setting:
    static = {
        "num_envs": 4,
        "gradient_steps": 4,
        "buffer_size": 20_000,
        "prefill": 1000,
        "batch_size": 128,
        "total_steps": 30_000,
        "activation": "relu",
        "learning_rate": 1e-3,
    }
    source = "usual values: one gradient step an environment step, slowly moving targets"
    return Setting({**static, **more}, source)


_GENERAL_DQN = _off_policy(total_steps=60_000, target_update_every=400, discount=0.99)

# {(algorithm, environment): values} that finding an expert to fit a bandit to changes.
WARM_START: dict[tuple[str, str], Values] = {
    # Episodes without end and a reward at every step: a short horizon learns the swing-up several
    # times faster.
    ("ppo", "Pendulum-v1"): {"discount": 0.95},
}

TABLES = (
    Tables(
        PPO_ALGORITHM,
        lists=PPO_INNER_LOOP,
        continuous=PPO_CONTINUOUS,
        general=_GENERAL_PPO,
        families={"brax": {}},
        environments={
            "Pendulum-v1": _PENDULUM_PPO,
            "minatar": _MINATAR_PPO,
            **_experts("ppo", _BRAX_SHARED, _BRAX_PPO),
        },
    ),
    Tables(
        SAC_ALGORITHM,
        lists=SAC_INNER_LOOP,
        general=_off_policy(polyak=0.98, target_entropy_ratio=0.3),
        families={
            "brax": {"num_envs": 1, "buffer_size": 5000, "batch_size": 250, "gradient_steps": 1}
        },
        environments={**_CLASSIC_SAC, **_experts("sac", _BRAX_OFF_POLICY, _BRAX_SAC)},
    ),
    Tables(DQN_ALGORITHM, lists=DQN_INNER_LOOP, general=_GENERAL_DQN),
    # DQN draws whether it is double, and so stands for both.
    Tables(DDQN_ALGORITHM, lists=DDQN_INNER_LOOP, general=_GENERAL_DQN, by_default=False),
    Tables(
        DDPG_ALGORITHM,
        lists=DDPG_INNER_LOOP,
        general=_off_policy(polyak=0.98),
        families={"brax": {"buffer_size": 5000}},
        environments=_experts("ddpg", _BRAX_OFF_POLICY, _BRAX_DDPG),
    ),
    Tables(
        TD3_ALGORITHM,
        lists=TD3_INNER_LOOP,
        general=_off_policy(polyak=0.98),
        families={"brax": {"buffer_size": 5000}},
        environments=_experts("td3", _BRAX_OFF_POLICY, _BRAX_TD3),
    ),
)
