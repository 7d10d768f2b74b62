"""What an agent is trained with, once: `AgentSpec`, and the registry of algorithms that it is made from.

`bandit_agent` is the paper's inner loop, whose hyperparameters are drawn from lists; `environment_agent`
trains in an environment itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
from gymnax.environments import spaces

from scb.agents.agent import Agent
from scb.agents.tables import ACTIVATIONS, TABLES, Lists, Setting, Tables, Values
from scb.agents.values import check_value, check_values
from scb.curriculum import with_limit
from scb.environments.registry import environment_spec
from scb.errors import UserError, at_least, one_of
from scb.keys import split_key
from scb.spaces import kind_of_actions

# {name: its tables, with the algorithm itself}. In the order that lists and pages name them in.
ALGORITHMS: dict[str, Tables] = {tables.algorithm.name: tables for tables in TABLES}


@dataclass(frozen=True)
class AgentSpec:
    """What an agent is trained with: everything about it but its environment.

    Attributes:
      algorithm: one of `ALGORITHMS`.
      config: static configuration, which decides shapes and program.
      hyperparameters: traced numbers.
      lists: {hyperparameter: values} that each agent's are drawn from; what has no list is as in
        `hyperparameters`.
      episode_limit: steps after which an episode of the training is cut; None for the environment's
        own limit.
      source: where the values come from.

    Raises:
      UserError: an unknown algorithm, or a list that cannot be drawn from.
    """

    algorithm: str
    config: Any
    hyperparameters: Any
    lists: Lists = field(default_factory=dict)
    episode_limit: int | None = None
    source: str = ""

    def __post_init__(self) -> None:
        tables_of(self.algorithm)
        check_lists(self.lists, self.hyperparameters)

    def agent(self, env: Any, drift: Any = None) -> Agent:
        """The agent in an environment; `drift` takes the place of PPO's own."""
        arguments = {} if drift is None else {"drift": drift}
        return tables_of(self.algorithm).algorithm.agent(env, self.config, **arguments)

    @property
    def steps(self) -> int:
        """Environment steps of one training."""
        return int(self.config.num_environment_steps)

    def training_params(self, env_params: Any) -> Any:
        """The environment's parameters with the limit of the training's episodes."""
        return (
            env_params if self.episode_limit is None else with_limit(env_params, self.episode_limit)
        )

    def sample(self, key: jax.Array, number: int) -> Any:
        """Hyperparameters for `number` agents, every leaf [N], uniform and independent, dealt evenly.

        Each agent's draw is uniform, but agents share the values out: of four agents and four
        learning rates each has another (a Latin hypercube). A mean over few agents then depends less
        on who drew what.
        """

        def deal(key: jax.Array, values: Sequence[float]) -> jax.Array:
            key_order, key_offset = split_key(key)
            order = jax.random.permutation(key_order, number)
            offset = jax.random.randint(key_offset, (), 0, len(values))
            return jnp.asarray(values, jnp.float32)[(order + offset) % len(values)]

        keys = split_key(key, len(self.lists))
        drawn = {
            name: deal(k, values)
            for k, (name, values) in zip(keys, sorted(self.lists.items()), strict=True)
        }
        return self.repeated(number).replace(**drawn)

    def repeated(self, number: int) -> Any:
        """The hyperparameters of `number` agents that all have these, every leaf [N, ...]."""
        return jax.tree.map(lambda x: jnp.full((number, *jnp.shape(x)), x), self.hyperparameters)

    def with_values(self, **values: Any) -> "AgentSpec":
        """With other values of static or traced fields; those that are None stay as they are.

        Raises:
          UserError: an unknown field, or a number that an agent cannot take.
        """
        values = {name: value for name, value in values.items() if value is not None}
        static, traced = ([f.name for f in fields(x)] for x in (self.config, self.hyperparameters))
        for name in values:
            if name not in (*static, *traced):
                raise UserError(
                    f"{self.algorithm} has no {name}: known are {', '.join((*static, *traced))}."
                )
        # A drift's own may be any numbers, but what is given as one is PPO's clip.
        if isinstance(clip := values.get("drift"), int | float | str):
            check_value("drift", clip)
        config = configured(self.config, {k: v for k, v in values.items() if k in static})
        changed = {k: v for k, v in values.items() if k in traced}
        hyperparameters = replace(self.hyperparameters, **changed)
        check_values(hyperparameters)
        return replace(self, config=config, hyperparameters=hyperparameters)

    def with_steps(self, steps: int | None) -> "AgentSpec":
        """Trained for another number of environment steps; as it is where that is None."""
        at_least(1, steps=steps)
        return self.with_values(total_steps=steps)

    def on_bandit(self, contexts: int, minibatches: int | None = None) -> "AgentSpec":
        """PPO's setting for an environment as it is on a bandit, `contexts` of them a batch.

        The number of updates (iterations, epochs, minibatches) stays that of the environment's
        setting, so that an objective meets the regime in which it will be used, while a batch holds a
        fraction of the transitions: contexts are independent, consecutive steps are not.

        Args:
          minibatches: of a batch; None for as many as in the environment.

        Raises:
          UserError: they don't divide so many contexts.
        """
        minibatches = self.config.num_minibatches if minibatches is None else minibatches
        if minibatches > 0 and contexts % minibatches:
            raise UserError(
                f"contexts is {contexts}, and a batch is cut into {minibatches} equal minibatches here: take a "
                f"multiple of {minibatches}."
            )
        return self.with_values(
            num_envs=contexts,
            num_steps=1,
            total_steps=contexts * self.config.num_iterations,
            num_minibatches=minibatches,
            normalize_observations=False,
        )


def bandit_agent(algorithm: str, environment: str, sampled: bool = True) -> AgentSpec:
    """The paper's inner loop: an algorithm in the bandit of an environment.

    Networks are tanh, but ReLU for Pendulum. Hyperparameters are drawn in classic control (PPO's
    without the learning rate 0.01 where actions are continuous), and fixed in Brax.

    Args:
      algorithm: one of `ALGORITHMS`.
      environment: the evaluation environment's name.
      sampled: False for the paper's underlined values everywhere.
    """
    kind = _kind_of_actions_in(environment)
    check_algorithms([algorithm], kind)
    tables, family = ALGORITHMS[algorithm], environment_spec(environment).family
    lists = dict(tables.lists) if sampled and family not in tables.families else {}
    if lists and kind == "continuous":
        lists |= tables.continuous
    values = {"activation": ACTIVATIONS.get(environment), **tables.families.get(family, {})}
    source = f"Liesen et al. (2024), table of {algorithm.upper()} in the inner loop"
    return _default(tables, lists=lists, source=source).with_values(**values)


def environment_agent(algorithm: str, environment: str) -> AgentSpec:
    """An algorithm in an environment itself; on general values where it has none of its own for it.

    PPO's general values are the inner loop's with ten times the steps; the off-policy algorithms'
    take one gradient step an environment step, with slowly moving targets.
    """
    tables = tables_of(algorithm)
    row = _own_row(tables, environment) or tables.general
    spec = _default(tables, episode_limit=row.episode_limit, source=row.source)
    return spec.with_values(**row.values)


def has_values_for(algorithm: str, environment: str) -> bool:
    """Whether an algorithm is trained with values of its own in an environment, not with general ones."""
    return _own_row(tables_of(algorithm), environment) is not None


def _own_row(tables: Tables, environment: str) -> Setting | None:
    rows = tables.environments
    return rows.get(environment) or rows.get(environment_spec(environment).family)


def _default(tables: Tables, **arguments: Any) -> AgentSpec:
    algorithm = tables.algorithm
    return AgentSpec(algorithm.name, algorithm.config(), algorithm.hyperparameters(), **arguments)


def tables_of(algorithm: str) -> Tables:
    """What the registry holds of an algorithm; a UserError where it holds none of that name."""
    one_of("algorithm", algorithm, ALGORITHMS)
    return ALGORITHMS[algorithm]


def algorithms_for(space: spaces.Box | spaces.Discrete | None = None) -> tuple[str, ...]:
    """The inner loop's algorithms where none are named, for an action space or for any."""
    return tuple(
        name
        for name, tables in ALGORITHMS.items()
        if tables.by_default
        and (space is None or kind_of_actions(space) in tables.algorithm.actions)
    )


def check_algorithms(names: Sequence[str], kind: str) -> None:
    """Raises a UserError for an empty list, an unknown name, or one that doesn't fit the kind of actions."""
    fitting = [name for name, tables in ALGORITHMS.items() if kind in tables.algorithm.actions]
    if not names:
        raise UserError(
            f"the list of algorithms is empty: give one or more of {', '.join(fitting)}."
        )
    for name in names:
        tables_of(name)
        if name not in fitting:
            raise UserError(
                f"{name} does not fit the environment's {kind} actions: use {', '.join(fitting)}."
            )


def configured(config: Any, values: Values) -> Any:
    """A static configuration with other values of some fields, sequences as tuples.

    Raises:
      UserError: it has no such field, or the field cannot have the value.
    """
    known = [f.name for f in fields(config)]
    given = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    for name in given:
        one_of("field of a configuration", name, known)
    return replace(config, **given)


def check_lists(lists: Lists, hyperparameters: Any) -> None:
    """Raises a UserError for an unknown hyperparameter, no list or an empty one, or a value that none can have."""
    known = [f.name for f in fields(hyperparameters)]
    for name, values in lists.items():
        if name not in known:
            raise UserError(f"unknown hyperparameter {name!r}: known are {', '.join(known)}.")
        if not isinstance(values, Sequence) or not values:
            raise UserError(
                f"{name} has {values!r} for a list of values: give one or more numbers."
            )
        for value in values:
            check_value(name, value)


@cache
def _kind_of_actions_in(environment: str) -> str:
    env, env_params = environment_spec(environment).make()
    return kind_of_actions(env.action_space(env_params))
