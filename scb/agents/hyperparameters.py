"""The paper's hyperparameter tables (appendix "Hyperparameters"), once, as data."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from gymnax.environments import spaces

from scb.agents.ppo import PPOConfig, PPOHyperparameters
from scb.errors import UserError

# Table "Hyperparameters for PPO in the inner loop", classic control. `drift` is the clip epsilon.
PPO_INNER_LOOP: dict[str, tuple[float, ...]] = {
    "learning_rate": (0.01, 0.005, 0.001, 0.0005, 0.0001),
    "discount": (1.0, 0.99, 0.95, 0.9, 0.8),
    "gae_lambda": (1.0, 0.95, 0.9, 0.8, 0.5),
    "drift": (0.1, 0.2, 0.3, 0.4, 0.5),
    "entropy_coefficient": (0.0, 0.01, 0.05, 0.1, 0.5),
    "value_coefficient": (0.0, 0.5, 1.0, 1.5, 2.0),
}


def inner_loop_lists(space: spaces.Box | spaces.Discrete) -> dict[str, tuple[float, ...]]:
    """The lists for an action space: the paper drops the learning rate 0.01 where actions are continuous."""
    lists = dict(PPO_INNER_LOOP)
    if not isinstance(space, spaces.Discrete):
        lists["learning_rate"] = tuple(x for x in lists["learning_rate"] if x < 0.01)
    return lists


def inner_loop_config(evaluation_environment: str) -> PPOConfig:
    """The paper's static inner-loop configuration: tanh networks, but ReLU for Pendulum."""
    activation = "relu" if evaluation_environment == "Pendulum-v1" else "tanh"
    return PPOConfig(activation=activation)


def sample_hyperparameters(
    key: jax.Array, lists: Mapping[str, Sequence[float]], number: int
) -> PPOHyperparameters:
    """Hyperparameters for `number` agents, uniform and independent per hyperparameter, dealt evenly.

    Each agent's draw is uniform, but agents share the values out: of four agents and four learning
    rates each has another (a Latin hypercube). A mean over few agents then depends less on who drew
    what.

    Args:
      key: decides the draw.
      lists: {field of PPOHyperparameters: values}; fields left out keep their defaults.
      number: N agents.

    Returns:
      PPOHyperparameters whose every leaf is [N].
    """
    known = PPOHyperparameters.__dataclass_fields__
    for name, values in lists.items():
        if name not in known:
            raise UserError(f"unknown hyperparameter {name!r}: known are {', '.join(known)}.")
        if not values:
            raise UserError(f"the list of values for {name} is empty: give at least one.")

    def deal(key: jax.Array, values: Sequence[float]) -> jax.Array:
        key_order, key_offset = jax.random.split(key)
        order = jax.random.permutation(key_order, number)
        offset = jax.random.randint(key_offset, (), 0, len(values))
        return jnp.asarray(values, jnp.float32)[(order + offset) % len(values)]

    keys = jax.random.split(key, len(lists))
    drawn = {
        name: deal(k, values) for k, (name, values) in zip(keys, sorted(lists.items()), strict=True)
    }
    defaults = jax.tree.map(lambda x: jnp.full(number, x), PPOHyperparameters())
    return defaults.replace(**drawn)


@dataclass(frozen=True)
class Setting:
    """A PPO setting: static configuration, hyperparameters, where it comes from."""

    config: PPOConfig
    hyperparameters: PPOHyperparameters
    source: str


def _brax_expert(**values: Any) -> Setting:
    return Setting(
        PPOConfig(
            num_envs=values["num_envs"],
            num_steps=values["num_steps"],
            num_epochs=values["num_epochs"],
            num_minibatches=values["num_minibatches"],
            total_steps=5 * 2**20,
            activation="tanh",
            normalize_observations=True,
        ),
        PPOHyperparameters(
            learning_rate=values["learning_rate"],
            discount=values["discount"],
            gae_lambda=values["gae_lambda"],
            max_grad_norm=values["max_grad_norm"],
        ),
        source="Liesen et al. (2024), table of PPO expert hyperparameters",
    )


def _second_expert() -> Setting:
    # Walker2d, Halfcheetah and Humanoidstandup share one column of values in the table.
    return _brax_expert(
        num_envs=32,
        num_steps=32,
        num_epochs=2,
        num_minibatches=2,
        learning_rate=1.7e-3,
        discount=0.99,
        gae_lambda=0.8,
        max_grad_norm=5.0,
    )


def environment_settings() -> dict[str, Setting]:
    """PPO settings for training in an environment itself: {environment: Setting}."""
    return {
        "Pendulum-v1": Setting(
            PPOConfig(num_envs=100, num_steps=100, total_steps=150_000, activation="relu"),
            PPOHyperparameters(learning_rate=1e-3, discount=0.995),
            source="a public tuned setting for Pendulum; network and minibatches as in the inner loop",
        ),
        "hopper": _brax_expert(
            num_envs=32,
            num_steps=32,
            num_epochs=9,
            num_minibatches=2,
            learning_rate=2.5e-4,
            discount=0.995,
            gae_lambda=0.95,
            max_grad_norm=1.0,
        ),
        "walker2d": _second_expert(),
        "halfcheetah": _second_expert(),
        "humanoidstandup": _second_expert(),
        "swimmer": _brax_expert(
            num_envs=128,
            num_steps=64,
            num_epochs=7,
            num_minibatches=8,
            learning_rate=2.8e-3,
            discount=0.98,
            gae_lambda=0.99,
            max_grad_norm=0.5,
        ),
    }


def environment_setting(name: str) -> Setting:
    """The setting for an environment; for one without its own, the inner loop's with ten times the steps."""
    settings = environment_settings()
    if name in settings:
        return settings[name]
    return Setting(
        PPOConfig(num_envs=10, num_steps=100, total_steps=100_000),
        PPOHyperparameters(learning_rate=1e-3),
        source="the inner loop's values, 10 environments, 100 000 steps",
    )
