"""The paper's hyperparameter tables (appendix "Hyperparameters"), once, as data.

The inner loop's lists are sampled from during discovery; the experts' values train agents on an
environment itself.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from gymnax.environments import spaces

from scb.agents.agent import Agent
from scb.agents.dqn import DQN, DQNConfig, DQNHyperparameters
from scb.agents.ppo import PPO, PPOConfig, PPOHyperparameters
from scb.agents.sac import SAC, SACConfig, SACHyperparameters
from scb.agents.td3 import TD3, TD3Config, TD3Hyperparameters, ddpg_config
from scb.environments.brax import BRAX_NAMES
from scb.errors import UserError, unknown_name
from scb.keys import split_key

Lists: TypeAlias = Mapping[str, Sequence[float]]

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
# Tables "Hyperparameters for SAC | DQN | DDPG | TD3 in the inner loop", classic control.
SAC_INNER_LOOP: dict[str, tuple[float, ...]] = {
    "learning_rate": _LEARNING_RATES,
    "discount": _DISCOUNTS,
    "polyak": _POLYAK,
    "target_entropy_ratio": (0.1, 0.3, 0.5, 0.7, 0.9),
}
DQN_INNER_LOOP: dict[str, tuple[float, ...]] = {
    "epsilon_end": (0.01, 0.05, 0.1, 0.2),
    "learning_rate": _LEARNING_RATES,
    "discount": _DISCOUNTS,
    "double": (1.0, 0.0),
}
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


@dataclass(frozen=True)
class _Algorithm:
    """An algorithm's agent, tables, and the action spaces that it fits."""

    agent: type[Agent]
    hyperparameters: Any
    classic: Any
    brax: Any
    lists: Lists
    actions: tuple[str, ...] = ("discrete", "continuous")


_ALGORITHMS: dict[str, _Algorithm] = {
    "ppo": _Algorithm(PPO, PPOHyperparameters(), PPOConfig(), PPOConfig(), PPO_INNER_LOOP),
    "sac": _Algorithm(
        SAC,
        SACHyperparameters(),
        SACConfig(),
        SACConfig(num_envs=1, buffer_size=5000, batch_size=250, gradient_steps=1),
        SAC_INNER_LOOP,
    ),
    "dqn": _Algorithm(
        DQN, DQNHyperparameters(), DQNConfig(), DQNConfig(), DQN_INNER_LOOP, ("discrete",)
    ),
    "ddqn": _Algorithm(
        DQN,
        DQNHyperparameters(double=1.0),
        DQNConfig(),
        DQNConfig(),
        {name: values for name, values in DQN_INNER_LOOP.items() if name != "double"},
        ("discrete",),
    ),
    "ddpg": _Algorithm(
        TD3,
        TD3Hyperparameters(target_noise=0.0),
        ddpg_config(),
        ddpg_config(buffer_size=5000),
        DDPG_INNER_LOOP,
        ("continuous",),
    ),
    "td3": _Algorithm(
        TD3,
        TD3Hyperparameters(),
        TD3Config(),
        TD3Config(buffer_size=5000),
        TD3_INNER_LOOP,
        ("continuous",),
    ),
}
ALGORITHMS = tuple(_ALGORITHMS)


def kind_of_actions(space: spaces.Box | spaces.Discrete) -> str:
    """Either "discrete" or "continuous"."""
    return "discrete" if isinstance(space, spaces.Discrete) else "continuous"


def algorithms_for(space: spaces.Box | spaces.Discrete) -> tuple[str, ...]:
    """The paper's inner-loop algorithms for an action space; DQN draws whether it is double."""
    return (
        ("ppo", "sac", "dqn")
        if kind_of_actions(space) == "discrete"
        else ("ppo", "sac", "ddpg", "td3")
    )


def check_algorithms(names: Sequence[str], space: spaces.Box | spaces.Discrete) -> None:
    """Raises a UserError for an empty list, an unknown name, or one that doesn't fit the action space."""
    kind = kind_of_actions(space)
    fitting = [name for name, algorithm in _ALGORITHMS.items() if kind in algorithm.actions]
    if not names:
        raise UserError(
            f"the list of algorithms is empty: give one or more of {', '.join(fitting)}."
        )
    for name in names:
        if name not in _ALGORITHMS:
            raise unknown_name("algorithm", name, ALGORITHMS)
        if name not in fitting:
            raise UserError(
                f"{name} does not fit the environment's {kind} actions: use {', '.join(fitting)}."
            )


@dataclass(frozen=True)
class InnerLoop:
    """One algorithm of the inner loop: static configuration, defaults, and the lists to draw from."""

    name: str
    config: Any
    hyperparameters: Any
    lists: Lists

    def agent(self, env: Any) -> Agent:
        """The agent in an environment."""
        return _ALGORITHMS[self.name].agent(env, self.config)

    def sample(self, key: jax.Array, number: int) -> Any:
        """[N] hyperparameters."""
        return sample_hyperparameters(key, self.lists, number, self.hyperparameters)

    @property
    def steps(self) -> int:
        """Environment steps of one training."""
        return int(self.config.num_environment_steps)


def inner_loop(
    algorithm: str,
    evaluation_environment: str,
    space: spaces.Box | spaces.Discrete,
    sampled: bool = True,
) -> InnerLoop:
    """The paper's table for an algorithm in an environment's bandit.

    Networks are tanh, but ReLU for Pendulum. Hyperparameters are drawn in classic control (without
    the learning rate 0.01 where actions are continuous), and fixed in Brax.

    Args:
      algorithm: one of `ALGORITHMS`.
      evaluation_environment: its name.
      space: its action space.
      sampled: False for the paper's underlined values everywhere.
    """
    check_algorithms([algorithm], space)
    table = _ALGORITHMS[algorithm]
    in_brax = evaluation_environment in BRAX_NAMES
    config = table.brax if in_brax else table.classic
    if evaluation_environment == "Pendulum-v1":
        config = replace(config, activation="relu")
    lists = dict(table.lists) if sampled and not in_brax else {}
    if "learning_rate" in lists and kind_of_actions(space) == "continuous":
        lists["learning_rate"] = tuple(x for x in lists["learning_rate"] if x < 0.01)
    return InnerLoop(algorithm, config, table.hyperparameters, lists)


def check_lists(lists: Lists, hyperparameters: Any) -> None:
    """Raises a UserError for an unknown hyperparameter, an empty list, or a value that is no number."""
    known = hyperparameters.__dataclass_fields__
    for name, values in lists.items():
        if name not in known:
            raise UserError(f"unknown hyperparameter {name!r}: known are {', '.join(known)}.")
        if not len(values):
            raise UserError(f"the list of values for {name} is empty: give at least one number.")
        for value in values:
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise UserError(
                    f"{name} has the value {value!r}, which is no number: give numbers only."
                )


def sample_hyperparameters(
    key: jax.Array, lists: Lists, number: int, hyperparameters: Any = None
) -> Any:
    """Hyperparameters for `number` agents, uniform and independent per hyperparameter, dealt evenly.

    Each agent's draw is uniform, but agents share the values out: of four agents and four learning
    rates each has another (a Latin hypercube). A mean over few agents then depends less on who drew
    what.

    Args:
      key: decides the draw.
      lists: {hyperparameter: values}; those left out keep their defaults.
      number: N agents.
      hyperparameters: the defaults; PPO's where None.

    Returns:
      The hyperparameters, every leaf [N].
    """
    hyperparameters = PPOHyperparameters() if hyperparameters is None else hyperparameters
    check_lists(lists, hyperparameters)

    def deal(key: jax.Array, values: Sequence[float]) -> jax.Array:
        key_order, key_offset = split_key(key)
        order = jax.random.permutation(key_order, number)
        offset = jax.random.randint(key_offset, (), 0, len(values))
        return jnp.asarray(values, jnp.float32)[(order + offset) % len(values)]

    keys = split_key(key, len(lists))
    drawn = {
        name: deal(k, values) for k, (name, values) in zip(keys, sorted(lists.items()), strict=True)
    }
    defaults = jax.tree.map(lambda x: jnp.full(number, x), hyperparameters)
    return defaults.replace(**drawn)
