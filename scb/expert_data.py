"""What an expert does, and what actions are worth, in states that it takes part in visiting."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
from gymnax.environments import spaces
from jax.tree_util import Partial

from scb.aggregation import TRAJECTORIES, Visited, trajectory
from scb.errors import at_least, fraction, one_of, positive, unused
from scb.experts import Expert
from scb.fitting import CONSTRUCTIONS, ExpertDataset, unchanging
from scb.keys import named_key, split_key
from scb.linear_expert import erring, noisy
from scb.measurement import Place
from scb.spaces import flat_size


@dataclass(frozen=True)
class DatasetConfig:
    """The states that a bandit is fitted on, and what is asked there.

    Attributes:
      construction: the reward's target, divided by its standard deviation. "advantage": Q(s, a) - max_a Q(s, a);
        "q": Q - mean; "action_distance": -||a - a*|| (discrete: 1 where a = a*), a* the expert's mode
        action, which the form linear has in halves of the actions' range and undivided.
      expert_noise: standard deviation of Gaussian noise on the expert's actions, as a share of half their
        range: where a linear search looks for it, so that it bears the errors of agents that learn
        from the bandit, and on the trajectories whose states the bandit's contexts are fitted to. With 0
        those mix expert and random actions.
      expert_errors: the scale of errors that are a function of the observation, as a share of half the
        actions' range: where a linear search looks for the expert, and on the same trajectories. Each
        episode has a function of its own, an untrained network of an agent's size. An agent that learned
        too little errs so, and not anew at every step.
      min_spread: entries of the observation whose standard deviation is smaller are stretched about
        their mean until they have it, and the expert says what it does there; 0 for the states as
        they are. One that never changes stays. Agents learn little from an entry as small as a car's velocity.
        For action_distance only: Q-values cannot be simulated from states that don't exist.
      stretch: factor on the states' deviations from their mean, after that; the expert says what it does
        there. Agents that meet more than they need learn better what they need. For action_distance only, or for
        the contexts of a linear bandit that a search starts from.
      jitter: standard deviation of independent noise on every entry of the states, in deviations of the
        entry before it is stretched; the expert says what it does there. Entries hang together along the expert's
        trajectories, and agents that err leave these. For the same as stretch.
      discount: of the Q-function.
      num_states: states that the dataset holds.
      num_actions: actions that are tried in each of them, uniform but for the expert's.
      horizon: steps after which a Monte-Carlo return is cut off.
    """

    construction: str = "action_distance"
    expert_noise: float = 0.0
    expert_errors: float = 0.0
    min_spread: float = 0.0
    stretch: float = 1.0
    jitter: float = 0.0
    discount: float = 0.95
    num_states: int = 4096
    num_actions: int = 16
    horizon: int = 100

    def __post_init__(self) -> None:
        one_of("warm-start construction", self.construction, CONSTRUCTIONS)
        at_least(0, self, "min_spread", "jitter", "expert_noise", "expert_errors")
        at_least(1, self, "num_states", "horizon")
        # Of the expert's alone there would be no reward to tell from another.
        at_least(2, self, "num_actions")
        positive(self, "stretch")
        fraction(self, "discount")
        distance = self.construction == "action_distance"
        unused(
            self,
            f"the construction {self.construction} cannot use it",
            ("discount", "horizon") if distance else ("min_spread", "stretch", "jitter"),
            "take advantage or q" if distance else "take action_distance",
        )

    @property
    def erring(self) -> bool:
        """Whether the expert's trajectories are of its own actions with errors."""
        return self.expert_noise > 0 or self.expert_errors > 0


def expert_dataset(
    expert: Expert, place: Place, key: jax.Array, config: DatasetConfig
) -> tuple[ExpertDataset, int]:
    """What an expert does, and what actions are worth, in states of trajectories that it takes part in.

    They mix expert and random actions, each with its own proportion, so that they cover what an agent
    meets on its way to becoming an expert, or are the expert's with its noise and errors.

    Returns:
      (the dataset, environment steps it took).
    """
    key_roll, key_pick, _, key_label = split_key(key, 4)
    acting = expert.reaching if config.erring and expert.reaching else expert.policy
    policy = acting if isinstance(acting, Partial) else Partial(acting)
    visited = _trajectories(place, config)(policy, split_key(key_roll, TRAJECTORIES))
    return labelled(expert, place, visited, key_pick, key_label, config)


@lru_cache(maxsize=2)  # physics take long to compile, and a search asks it of many policies
def _trajectories(place: Place, config: DatasetConfig) -> Callable[[Partial, jax.Array], Visited]:
    """(policy, [N] keys) -> [N, T, ...] states that it takes part in visiting."""
    space = place.env.action_space(place.params)
    size = flat_size(place.env.observation_space(place.params))

    def roll(policy: Partial, key: jax.Array) -> Visited:
        key_reset, key_skill, key_steps = split_key(key, 3)
        skill = jax.random.uniform(key_skill)
        if config.erring:
            assert not isinstance(space, spaces.Discrete)
            off = erring(policy, size, space, config.expert_errors, key)
            off_each_step = noisy(off, space, config.expert_noise)

        def act(observation: jax.Array, keys: jax.Array) -> jax.Array:
            if config.erring:
                return off_each_step(observation, keys[0])
            return jnp.where(
                jax.random.uniform(keys[1]) < skill,
                policy(jnp.ravel(observation)),
                space.sample(keys[0]),
            )

        return trajectory(place, act, key_reset, key_steps)

    return jax.jit(jax.vmap(roll, in_axes=(None, 0)))


def labelled(
    expert: Expert,
    place: Place,
    visited: Visited,
    key_pick: jax.Array,
    key_label: jax.Array,
    config: DatasetConfig,
) -> tuple[ExpertDataset, int]:
    """What the expert does, and what actions are worth, in `num_states` of [N, T, ...] states.

    Q-values are by simulation: from a stored state take an action once, then follow the expert. All
    actions of a state share one key: their differences are exact where the environment is
    deterministic.

    Returns:
      (the dataset, environment steps that the states and the simulations took).
    """
    space, number = place.env.action_space(place.params), config.num_states
    total = visited.observation.shape[0] * visited.observation.shape[1]
    chosen = jax.random.choice(key_pick, total, (number,), replace=number > total)
    states = jax.tree.map(lambda x: jnp.reshape(x, (-1, *x.shape[2:]))[chosen], visited)
    # Of bools, or of whole numbers, a fit asks for means too.
    floats = jnp.promote_types(states.observation.dtype, jnp.float32)
    states = states._replace(observation=states.observation.astype(floats))

    def expert_policy(observation: jax.Array) -> jax.Array:
        return expert.policy(jnp.ravel(observation))

    def q_value(env_state: Any, action: jax.Array, key: jax.Array) -> jax.Array:
        def follow(carry: Any, key: jax.Array) -> Any:
            env_state, action, weight = carry
            observation, env_state, reward, terminated, _ = place.env.step_env(
                key, env_state, action, place.params
            )
            reward = jnp.reshape(reward, ()) * weight
            weight = weight * config.discount * (1.0 - terminated)
            return (env_state, expert_policy(observation), weight), reward

        start = (env_state, action, jnp.float32(1.0))
        return jax.lax.scan(follow, start, split_key(key, config.horizon))[1].sum()

    @jax.jit
    @jax.vmap
    def label(env_state: Any, observation: jax.Array, key: jax.Array) -> Any:
        key_random, key_follow = split_key(key)
        best = jnp.reshape(expert_policy(observation), space.shape)
        if isinstance(space, spaces.Discrete):
            actions = jnp.arange(space.n)
        else:
            random = jax.vmap(space.sample)(split_key(key_random, config.num_actions - 1))
            actions = jnp.concatenate([best[None], random])
        if config.construction == "action_distance":
            q = jnp.zeros(actions.shape[0])  # it only asks what the expert does
        else:
            q = jax.vmap(q_value, in_axes=(None, 0, None))(env_state, actions, key_follow)
        return actions, q, best

    observations = states.observation
    if config.min_spread > 0 or config.stretch != 1 or config.jitter > 0:
        observations = _stretched(observations, named_key(key_label, "jitter"), config)
    actions, q, best = label(states.env_state, observations, split_key(key_label, number))
    dataset = ExpertDataset(jnp.reshape(observations, (number, -1)), actions, q, best)
    if config.construction != "action_distance":
        total += number * actions.shape[1] * config.horizon
    return dataset, total


def _stretched(observations: jax.Array, key: jax.Array, config: DatasetConfig) -> jax.Array:
    """[S, O] states whose every entry has the least deviation, stretched and jittered."""
    flat = jnp.reshape(observations, (observations.shape[0], -1))
    mean, std = flat.mean(axis=0), flat.std(axis=0)
    spread = jnp.maximum(1.0, config.min_spread / (std + 1e-8))
    # An entry that never changes has a deviation by rounding alone, which is nothing to stretch.
    spread = jnp.where(unchanging(flat), 1.0, spread)
    stretched = mean + (flat - mean) * (config.stretch * spread)
    if config.jitter:
        stretched += config.jitter * std * spread * jax.random.normal(key, flat.shape)
    return stretched
