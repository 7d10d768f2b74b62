"""Regress a bandit on what an expert does: its reward on the expert's actions or Q-values, its contexts on states."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from scb.environments.linear import PolicyDistanceParts, fitted
from scb.environments.synthetic import BanditParams, SyntheticBandit, Weights
from scb.errors import UserError
from scb.keys import named_key, root_key, split_key

CONSTRUCTIONS = ("advantage", "q", "action_distance")


class ExpertDataset(NamedTuple):
    """States that agents of mixed skill visit, with the expert's Q-values of random actions there."""

    observation: jax.Array  # [S, O]
    action: jax.Array  # [S, K, ...]
    q: jax.Array  # [S, K]; zeros for "action_distance", which needs none
    expert_action: jax.Array  # [S, ...]


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


def unchanging(observation: jax.Array) -> jax.Array:
    """[O] whether an entry is the same in all of [S, O] states, up to the rounding of 32 bits."""
    return jnp.ptp(observation, axis=0) <= 1e-6 * jnp.abs(observation).max(axis=0)


def fit_bandit(
    bandit: SyntheticBandit,
    dataset: ExpertDataset,
    key: jax.Array,
    construction: str = "action_distance",
    steps: int = 4000,
) -> tuple[Weights, dict[str, float]]:
    """Regresses the reward network, and matches the contexts' distribution to the dataset's states.

    The reward by least squares; the contexts by the energy distance between generated and stored
    states, which is zero only where the two distributions are equal. A linear bandit is fitted in closed form.

    Args:
      construction: what the reward should be, as `reward_targets` takes it.
      steps: of Adam, for each of the two.

    Returns:
      (weights, {"reward_r2": explained variance of the reward, "energy_distance": of the
      contexts}), or {"action_r2": explained variance of the expert's actions} of a linear bandit.
    """
    if bandit.linear:
        return _fit_linear(bandit, dataset, construction)
    key_init, key_reward, key_context = split_key(key, 3)
    weights = bandit.init_weights(key_init)
    target = reward_targets(dataset, construction, bandit.discrete)
    # An entry that never changes has no scale, and next to none would drown the others: it is left out, and held.
    held = unchanging(dataset.observation)
    scale = jnp.where(held, jnp.inf, dataset.observation.std(axis=0) + 1e-6)
    states = dataset.observation
    samples = states, dataset.action, target
    descend = partial(_descend, bandit, steps)
    reward, error = descend(_reward_loss, weights["reward"], samples, (), key_reward)
    context, distance = descend(_context_loss, weights["initial_state"], states, scale, key_context)
    last = context["Dense_1"]
    context["Dense_1"] = {
        "kernel": jnp.where(held, 0.0, last["kernel"]),
        "bias": jnp.where(held, states[0], last["bias"]),
    }
    report = {
        "reward_r2": float(1.0 - error / jnp.var(target)),
        "energy_distance": float(distance),
    }
    return jax.tree.map(np.asarray, {"initial_state": context, "reward": reward}), report


@partial(jax.jit, static_argnums=(0, 1, 2))
def _descend(
    bandit: SyntheticBandit,
    steps: int,
    loss: Any,
    start: Any,
    samples: Any,
    fixed: Any,
    key: jax.Array,
) -> tuple[Any, jax.Array]:
    """(weights, mean of the last losses) after Adam on minibatches of the samples, [S, ...] each.

    The loss takes (weights, bandit, minibatch, fixed, key).

    Data are arguments, not constants of the program, so that a bandit has one program for all datasets of a size.
    """
    optimizer = optax.adam(optax.cosine_decay_schedule(5e-3, steps))
    num_states = jax.tree.leaves(samples)[0].shape[0]

    def step(carry: Any, key: jax.Array) -> Any:
        weights, state = carry
        key_index, key_loss = split_key(key)
        index = jax.random.randint(key_index, (256,), 0, num_states)
        batch = jax.tree.map(lambda x: x[index], samples)
        value, gradient = jax.value_and_grad(loss)(weights, bandit, batch, fixed, key_loss)
        updates, state = optimizer.update(gradient, state)
        return (optax.apply_updates(weights, updates), state), value

    carry = (start, optimizer.init(start))
    (weights, _), losses = jax.lax.scan(step, carry, split_key(key, steps))
    return weights, losses[-100:].mean()


def _reward_loss(
    weights: Any, bandit: SyntheticBandit, batch: Any, _fixed: tuple[()], _key: jax.Array
) -> jax.Array:
    """[] squared error over states, [B, O], actions, [B, K, ...], and what their reward should be, [B, K]."""
    states, actions, target = batch
    params = BanditParams(weights={"initial_state": {}, "reward": weights})
    predict = jax.vmap(jax.vmap(bandit.mean_reward, in_axes=(None, 0, None)), in_axes=(0, 0, None))
    return jnp.mean((predict(states, actions, params) - target) ** 2)


def _context_loss(
    weights: Any, bandit: SyntheticBandit, states: jax.Array, scale: jax.Array, key: jax.Array
) -> jax.Array:
    """[] energy distance of as many contexts to states, [B, O], each entry in units of `scale`, [O]."""
    params = BanditParams(weights={"initial_state": weights, "reward": {}})
    keys = split_key(key, states.shape[0])
    generated, _ = jax.vmap(bandit.reset_env, in_axes=(0, None))(keys, params)
    return energy_distance(generated / scale, states / scale)


def check_linear(construction: str) -> None:
    """Raises a UserError where a linear bandit cannot be fitted to such a reward."""
    if construction != "action_distance":
        raise UserError(
            f"the construction is {construction}, and a linear bandit's reward is a distance of actions: take "
            "action_distance."
        )


def _fit_linear(
    bandit: SyntheticBandit, dataset: ExpertDataset, construction: str
) -> tuple[Weights, dict[str, float]]:
    """The closed form, and how much of the expert's actions it explains."""
    check_linear(construction)
    states = np.asarray(dataset.observation)
    best = np.reshape(np.asarray(dataset.expert_action), (len(states), -1))
    low, high = bandit.bounds
    weights = fitted(states, best, low, high)
    parts = PolicyDistanceParts.of(weights["reward"], low, high, np)
    errors = np.asarray(parts.action(parts.best(states)) - best, np.float64)
    # Of one action that is held throughout there is nothing to explain but rounding.
    if (np.ptp(best, axis=0) <= 1e-6 * (high - low)).all():
        return weights, {"action_r2": 1.0}
    unexplained = np.sum(errors**2) / np.sum((best - best.mean(axis=0, dtype=np.float64)) ** 2)
    return weights, {"action_r2": float(1.0 - unexplained)}


def energy_distance(a: jax.Array, b: jax.Array) -> jax.Array:
    """[] 2 E|a - b| - E|a - a'| - E|b - b'| of two [B, O] samples (Szekely and Rizzo, 2013)."""

    def mean_distance(x: jax.Array, y: jax.Array, same: bool) -> jax.Array:
        squared = jnp.sum((x[:, None] - y[None]) ** 2, axis=-1)
        # The square root has no gradient at zero, which is where every point stands to itself.
        distance = jnp.sqrt(squared + 1e-12)
        size = x.shape[0]
        return distance.sum() / (size * (size - 1) if same else size * size)

    return 2 * mean_distance(a, b, False) - mean_distance(a, a, True) - mean_distance(b, b, True)


def standardize_reward(bandit: SyntheticBandit, weights: Weights, std: float) -> Weights:
    """The bandit whose reward is an affine function of the given one: of mean zero and standard deviation `std`.

    Both are over its contexts and uniform actions. What agents should do in it stays the same.
    """
    rewards = bandit.sample_rewards(
        bandit.params(weights), named_key(root_key(0), "reward scale"), 10_000
    )
    spread = float(rewards.std())
    # Of a constant, in 32 bits, some rounding is left.
    if not spread > 1e-6 * max(1.0, float(jnp.abs(rewards).max())):
        raise UserError(
            f"the reward that the search starts from is {float(rewards.mean()):.4g} everywhere, and no factor gives it "
            f"a standard deviation of {std}: leave reward_std out, or start from other weights."
        )
    factor = std / spread
    return bandit.with_reward(weights, factor, -factor * float(rewards.mean()))
