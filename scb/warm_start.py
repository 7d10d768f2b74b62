"""Fit a bandit to an expert before evolving it.

The paper's lemma: a bandit whose reward is the expert's Q-function, on contexts that cover the
expert's states, has the expert's policy as its optimum. Regression finds such a bandit in a minute;
what it cannot know is which of them *trains* well, and that is what evolution is for.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from gymnax.environments import environment, spaces

from scb.agents.spec import (
    ALGORITHMS,
    AgentSpec,
    check_algorithms,
    environment_agent,
    has_values_for,
    kind_of_actions,
)
from scb.agents.tables import WARM_START
from scb.curriculum import paper_curriculum
from scb.environments.linear import fitted
from scb.environments.registry import environment_spec
from scb.environments.synthetic import BanditParams, SyntheticBandit, Weights
from scb.errors import UserError, at_least, one_of, positive
from scb.experts import Expert, PolicySearchConfig, evolve_expert, train_expert
from scb.keys import named_key, split_key
from scb.linear_expert import LinearSearchConfig, noisy, search_linear_expert

CONSTRUCTIONS = ("advantage", "q", "action_distance")


def _evolved(
    name: str, env: Any, env_params: Any, key: jax.Array, config: "WarmStartConfig"
) -> Expert:
    search, generations = PolicySearchConfig(), config.expert_generations
    search = replace(
        search,
        curriculum=paper_curriculum(name, generations),
        evolution=replace(search.evolution, num_generations=generations),
    )
    return evolve_expert(env, env_params, search, key)


def _linear(
    name: str, env: Any, env_params: Any, key: jax.Array, config: "WarmStartConfig"
) -> Expert:
    standing = environment_spec(name).standing_still() or 0.0
    bonus = standing / env_params.max_steps_in_episode
    search = LinearSearchConfig(config.expert_generations)
    if config.expert_noise:
        # Where actions err anyway a larger step is no more noise, and finds gains that bear errors.
        search = replace(search, sigma=0.15, learning_rate=0.09, action_noise=config.expert_noise)
    return search_linear_expert(env, env_params, key, search, bonus)


class _Search(NamedTuple):
    """What finds experts that are no agents: in words, how, and whether actions must be continuous."""

    what: str
    find: Callable[[str, Any, Any, jax.Array, "WarmStartConfig"], Expert]
    continuous: bool = False


SEARCHES = {
    "evolution": _Search("evolution", _evolved),
    "linear": _Search("a linear search", _linear, continuous=True),
}


@dataclass(frozen=True)
class WarmStartConfig:
    """How the expert is trained and the bandit is fitted.

    Attributes:
      construction: the reward's target. "advantage": (Q(s, a) - max_a Q(s, a)) / std; "q": (Q -
        mean) / std; "action_distance": -||a - a*|| (discrete: 1 where a = a*), a* the expert's mode
        action.
      expert: the algorithm that finds it: one of the agents' ("ppo", "sac", ...), "evolution" of a
        small policy network, or "linear", augmented random search for a linear policy, which a bandit
        holds better than a network. "auto" takes PPO where the environment has a setting of its own
        for it, and evolution elsewhere.
      num_experts: agents trained on the environment; the best of them is the expert.
      expert_steps: environment steps of each; the environment's own setting where None.
      expert_generations: of the evolution or the linear search, where that finds the expert.
      expert_noise: standard deviation of Gaussian noise on the expert's actions, as a share of half their
        range: where a linear search looks for it, so that it bears the errors of agents that learn
        from the bandit, and on the trajectories whose states the bandit's contexts are fitted to. With 0
        those mix expert and random actions.
      min_spread: entries of the observation whose standard deviation is smaller are stretched about
        their mean until they have it, and the expert says what it does there; 0 for the states as
        they are. Agents learn little from an entry as small as a car's velocity. For
        "action_distance" only: Q-values cannot be simulated from states that don't exist.
      stretch: factor on the states' deviations from their mean, after that; the expert says what it does
        there. Agents that meet more than they need learn better what they need. For
        "action_distance" only.
      discount: of the Q-function.
      num_states: states that the dataset holds.
      num_actions: actions that are tried in each of them, uniform but for the expert's.
      near_actions: of those, how many lie about the expert's, with a standard deviation of 0.15 of
        their range.
      horizon: steps after which a Monte-Carlo return is cut off.
      fit_steps: Adam steps of each regression.
    """

    construction: str = "action_distance"
    expert: str = "auto"
    num_experts: int = 8
    expert_steps: int | None = None
    expert_generations: int = 80
    expert_noise: float = 0.0
    min_spread: float = 0.0
    stretch: float = 1.0
    discount: float = 0.95
    num_states: int = 4096
    num_actions: int = 16
    near_actions: int = 0
    horizon: int = 100
    fit_steps: int = 4000

    def __post_init__(self) -> None:
        one_of("warm-start construction", self.construction, CONSTRUCTIONS)
        experts = ("auto", *SEARCHES, *ALGORITHMS)
        one_of("expert", self.expert, experts)
        at_least(0, self, "min_spread", "expert_noise", "near_actions")
        if not 0 <= self.discount <= 1:
            raise UserError(f"discount is {self.discount}: it must be between 0 and 1.")
        positive(self, "stretch")
        for field, none in (("min_spread", 0), ("stretch", 1)):
            value = getattr(self, field)
            if value != none and self.construction != "action_distance":
                raise UserError(
                    f"{field} is {value}, which the construction {self.construction} cannot use: "
                    f"take action_distance, or a {field} of {none}."
                )
        at_least(1, self, "num_experts", "num_states", "num_actions")
        at_least(1, self, "horizon", "fit_steps", "expert_generations")
        if self.near_actions >= self.num_actions:
            raise UserError(
                f"near_actions is {self.near_actions} of {self.num_actions} actions, one of them the expert's: take "
                f"at most {self.num_actions - 1}."
            )


class ExpertDataset(NamedTuple):
    """States that agents of mixed skill visit, with the expert's Q-values of random actions there."""

    observation: jax.Array  # [S, O]
    action: jax.Array  # [S, K, ...]
    q: jax.Array  # [S, K]; zeros for "action_distance", which needs none
    expert_action: jax.Array  # [S, ...]


def expert_agent(
    name: str, space: spaces.Box | spaces.Discrete, config: WarmStartConfig
) -> AgentSpec | None:
    """How the expert of an environment is trained; None where a search finds it.

    Raises:
      UserError: an expert that doesn't fit the action space, or steps that it can't be trained for.
    """
    if isinstance(space, spaces.Discrete) and (config.expert_noise or config.near_actions):
        raise UserError(
            f"expert_noise and near_actions are of continuous actions, and {name} has discrete ones: leave them out."
        )
    algorithm = _chosen(name, config)
    if algorithm in SEARCHES:
        search = SEARCHES[algorithm]
        if search.continuous and isinstance(space, spaces.Discrete):
            raise UserError(
                f"the expert of {search.what} has continuous actions and {name} discrete ones: choose evolution, or "
                "an algorithm."
            )
        if config.expert_steps is not None:
            raise UserError(
                f"expert_steps is {config.expert_steps}, but {search.what} finds the expert of {name} "
                "and trains no agent: leave it out, or choose an algorithm for the expert."
            )
        return None
    check_algorithms([algorithm], kind_of_actions(space))
    spec = environment_agent(algorithm, name).with_values(**WARM_START.get((algorithm, name), {}))
    return spec.with_values(total_steps=config.expert_steps)


def _chosen(name: str, config: WarmStartConfig) -> str:
    if config.expert != "auto":
        return config.expert
    return "ppo" if has_values_for("ppo", name) else "evolution"


def find_expert(
    name: str,
    env: environment.Environment[Any, Any],
    env_params: Any,
    key: jax.Array,
    config: WarmStartConfig,
) -> Expert:
    """An expert for an environment, by name as `scb.make` takes it."""
    spec = expert_agent(name, env.action_space(env_params), config)
    if spec is None:
        search = SEARCHES[_chosen(name, config)]
        return search.find(name, env, env_params, key, config)
    return train_expert(env, env_params, spec, key, config.num_experts)


def expert_dataset(
    expert: Expert,
    env: environment.Environment[Any, Any],
    env_params: Any,
    key: jax.Array,
    config: WarmStartConfig,
) -> tuple[ExpertDataset, int]:
    """Q-values by simulation: from a stored state take an action once, then follow the expert.

    States come from trajectories that mix expert and random actions, each with its own proportion,
    so that they cover what an agent meets on its way to becoming an expert, or from the expert's with
    `expert_noise`. All actions of a state
    share one key: their differences are exact where the environment is deterministic.

    Returns:
      (the dataset, environment steps it took).
    """
    space, noise = env.action_space(env_params), config.expert_noise
    key_roll, key_pick, _, key_q = split_key(key, 4)

    def expert_policy(observation: jax.Array) -> jax.Array:
        return expert.policy(jnp.ravel(observation))

    num_envs = 256
    num_steps = min(200, int(env_params.max_steps_in_episode))

    def step(carry: Any, key: jax.Array) -> Any:
        env_state, observation, skill = carry
        key_random, key_mix, key_step = split_key(key, 3)
        if noise:
            assert not isinstance(space, spaces.Discrete)
            action = noisy(expert.policy, space, noise)(observation, key_random)
        else:
            random_action = space.sample(key_random)
            action = jnp.where(
                jax.random.uniform(key_mix) < skill, expert_policy(observation), random_action
            )
        next_observation, next_state, *_ = env.step(key_step, env_state, action, env_params)
        return (next_state, next_observation, skill), (env_state, observation)

    def roll(key: jax.Array) -> Any:
        key_reset, key_skill, key_steps = split_key(key, 3)
        observation, env_state = env.reset(key_reset, env_params)
        start = (env_state, observation, jax.random.uniform(key_skill))
        return jax.lax.scan(step, start, split_key(key_steps, num_steps))[1]

    visited = jax.jit(jax.vmap(roll))(split_key(key_roll, num_envs))
    picked = jax.random.choice(
        key_pick,
        num_envs * num_steps,
        (config.num_states,),
        replace=config.num_states > num_envs * num_steps,
    )
    env_states, observations = jax.tree.map(
        lambda x: jnp.reshape(x, (-1, *x.shape[2:]))[picked], visited
    )

    def q_value(env_state: Any, action: jax.Array, key: jax.Array) -> jax.Array:
        def follow(carry: Any, key: jax.Array) -> Any:
            env_state, action, weight = carry
            observation, env_state, reward, terminated, _ = env.step_env(
                key, env_state, action, env_params
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
        key_near = named_key(key, "near")
        best = jnp.reshape(expert_policy(observation), space.shape)
        if isinstance(space, spaces.Discrete):
            actions = jnp.arange(space.n)
        else:
            number = config.num_actions - 1
            random = jax.vmap(space.sample)(split_key(key_random, number))
            if config.near_actions:
                about = noisy(expert.policy, space, 0.3)
                near = jax.vmap(about, in_axes=(None, 0))(observation, split_key(key_near, number))
                which = jnp.arange(number) < config.near_actions
                random = jnp.where(jnp.expand_dims(which, range(1, random.ndim)), near, random)
            actions = jnp.concatenate([best[None], random])
        if config.construction == "action_distance":
            q = jnp.zeros(actions.shape[0])  # it only asks what the expert does
        else:
            q = jax.vmap(q_value, in_axes=(None, 0, None))(env_state, actions, key_follow)
        return actions, q, best

    actions, q, best = label(env_states, observations, split_key(key_q, config.num_states))
    if config.min_spread > 0 or config.stretch != 1:
        observations, best = _stretched(observations, config, expert_policy)
        best = jnp.reshape(best, (config.num_states, *space.shape))
        if not isinstance(space, spaces.Discrete):
            actions = actions.at[:, 0].set(best)
    dataset = ExpertDataset(jnp.reshape(observations, (config.num_states, -1)), actions, q, best)
    steps = num_envs * num_steps
    if config.construction != "action_distance":
        steps += config.num_states * actions.shape[1] * config.horizon
    return dataset, steps


def _stretched(
    observations: jax.Array, config: WarmStartConfig, policy: Callable[[jax.Array], jax.Array]
) -> tuple[jax.Array, jax.Array]:
    """[S, O] states whose every entry has at least the least deviation, stretched; and what the expert does there."""
    flat = jnp.reshape(observations, (observations.shape[0], -1))
    mean, std = flat.mean(axis=0), flat.std(axis=0)
    factors = config.stretch * jnp.maximum(1.0, config.min_spread / (std + 1e-8))
    stretched = mean + (flat - mean) * factors
    return stretched, jax.jit(jax.vmap(policy))(stretched)


def reward_targets(dataset: ExpertDataset, construction: str, discrete: bool) -> jax.Array:
    """[S, K] what the bandit's reward should be, of unit standard deviation."""
    if construction == "action_distance":
        best = jnp.expand_dims(dataset.expert_action, 1)
        if discrete:
            target = (dataset.action == best).astype(jnp.float32)
        else:
            difference = jnp.reshape(dataset.action - best, (*dataset.q.shape, -1))
            target = -jnp.linalg.norm(difference, axis=-1)
    elif construction == "q":
        target = dataset.q - dataset.q.mean()
    else:
        target = dataset.q - dataset.q.max(axis=1, keepdims=True)
    return target / (target.std() + 1e-8)


def fit_bandit(
    bandit: SyntheticBandit, dataset: ExpertDataset, key: jax.Array, config: WarmStartConfig
) -> tuple[Weights, dict[str, float]]:
    """Regresses the reward network, and matches the contexts' distribution to the dataset's states.

    The reward by least squares; the contexts by the energy distance between generated and stored
    states, which is zero only where the two distributions are equal.

    Returns:
      (weights, {"reward_r2": explained variance of the reward, "energy_distance": of the
      contexts}).
    """
    if bandit.linear:
        return _fit_linear(bandit, dataset, config)
    key_init, key_reward, key_context = split_key(key, 3)
    weights = bandit.init_weights(key_init)
    target = reward_targets(dataset, config.construction, bandit.discrete)
    optimizer = optax.adam(optax.cosine_decay_schedule(5e-3, config.fit_steps))
    num_states = dataset.observation.shape[0]
    scale = dataset.observation.std(axis=0) + 1e-6

    def reward_loss(reward_weights: Any, index: jax.Array, _: jax.Array) -> jax.Array:
        params = BanditParams(weights={"initial_state": {}, "reward": reward_weights})
        predict = jax.vmap(
            jax.vmap(bandit.mean_reward, in_axes=(None, 0, None)), in_axes=(0, 0, None)
        )
        predicted = predict(dataset.observation[index], dataset.action[index], params)
        return jnp.mean((predicted - target[index]) ** 2)

    def context_loss(state_weights: Any, index: jax.Array, key: jax.Array) -> jax.Array:
        params = BanditParams(weights={"initial_state": state_weights, "reward": {}})
        generated, _ = jax.vmap(bandit.reset_env, in_axes=(0, None))(
            split_key(key, index.shape[0]), params
        )
        return energy_distance(generated / scale, dataset.observation[index] / scale)

    @partial(jax.jit, static_argnums=0)
    def fit(loss: Any, start: Any, key: jax.Array) -> tuple[Any, jax.Array]:
        def step(carry: Any, key: jax.Array) -> Any:
            weights, state = carry
            key_index, key_loss = split_key(key)
            index = jax.random.randint(key_index, (256,), 0, num_states)
            value, gradient = jax.value_and_grad(loss)(weights, index, key_loss)
            updates, state = optimizer.update(gradient, state)
            return (optax.apply_updates(weights, updates), state), value

        carry = (start, optimizer.init(start))
        (weights, _), losses = jax.lax.scan(step, carry, split_key(key, config.fit_steps))
        return weights, losses[-100:].mean()

    reward, error = fit(reward_loss, weights["reward"], key_reward)
    context, distance = fit(context_loss, weights["initial_state"], key_context)
    report = {
        "reward_r2": float(1.0 - error / jnp.var(target)),
        "energy_distance": float(distance),
    }
    return jax.tree.map(np.asarray, {"initial_state": context, "reward": reward}), report


def _fit_linear(
    bandit: SyntheticBandit, dataset: ExpertDataset, config: WarmStartConfig
) -> tuple[Weights, dict[str, float]]:
    """The closed form, and how much of the expert's actions it explains."""
    if config.construction != "action_distance":
        raise UserError(
            f"the construction is {config.construction}, and a linear bandit's reward is a distance of actions: take "
            "action_distance."
        )
    states = np.asarray(dataset.observation)
    best = np.reshape(dataset.expert_action, (len(states), -1))
    low, high = bandit.bounds
    weights = fitted(states, best, low, high)
    reward = weights["reward"]
    shares = np.tanh((states - reward["center"]) @ reward["kernel"] + reward["bias"])
    errors = (low + high) / 2 + shares * (high - low) / 2 - best
    return weights, {"action_r2": float(1.0 - errors.var() / best.var(axis=0).mean())}


def energy_distance(a: jax.Array, b: jax.Array) -> jax.Array:
    """[] 2 E|a - b| - E|a - a'| - E|b - b'| of two [B, O] samples (Szekely and Rizzo, 2013)."""

    def mean_distance(x: jax.Array, y: jax.Array, same: bool) -> jax.Array:
        squared = jnp.sum((x[:, None] - y[None]) ** 2, axis=-1)
        # The square root has no gradient at zero, which is where every point stands to itself.
        distance = jnp.sqrt(squared + 1e-12)
        size = x.shape[0]
        return distance.sum() / (size * (size - 1) if same else size * size)

    return 2 * mean_distance(a, b, False) - mean_distance(a, a, True) - mean_distance(b, b, True)
